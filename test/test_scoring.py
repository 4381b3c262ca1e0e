"""Scores of made-up characters: what is known to be wrong must be counted, nothing else, and chance finds nothing."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from beacon_comm.core.character import Character, Status
from beacon_comm.core.errors import FramingError
from beacon_comm.core.framing import CharacterFrame, transitions
from beacon_comm.evaluation.alignment import find_sendings
from beacon_comm.evaluation.held import Signal, held_characters
from beacon_comm.evaluation.scoring import not_found, score, wilson_interval
from beacon_comm.evaluation.truth import SONNET18

FRAME = CharacterFrame()
RATE_BPS = 3125.0
GAP_BITS = 17
EPOCH_NS = 1 << 40


def character(t_ns: float, code: int, status: Status = Status.OK, rate_bps: float = RATE_BPS) -> Character:
    return Character(round(t_ns), code, status, 1.0, FRAME.frame_of(code), rate_bps)


def sending(
    text: str, start_ns: float = EPOCH_NS, ppm: float = 0.0, jitter_bits: float = 0.0, seed: int = 0
) -> list[Character]:
    """Return the characters of one sending; the transmitter's clock is slow by ``ppm``."""
    bit_ns = 1e9 / RATE_BPS * (1.0 + ppm * 1e-6)
    jitter = np.random.default_rng(seed).normal(0.0, jitter_bits, len(text))
    return [character(start_ns + (11 * k + jitter[k]) * bit_ns, ord(symbol)) for k, symbol in enumerate(text)]


def span(characters: list[Character]) -> tuple[int, int]:
    """Return the recording's span that just holds the characters."""
    return characters[0].t_ns, characters[-1].t_ns + round(11e9 / RATE_BPS)


def damage(characters: list[Character], *places: int) -> list[Character]:
    """Return the characters with the lowest data bit of some turned round."""
    changed = list(characters)
    for k in places:
        changed[k] = replace(changed[k], code=changed[k].code ^ 1, frame=changed[k].frame ^ 0b1000)
    return changed


def test_a_perfect_sending() -> None:
    characters = sending(SONNET18)
    (found,) = score(characters, SONNET18, span(characters))
    assert (found.first, found.characters, found.wrong, found.missing, found.inserted) == (0, 618, 0, 0, 0)
    assert found.message_accuracy == 1.0
    assert found.bit_accuracy == 1.0
    assert abs(found.start_ns - EPOCH_NS) < 1000
    assert found.bit_rate_bps == pytest.approx(RATE_BPS, rel=1e-6)
    assert found.bits == 6798


def test_wrong_bits_count_as_the_paper_counts_them() -> None:
    """76 of 618 characters wrong are 0.877; one bit each of 6798 is 0.989."""
    characters = sending(SONNET18)
    damaged = damage(characters, *range(3, 3 + 76 * 8, 8))
    (found,) = score(damaged, SONNET18, span(characters))
    assert found.wrong == 76
    assert found.missing == 0
    assert round(found.message_accuracy, 3) == 0.877
    assert found.wrong_bits == 76
    assert [error.k for error in found.errors] == list(range(3, 3 + 76 * 8, 8))


def test_a_wrong_parity_bit_is_a_wrong_bit_and_no_wrong_character() -> None:
    characters = sending(SONNET18)
    characters[100] = replace(characters[100], frame=characters[100].frame ^ 0b100, status=Status.PARITY_ERROR)
    (found,) = score(characters, SONNET18, span(characters))
    assert found.wrong == 0
    assert found.wrong_bits == 1


def test_missing_characters_are_wrong_in_all_bits_at_the_ends_too() -> None:
    characters = sending(SONNET18)
    dropped = characters[5:300] + characters[310:-7]
    (found,) = score(dropped, SONNET18, span(characters))
    assert (found.first, found.characters) == (0, 618)
    assert found.wrong == found.missing == 5 + 10 + 7
    assert found.wrong_bits == 22 * 11
    assert found.open_ended
    assert found.message_accuracy == pytest.approx(1 - 22 / 618)


def test_inserted_characters_count_as_wrong() -> None:
    characters = sending(SONNET18)
    period_ns = 11e9 / RATE_BPS
    extra = [character(EPOCH_NS + (k + 0.5) * period_ns, ord('x')) for k in (10, 200, 616)]
    outside = [character(EPOCH_NS + k * period_ns, 0x7F) for k in (-1.0, 618.0, 618.5)]
    (found,) = score(characters + extra + outside, SONNET18, (EPOCH_NS - 10**9, EPOCH_NS + 10**10))
    assert (found.wrong, found.inserted) == (3, 3)
    assert found.message_accuracy == pytest.approx(1 - 3 / 618)
    assert found.bit_accuracy == 1.0


def test_of_two_characters_at_one_place_the_nearer_is_the_match() -> None:
    characters = sending(SONNET18)
    period_ns = 11e9 / RATE_BPS
    twice = [*characters, character(EPOCH_NS + 50.2 * period_ns, ord('x')), character(EPOCH_NS + 59.9 * period_ns, 0)]
    (found,) = score(twice, SONNET18, span(characters))
    assert (found.wrong, found.inserted) == (2, 2)


def test_a_character_half_a_period_off_is_missing_and_inserted() -> None:
    characters = sending(SONNET18)
    late = replace(characters[40], t_ns=characters[40].t_ns + round(0.3 * 11e9 / RATE_BPS))
    (found,) = score([*characters[:40], late, *characters[41:]], SONNET18, span(characters))
    assert (found.wrong, found.missing, found.inserted) == (2, 1, 1)


def test_wrong_ok_and_repaired() -> None:
    characters = damage(sending(SONNET18), 7, 8, 9)
    characters[8] = replace(characters[8], status=Status.PARITY_ERROR)
    for k in (9, 50, 51):
        characters[k] = replace(characters[k], status=Status.REPAIRED)
    (found,) = score(characters, SONNET18, span(characters))
    assert (found.wrong, found.wrong_ok, found.repaired) == (3, 1, 3)


def test_accuracy_does_not_fall_below_zero() -> None:
    characters = sending('Hello, beacon! ')
    period_ns = 11e9 / RATE_BPS
    extra = [character(EPOCH_NS + (k + part) * period_ns, 1) for k in range(14) for part in (0.4, 0.6)]
    (found,) = score(characters + extra, 'Hello, beacon! ', span(characters))
    assert found.inserted == 28
    assert found.message_accuracy == 0.0


@settings(max_examples=25, deadline=None)
@given(
    ppm=st.floats(-500.0, 500.0),
    first=st.integers(0, 500),
    length=st.integers(60, 118),
    seed=st.integers(0, 10_000),
)
def test_parts_of_a_sending_at_any_clock_are_counted_exactly(ppm, first, length, seed) -> None:
    """Drops, wrong characters and jitter of a fifth of a bit do not move the line; the part's ends are found."""
    rng = np.random.default_rng(seed)
    whole = sending(SONNET18, EPOCH_NS + seed, ppm, 0.2, seed)
    period_ns = 11e9 / RATE_BPS * (1 + ppm * 1e-6)
    held = (round(EPOCH_NS + seed + (first - 0.3) * period_ns), round(EPOCH_NS + seed + (first + length) * period_ns))
    wrong = set(rng.choice(length, length // 4, replace=False).tolist())
    dropped = set(rng.choice(length, length // 10, replace=False).tolist())
    part = damage(whole[first : first + length], *wrong)
    kept = [c for k, c in enumerate(part) if k not in dropped]
    (found,) = score(kept, SONNET18, held)
    assert (found.first, found.characters) == (first, length)
    assert found.missing == len(dropped)
    assert found.wrong == len(wrong | dropped)
    # The line is drawn out from the part to the sending's beginning.
    assert abs(found.start_ns - whole[0].t_ns) < (1.5 + 0.2 * first / length) * 1e9 / RATE_BPS


@pytest.mark.parametrize('deviation', [-0.019, -0.003, 0.003, 0.019])
def test_a_rate_two_percent_off_the_decoded_one_is_fitted(deviation) -> None:
    characters = sending(SONNET18, ppm=deviation * 1e6)
    (found,) = score(characters, SONNET18, span(characters))
    assert found.wrong == 0
    assert found.bit_rate_bps == pytest.approx(RATE_BPS / (1 + deviation), rel=1e-5)


def test_two_sendings_with_a_gap_between_as_on_the_recordings() -> None:
    """The gap reads as a valid 0x7F and noise of the search for the next start: it belongs to neither sending."""
    bit_ns = 1e9 / RATE_BPS
    first = sending(SONNET18)
    begin_ns = EPOCH_NS + (618 * 11 + GAP_BITS) * bit_ns
    second = sending(SONNET18, begin_ns)
    gap = [character(EPOCH_NS + 618 * 11 * bit_ns, 0x7F)]
    slipped = [character(begin_ns + (11 * k - 5) * bit_ns, 64 + k) for k in range(1, 9)]
    stream = first[53:] + gap + slipped + second[9:264]
    tail, head = score(stream, SONNET18, (first[53].t_ns, round(begin_ns + 264 * 11 * bit_ns)))
    assert (tail.first, tail.characters, tail.wrong, tail.inserted) == (53, 565, 0, 0)
    assert (head.first, head.characters, head.missing, head.inserted) == (0, 264, 9, 8)


def test_a_sending_that_was_broken_off_and_begun_anew() -> None:
    """The first holds what was sent of it: the second's start ends it."""
    period_ns = 11e9 / RATE_BPS
    first = sending(SONNET18)[:120]
    second = sending(SONNET18, EPOCH_NS + 123.4 * period_ns)
    broken, whole = score(first + second, SONNET18, (EPOCH_NS, second[-1].t_ns + round(period_ns)))
    assert (broken.characters, broken.wrong, broken.missing) == (123, 3, 3)
    assert (whole.characters, whole.wrong, whole.inserted) == (618, 0, 0)


@pytest.mark.parametrize('text', ['HELLO ', 'Hello, beacon! ', 'abcdefgh'])
@pytest.mark.parametrize('gap', [0.0, 0.5, GAP_BITS / 11])
def test_a_short_text_sent_many_times(text, gap) -> None:
    period_ns = 11e9 / RATE_BPS
    stream: list[Character] = []
    for n in range(30):
        stream += sending(text, EPOCH_NS + n * (len(text) + gap) * period_ns)
    damaged = damage(stream, 17)
    found = score(damaged, text, span(stream))
    assert len(found) == 30
    assert sum(transmission.wrong for transmission in found) == 1
    assert sum(transmission.characters for transmission in found) == 30 * len(text)


def test_a_garbled_sending_between_good_ones_counts() -> None:
    text = SONNET18[:80]
    period_ns = 11e9 / RATE_BPS
    stream = [sending(text, EPOCH_NS + n * 82.3 * period_ns, seed=n) for n in range(4)]
    stream[2] = [character(c.t_ns, 127 - c.code) for c in stream[2]]
    found = score(sum(stream, []), text, (EPOCH_NS, round(EPOCH_NS + 330 * period_ns)))
    assert [transmission.wrong for transmission in found] == [0, 0, 80, 0]


@pytest.mark.parametrize('share_right', [0.43, 0.25, 0.15])
def test_a_start_is_found_among_mostly_wrong_characters(share_right) -> None:
    rng = np.random.default_rng(5)
    characters = [
        c if rng.random() < share_right else character(c.t_ns, int(rng.integers(128)))
        for c in sending(SONNET18, ppm=380.0, jitter_bits=0.3)
    ]
    (found,) = score(characters, SONNET18, (EPOCH_NS, EPOCH_NS + 10**10))
    right = sum(c.code == ord(symbol) for c, symbol in zip(characters, SONNET18, strict=True))
    assert found.characters == 618
    assert found.wrong == 618 - right


@pytest.mark.parametrize('seed', range(12))
def test_chance_finds_no_sending(seed) -> None:
    """Uniform codes, the sonnet's letters drawn at random, the sonnet shuffled: no start for long or short texts."""
    rng = np.random.default_rng(seed)
    letters = np.frombuffer(SONNET18.encode(), np.uint8)
    count = int(rng.integers(15, 1500))
    codes = (rng.integers(0, 128, count), letters[rng.integers(0, 618, count)], rng.permutation(letters))[seed % 3]
    period_ns = 11e9 / RATE_BPS
    characters = [character(EPOCH_NS + k * period_ns, int(code)) for k, code in enumerate(codes)]
    for truth in (SONNET18, 'Hello, beacon! ', 'HELLO '):
        assert score(characters, truth, span(characters)) == ()


def test_another_text_is_not_the_sonnet() -> None:
    other = 'The quick brown fox jumps over the lazy dog, and then it does so again, for it has no other sentence. ' * 8
    characters = sending(other)
    assert score(characters, SONNET18, span(characters)) == ()


def test_no_start_is_the_papers_half_of_the_bits() -> None:
    assert score([], SONNET18, (0, 10**9)) == ()
    lost = not_found(SONNET18)
    assert lost.start_ns is None
    assert (lost.message_accuracy, lost.bit_accuracy) == (0.0, 0.5)
    assert (lost.characters, lost.wrong) == (618, 618)


def test_order_and_noise_of_the_input_do_not_matter() -> None:
    characters = sending(SONNET18, jitter_bits=0.2)
    shuffled = [characters[k] for k in np.random.default_rng(2).permutation(618)]
    assert score(shuffled, SONNET18, span(characters)) == score(characters, SONNET18, span(characters))


def test_a_truth_that_cannot_be_framed_is_refused_by_name() -> None:
    with pytest.raises(FramingError, match='é'):
        score(sending('cafe'), 'café', (0, 1))


def test_eight_data_bits() -> None:
    frame = CharacterFrame(data_bits=8, parity='none', stop_bits=1)
    text = 'Grüße von der Boje, hier ist alles gut. '
    period_ns = 10e9 / RATE_BPS
    characters = [
        Character(round(EPOCH_NS + k * period_ns), ord(c), Status.OK, 1.0, frame.frame_of(ord(c)), RATE_BPS)
        for k, c in enumerate(text)
    ]
    (found,) = score(characters, text, (EPOCH_NS, round(EPOCH_NS + len(text) * period_ns)), frame=frame)
    assert (found.characters, found.wrong, found.bits) == (40, 0, 400)


# --- what the recording holds ---------------------------------------------------------------------------------------


def line_signal(text: str, start_ns: int, broken_at_bit: int | None, seed: int = 0) -> Signal:
    """Return 20 events at each level change, with latency, and stray ones for a second more; the line dies at a bit."""
    rng = np.random.default_rng(seed)
    t_ns, level = transitions(FRAME.encode_bits(text)[:broken_at_bit], RATE_BPS, start_ns)
    times = (t_ns[:, None] + rng.exponential(60_000, (len(t_ns), 20))).ravel()
    polarity = np.repeat(np.where(level > 0, 1, -1), 20)
    stray = start_ns + rng.uniform(0, 1e9 + t_ns[-1] - start_ns, 40)
    times = np.concatenate((times, stray))
    polarity = np.concatenate((polarity, rng.choice((-1, 1), 40)))
    order = np.argsort(times)
    return Signal(times[order].astype(np.int64), polarity[order].astype(np.int8))


@pytest.mark.parametrize('broken_at_bit', [264 * 11, 264 * 11 + 4, 264 * 11 + 8, 264 * 11 + 11])
def test_the_signal_tells_where_a_sending_broke_off(broken_at_bit) -> None:
    signal = line_signal(SONNET18, EPOCH_NS, broken_at_bit)
    stop = 264 if broken_at_bit < 264 * 11 + 11 else 265
    # The decoder lost the last three before it: they were sent, so they are missing.
    characters = sending(SONNET18)[:261]
    held = (EPOCH_NS, int(signal.t_ns[-1]))
    (found,) = score(characters, SONNET18, held, signal)
    assert (found.first, found.characters, found.missing) == (0, stop, stop - 261)
    (by_clock,) = score(characters, SONNET18, held)
    assert by_clock.characters == 618 or by_clock.characters > 300


def test_a_gap_in_the_signal_is_inside_if_more_follows() -> None:
    whole = line_signal(SONNET18, EPOCH_NS, None)
    period_ns = 11e9 / RATE_BPS
    hidden = (whole.t_ns > EPOCH_NS + 100 * period_ns) & (whole.t_ns < EPOCH_NS + 160 * period_ns)
    signal = Signal(whole.t_ns[~hidden], whole.polarity[~hidden])
    characters = sending(SONNET18)
    held = (EPOCH_NS, int(signal.t_ns[-1]))
    (found,) = score(characters[:100] + characters[160:], SONNET18, held, signal)
    assert (found.characters, found.missing) == (618, 60)
    (deaf,) = score(characters[:100], SONNET18, held, signal)
    assert deaf.characters == 618


def test_a_beacon_that_appears_late_holds_what_was_seen() -> None:
    whole = line_signal(SONNET18, EPOCH_NS, None)
    period_ns = 11e9 / RATE_BPS
    seen = whole.t_ns > EPOCH_NS + 200.5 * period_ns
    signal = Signal(whole.t_ns[seen], whole.polarity[seen])
    (found,) = score(sending(SONNET18)[203:], SONNET18, (EPOCH_NS, int(signal.t_ns[-1])), signal)
    assert (found.first, found.characters, found.missing) == (201, 417, 2)


def test_a_part_without_a_whole_character_holds_none() -> None:
    codes = np.frombuffer(SONNET18.encode(), np.uint8).astype(np.int64)
    t_ns = EPOCH_NS + np.round(np.arange(618) * 11e9 / RATE_BPS).astype(np.int64)
    (found,) = find_sendings(t_ns, codes, codes, RATE_BPS)
    bits = FRAME.encode_bits(SONNET18).reshape(618, 11)
    first, stop = held_characters(found, bits, (EPOCH_NS + 10**6, EPOCH_NS + 2 * 10**6), None)
    assert first == stop


def test_wilson_interval() -> None:
    assert wilson_interval(0.5, 10).low == pytest.approx(0.2366, abs=1e-4)
    assert wilson_interval(0.5, 10).high == pytest.approx(0.7634, abs=1e-4)
    assert wilson_interval(1.0, 264).low == pytest.approx(0.9857, abs=1e-4)
    assert wilson_interval(1.0, 264).high == 1.0
    assert wilson_interval(0.3, 0).low == 0.0
