"""End-bit detection and synchronisation, on edges."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from line_events import line_edges, text_bits

from beacon_comm.core.framing import CharacterFrame
from beacon_comm.core.high_pass import Edges
from beacon_comm.core.synchronisation import EndBitSynchroniser

RATE_BPS = 1000.0
BIT = 1_000_000
T = 11 * BIT
TEXT = 'ou art more lovely and more temperate:\nRough winds do shake the darling buds of May'


def synchroniser(**options):
    return EndBitSynchroniser(RATE_BPS, CharacterFrame(), **options)


def edges(*t_and_direction):
    """Edges from times in bits: positive numbers rise, negative ones fall; '-0.0' is a fall at 0."""
    t_ns = np.array([round(abs(t) * BIT) for t in t_and_direction], np.int64)
    return Edges(t_ns, ~np.signbit(np.array(t_and_direction, float)))


def spans_of(line, t_end_bits, **options):
    return synchroniser(**options).push(line, round(t_end_bits * BIT))


def starts_of(spans):
    return [span.start_ns / BIT for span in spans]


def without(line, *times_bits):
    """Leave the edges at these times out."""
    keep = ~np.isin(line.t_ns, [round(t * BIT) for t in times_bits])
    return Edges(line.t_ns[keep], line.rising[keep])


@pytest.mark.parametrize('clock', [1.0, 0.99, 1.01])
def test_follows_the_clock_of_the_line(clock):
    line = line_edges(text_bits('Shall I'), RATE_BPS * clock)
    spans = synchroniser().push(line, 200 * BIT)
    assert len(spans) == 7
    assert [span.start_ns for span in spans] == [round(k * T / clock) for k in range(7)]
    assert all(span.start_seen for span in spans)
    assert [span.stop_seen for span in spans] == [True] * 6 + [False]  # after the last one the line idles


@pytest.mark.parametrize(('edge_bits', 'seen'), [(8.5, True), (8.499999, False), (11.5, True), (11.500001, False)])
def test_search_window(edge_bits, seen):
    first = spans_of(edges(-0.0, 1, -edge_bits, edge_bits + 1), 100, idle_start=False)[0]
    assert first.stop_seen == seen
    assert first.stop_ns == (round(edge_bits * BIT) if seen else T)


def test_first_falling_edge_from_the_right():
    line = edges(-0.0, 1, -9, 9.5, -10.5, 10.7, -11.2, 11.4)
    assert spans_of(line, 100)[0].stop_ns == round(11.2 * BIT)


def test_character_comes_out_by_time_alone_once_its_window_is_over():
    line = edges(-0.0, 1)
    receiver = synchroniser()
    assert receiver.push(line, round(11.5 * BIT)) == []  # an edge at this very time would still count
    (span,) = receiver.push(edges(), round(11.5 * BIT) + 1)
    assert (span.start_ns, span.stop_ns, span.decided_ns) == (0, T, round(11.5 * BIT) + 1)


def test_missing_start_edge_is_bridged():
    line = line_edges(text_bits('wwww'), RATE_BPS)  # w: 0 1110111 0 11
    spans = spans_of(without(line, 11, 12), 60)
    assert starts_of(spans) == [0, 11, 22, 33]
    assert [(span.start_seen, span.stop_seen) for span in spans] == [(1, 0), (0, 1), (1, 1), (1, 0)]


def test_two_missing_start_edges_lose_the_two_characters():
    line = line_edges(text_bits('wwwww'), RATE_BPS)
    assert starts_of(spans_of(without(line, 11, 12, 22, 23), 80)) == [0, 33, 44]


def test_idle_line_restarts_at_its_first_fall():
    # The real gap: one 0, sixteen 1s; a UART sees 0x7F and six idle bits.
    bits = np.concatenate([text_bits('see.'), [0], np.ones(16, np.uint8), text_bits('Shall')])
    spans = spans_of(line_edges(bits, RATE_BPS), 200)
    assert starts_of(spans) == [0, 11, 22, 33, 44, 61, 72, 83, 94, 105]
    literal = spans_of(line_edges(bits, RATE_BPS), 200, idle_start=False)
    assert 61 not in starts_of(literal)


def test_shortest_idle_line():
    # High from bit 1 on: 10.5 bits of it make the fall a start, even right before a later fall in the window.
    line = edges(-0.0, 0.9, -11.4, 11.45, -11.48, 12)
    assert spans_of(line, 100)[0].stop_ns == round(11.4 * BIT)
    assert spans_of(line, 100, idle_start=False)[0].stop_ns == round(11.48 * BIT)


def test_nothing_is_decoded_through_a_break():
    line = line_edges(np.concatenate([text_bits('ab'), np.zeros(12, np.uint8), [1], text_bits('cd')]), RATE_BPS)
    assert starts_of(spans_of(line, 100)) == [0, 11, 35, 46]
    # One bit less is no break, only a character with wrong stop bits.
    line = line_edges(np.concatenate([text_bits('ab'), np.zeros(11, np.uint8), [1], text_bits('cd')]), RATE_BPS)
    assert starts_of(spans_of(line, 100))[:3] == [0, 11, 22]
    # A character whose end lies in a break is not given out either: bit 5 of 'b' never ends.
    line = line_edges(np.concatenate([text_bits('ab')[:16], np.zeros(12, np.uint8)]), RATE_BPS)
    assert starts_of(spans_of(line, 26)) == [0]


@pytest.mark.parametrize('idle_start', [True, False])
@pytest.mark.parametrize('line', [edges(), edges(-0.0), edges(-0.0, 0.2), edges(-0.0, 15)])
def test_held_line_gives_no_character_but_the_one_it_started_with(line, idle_start):
    receiver = synchroniser(idle_start=idle_start, trials=5)
    spans = []
    for bits in range(0, 10_000, 7):
        now = edges() if bits else line
        spans += receiver.push(now, max(bits, 16) * BIT)
    spans += receiver.flush()
    # A fall and a rise are the start of a character of ones; everything else is silence.
    assert starts_of(spans) == ([0.0] if len(line.t_ns) == 2 and line.t_ns[1] < T else [])


def test_slips_left_until_synchronised():
    bits = text_bits(TEXT)[6:]
    literal = spans_of(line_edges(bits, RATE_BPS), len(bits) + 20)
    true_starts = {11 * k + 5 for k in range(len(TEXT))}
    in_step = [start in true_starts for start in starts_of(literal)]
    assert not in_step[0] and all(in_step[-20:])


@pytest.mark.parametrize('skipped', range(1, 12))
def test_one_of_the_trials_starts_at_a_start_bit(skipped):
    bits = text_bits(TEXT)[skipped:]
    spans = spans_of(line_edges(bits, RATE_BPS), len(bits) + 20, trials=5)
    trials = [[s.start_ns // BIT for s in spans if s.trial == trial] for trial in range(5)]
    assert min(next(i for i, s in enumerate(starts) if (s + skipped) % 11 == 0) for starts in trials) == 0


def test_flush_gives_a_complete_character_only():
    for t_end_bits, count in ((10.4, 0), (10.5, 1), (11.2, 1)):
        receiver = synchroniser()
        assert receiver.push(edges(-0.0, 3), round(t_end_bits * BIT)) == []
        assert len(receiver.flush()) == count
        assert receiver.flush() == []
    receiver = synchroniser()
    receiver.push(edges(-0.0), 11 * BIT)
    assert receiver.flush() == []  # low to its end: nothing tells it from a break


def random_line(seed):
    """A line of bits with glitches, pauses and breaks."""
    random = np.random.default_rng(seed)
    parts = []
    for _ in range(12):
        kind = random.integers(4)
        parts.append(
            [
                lambda: text_bits(random.integers(0, 128, 3, dtype=np.uint8).tobytes()),
                lambda: random.integers(0, 2, 20),
                lambda: np.ones(random.integers(5, 40)),
                lambda: np.zeros(random.integers(1, 15)),
            ][kind]()
        )
    t_ns = line_edges(np.concatenate(parts).astype(np.uint8), RATE_BPS).t_ns
    t_ns = np.sort(t_ns + random.integers(-BIT // 3, BIT // 3, len(t_ns)))
    return Edges(t_ns, np.arange(len(t_ns)) % 2 == 1)


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 10_000), st.lists(st.floats(0, 300), max_size=12), st.booleans(), st.sampled_from([1, 5]))
def test_any_batching_gives_the_same_spans(seed, cuts_bits, idle_start, trials):
    line = random_line(seed)
    t_end = 400 * BIT
    whole = synchroniser(idle_start=idle_start, trials=trials)
    expected = whole.push(line, t_end) + whole.flush()
    parted = synchroniser(idle_start=idle_start, trials=trials)
    spans, start = [], 0
    for cut in sorted(round(c * BIT) for c in cuts_bits):
        stop = max(start, int(np.searchsorted(line.t_ns, cut)))
        spans += parted.push(Edges(line.t_ns[start:stop], line.rising[start:stop]), cut)
        start = stop
    spans += parted.push(Edges(line.t_ns[start:], line.rising[start:]), t_end) + parted.flush()
    assert spans == expected
    assert [s.decided_ns for s in expected] == sorted(s.decided_ns for s in expected)


def test_clock_may_start_anywhere():
    line = random_line(7)
    expected = synchroniser(trials=5).push(line, 400 * BIT)
    shifted = synchroniser(trials=5).push(Edges(line.t_ns + 2**40, line.rising), 400 * BIT + 2**40)
    assert len(expected) > 10
    assert [
        s._replace(start_ns=s.start_ns - 2**40, stop_ns=s.stop_ns - 2**40, decided_ns=s.decided_ns - 2**40)
        for s in shifted
    ] == expected


def test_frames_run_on_through_missing_events():
    """Behind a gap the level may be the other one: neither a break nor an idle line is to be seen in it."""
    for start_bits, stop_bits in [(14.3, 17.8), (30.2, 42.1), (12.0, 33.0)]:
        line = line_edges(text_bits('Shall I compare'), 1000.0)
        before, after = line.t_ns < start_bits * BIT, line.t_ns >= stop_bits * BIT
        sync = synchroniser()
        spans = sync.push(Edges(line.t_ns[before], line.rising[before]), int(start_bits * BIT))
        sync.miss(int(stop_bits * BIT))
        spans += sync.push(Edges(line.t_ns[after], line.rising[after]), 400 * BIT)
        starts = {round(span.start_ns / BIT, 3) for span in spans}
        assert starts >= {11.0 * k for k in range(15) if not start_bits - 11 < 11 * k < stop_bits + 11}
        assert all(start % 11 == 0 for start in starts)
