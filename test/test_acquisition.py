"""Acquisition: a beacon is found with its rate, its phase and its polarity, and nothing else is."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from line_events import text_bits
from sequence_lines import NS, beacon_events

from beacon_comm.core.acquisition import Demands, Verdict, acquiring, look_at_once
from beacon_comm.core.framing import CharacterFrame
from beacon_comm.core.likelihood import CONTEXTS, COUNTS, LEVELS
from beacon_comm.core.rate_search import periods_around
from beacon_comm.core.trellis import frame_layout
from beacon_comm.simulation.led import OUTDOOR_30_M, noise, square_wave

TEXT = "Rough winds do shake the darling buds of May,\nAnd summer's lease"
RATES = (100.0, 504.0, 1000.0, 3125.0, 8000.0)
FRAME = CharacterFrame()
LAYOUT = frame_layout(FRAME)
# Nearby: a large disc, which has as many ON as OFF events while a level is held.
NEAR = replace(OUTDOOR_30_M, rise=replace(OUTDOOR_30_M.rise, held_per_s=0.0), fall=replace(OUTDOOR_30_M.fall, held_per_s=0.0))
NEAR = replace(NEAR, stray_per_s=4000.0)


def found(events, periods, needed=4, layout=LAYOUT):
    t_ns, polarity = events
    t = (t_ns - t_ns[0]).astype(np.float64)
    return look_at_once(acquiring(t, polarity, np.asarray(periods), layout, Demands(needed, 3)))


def beacon(text, bit_rate_bps, skipped=0, ends_after=5, frame=None, **options):
    """Return the events of a text from its bit ``skipped`` on, and of some bits of one more character.

    The window of a lock ends anywhere in a character.
    """
    bits = text_bits(text + 'L', frame)
    bits = bits[skipped : len(text_bits(text, frame)) + ends_after]
    return beacon_events(bits, bit_rate_bps, lead_s=0.0, tail_s=0.0, **options)


# --- found --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize('bit_rate_bps', RATES)
@pytest.mark.parametrize('clock', [0.98, 0.999, 1.0, 1.02])
def test_the_rate_is_found_around_the_expected_one(bit_rate_bps, clock):
    events = beacon(TEXT[:25], bit_rate_bps * clock, skipped=4)
    lock = found(events, periods_around(NS / bit_rate_bps, 0.025, 275))
    assert lock.period == pytest.approx(NS / (bit_rate_bps * clock), rel=5e-4)
    assert lock.clock['period'][0] == lock.period
    assert abs(lock.period * bit_rate_bps * clock / NS - 1.0) < 5.0 * lock.clock['p_period'][0] ** 0.5 + 1e-4
    assert lock.verdict.passing >= 24 and lock.verdict.failing < 1.0
    assert lock.verdict.convinces and not lock.inverted


@pytest.mark.parametrize('bit_rate_bps', RATES)
def test_every_bit_is_given_its_place_in_the_frame(bit_rate_bps):
    for skipped in range(0, 11, 3):
        events = beacon(TEXT[:12], bit_rate_bps, skipped=skipped)
        lock = found(events, [NS / bit_rate_bps])
        # Place 0 begins with a start bit, up to the latency and what is open of the eye.
        starts = lock.clock['border'][0] + np.flatnonzero(lock.positions == 0) * lock.period
        bits = (starts + float(events[0][0])) * bit_rate_bps / NS + skipped
        away = bits - 11.0 * np.round(bits / 11.0)
        assert len(bits) >= 11 and np.abs(away).max() < 1.0 and np.ptp(away) < 0.1


def test_latencies_are_those_of_the_edges():
    lock = found(beacon(TEXT[:25], 1000.0), [1e6])
    assert 0.0 <= lock.clock['border'][0] % 1e6 < 1e6
    # The edges of a bit lie in it, or a little before.
    assert (lock.clock['latencies'] >= -0.3e6).all() and (lock.clock['latencies'] <= 0.7e6).all()


@pytest.mark.parametrize('begins_at', np.arange(0.0, 1.0, 0.125))
def test_bursts_far_shorter_than_a_bit_are_kept_off_its_borders(begins_at):
    # At 20 bps a burst is over in a hundredth of a bit: the eye is open at every phase.
    t_ns, polarity = beacon(TEXT[:8], 20.0, model=NEAR)
    later = t_ns >= t_ns[0] + begins_at * NS / 20.0
    lock = found((t_ns[later], polarity[later]), [NS / 20.0])
    assert lock.verdict.passing >= 7 and lock.verdict.spread < 0.02
    assert lock.clock['latencies'][0] / lock.period == pytest.approx(0.375, abs=0.05)


@pytest.mark.parametrize('bit_rate_bps', RATES)
def test_an_inverted_led_is_found_as_one(bit_rate_bps):
    t_ns, polarity = beacon(TEXT[:20], bit_rate_bps)
    upright, inverted = found((t_ns, polarity), [NS / bit_rate_bps]), found((t_ns, -polarity), [NS / bit_rate_bps])
    assert not upright.inverted and inverted.inverted
    assert inverted.verdict.passing == upright.verdict.passing == 20
    assert np.array_equal(inverted.positions, upright.positions)
    assert inverted.detection['histograms'] == pytest.approx(upright.detection['histograms'])
    for value in ('border', 'period', 'variance', 'p_phase', 'p_period'):
        assert inverted.clock[value] == pytest.approx(upright.clock[value])


@pytest.mark.parametrize(
    'frame',
    [
        CharacterFrame(parity='odd'),
        CharacterFrame(data_bits=8, parity='none', stop_bits=1, bit_order='lsb_first'),
        CharacterFrame(stop_bits=1),
    ],
    ids=str,
)
def test_other_layouts(frame):
    lock = found(beacon(TEXT, 1000.0, frame=frame), [1e6], layout=frame_layout(frame))
    assert lock.verdict.passing >= len(TEXT) - 1
    assert set(lock.positions) <= set(range(frame.length + 1))


@pytest.mark.parametrize('t0_ns', [0, 10**18, 2**62])
def test_time_of_day_does_not_matter(t0_ns):
    t_ns, polarity = beacon(TEXT[:12], 1000.0)
    lock, expected = found((t_ns + t0_ns, polarity), [1e6]), found((t_ns, polarity), [1e6])
    assert lock.verdict == expected.verdict and lock.clock.tobytes() == expected.clock.tobytes()
    assert lock.verdict.passing == 12 and lock.period == pytest.approx(1e6, rel=1e-3)


def test_a_window_may_begin_and_end_anywhere():
    refused = []
    for bit_rate_bps in (504.0, 1000.0, 3125.0):
        for skipped in range(11):
            for ends_after in (0, 1, 4, 7, 9):
                lock = found(beacon(TEXT[:20], bit_rate_bps, skipped, ends_after), [NS / bit_rate_bps])
                if lock is None or lock.verdict.passing < 18:
                    refused.append((bit_rate_bps, skipped, ends_after))
    assert refused == []


@pytest.mark.parametrize(
    'gap_bits', [2, 10, 30, 100]
)
def test_characters_that_stand_alone_are_found(gap_bits):
    lock = found(beacon_events(text_bits(TEXT[:12], gap_bits=gap_bits), 1000.0, lead_s=0.01, tail_s=0.01), [1e6])
    assert lock.verdict.passing == 12
    assert np.sum(lock.positions == FRAME.length) > 12 * (gap_bits - 2)
    assert lock.verdict.full  # sharp edges leave no room for another rate


def test_what_was_learnt_tells_ones_from_zeros():
    lock = found(beacon(TEXT[:25], 3125.0), [NS / 3125.0])
    tables = lock.detection['tables'][0]
    assert tables.shape == (CONTEXTS, COUNTS, LEVELS)
    assert np.exp(tables).sum(axis=2) == pytest.approx(1.0, abs=1e-5)
    levels = np.exp(tables) @ np.arange(LEVELS)
    on, off = levels[:, : COUNTS // 2].sum(axis=1), levels[:, COUNTS // 2 :].sum(axis=1)
    assert (on[0b001] > off[0b001]) and (off[0b110] > on[0b110])


def test_the_window_is_left_as_it_was():
    t_ns, polarity = beacon(TEXT[:12], 1000.0)
    t, kept = t_ns.astype(np.float64), polarity.copy()
    look_at_once(acquiring(t, polarity, np.array([1e6]), LAYOUT, Demands(4)))
    assert np.array_equal(t, t_ns) and np.array_equal(polarity, kept)


# --- refused ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize('needed', [4, 8])
def test_noise_is_refused(needed):
    for seed in range(25):
        events = noise(50_000.0, 0.3, on_share=(0.3, 0.5, 0.7)[seed % 3], seed=seed)
        assert found(events, periods_around(1e6, 0.025, 300), needed) is None


@pytest.mark.parametrize('frequency_hz', [100.0, 120.0, 500.0])
@pytest.mark.parametrize('duty', [0.2, 0.5])
def test_a_lamp_is_refused(frequency_hz, duty):
    events = square_wave(frequency_hz, duty, 0.5)
    for factor in (1.0, 2.0, 5.0):
        assert found(events, periods_around(NS / (frequency_hz * factor), 0.025, 300)) is None


@pytest.mark.parametrize('bit_rate_bps', RATES)
@pytest.mark.parametrize('factor', [0.7, 0.9, 1.1, 1.3, 1.5, 2.0, 3.0])
def test_another_rate_is_refused(bit_rate_bps, factor):
    for skipped in (0, 5):
        events = beacon(TEXT[:25], bit_rate_bps, skipped)
        assert found(events, periods_around(NS / (bit_rate_bps * factor), 0.025, 275 * factor)) is None


def test_half_the_rate_is_refused():
    taken = []
    for bit_rate_bps in (504.0, 3125.0, 8000.0):
        for skipped in range(11):
            for ends_after in (0, 5):
                events = beacon(TEXT[:25], bit_rate_bps, skipped, ends_after)
                if found(events, periods_around(2.0 * NS / bit_rate_bps, 0.025, 138)) is not None:
                    taken.append((bit_rate_bps, skipped, ends_after))
    assert taken == []


@settings(max_examples=30, deadline=None)
@given(st.binary(min_size=12, max_size=12), st.integers(0, 10))
def test_a_signal_read_at_twice_its_rate_is_refused(codes, skipped):
    events = beacon(bytes(code & 127 for code in codes).decode('ascii'), 1000.0, skipped)
    assert found(events, [0.5e6]) is None


def test_nothing_and_next_to_nothing_is_refused():
    empty = (np.empty(0), np.empty(0, np.int8))
    assert look_at_once(acquiring(*empty, np.array([1e6]), LAYOUT, Demands(4))) is None
    assert look_at_once(acquiring(np.zeros(3), np.ones(3, np.int8), np.array([1e6]), LAYOUT, Demands(4))) is None
    for count in (16, 1000):
        burst = np.zeros(count), np.ones(count, np.int8)  # all at one time
        assert look_at_once(acquiring(*burst, np.array([1e6]), LAYOUT, Demands(4))) is None
    held = np.arange(0.0, 300e6, 1e4)
    for level in (1, -1):
        assert look_at_once(acquiring(held, np.full(len(held), level, np.int8), np.array([1e6]), LAYOUT, Demands(4))) is None


def test_fewer_words_than_needed_are_refused():
    events = beacon(TEXT[:6], 1000.0)
    assert found(events, [1e6], needed=6).verdict.passing == 6
    assert found(events, [1e6], needed=7) is None


def test_a_text_that_fits_two_places_is_refused():
    # 0 1101101 1 11: begun three bits later it is 0 1101111 0 11, and so on for ever.
    assert found(beacon('m' * 12, 1000.0, skipped=5, ends_after=0), [1e6]) is None


# --- verdict ------------------------------------------------------------------------------------------------------


def verdict(**values):
    base = {
        'passing': 10, 'failing': 0.0, 'covered': 110, 'changes': 5.0, 'bits': 120, 'likelihood': -1.0,
        'place_margin': 50.0, 'oversampled': 0.6, 'spread': 0.1,
    }  # fmt: skip
    return Verdict(**{**base, **values})


def test_verdict():
    assert verdict().convinces and verdict().full
    assert verdict().share == pytest.approx(110 / 120) == verdict().merit
    assert verdict(failing=5.0).merit == pytest.approx(55 / 120)
    for refused in ({'failing': 5.0}, {'place_margin': 1.0}, {'oversampled': 0.95}, {'passing': 0, 'failing': 3.0}):
        assert not verdict(**refused).convinces
    assert verdict(passing=40, failing=20.0).convinces  # a weak signal, but a long one
    assert verdict(passing=3, failing=2.0, cost=10.0).convinces  # a short one, of which words nearly pass
    for refused in ({'cost': 20.0}, {'place_margin': 20.0}, {'spread': 0.2}, {'failing': 4.0}):
        assert not verdict(**{'passing': 3, 'failing': 2.0, 'cost': 10.0, **refused}).convinces
    assert Demands(5).met(verdict(passing=3, failing=2.0, cost=10.0))
    assert not Demands(6).met(verdict(passing=3, failing=2.0, cost=10.0))
    assert verdict(covered=50, spread=0.05).full  # sharp edges, with pauses between the characters
    for not_full in ({'covered': 50, 'spread': 0.15}, {'covered': 50, 'failing': 4.0}, {'passing': 3}, {'changes': 1.5}):
        assert not verdict(**not_full).full
    assert verdict(passing=0, covered=0).merit == 0.0
