"""The bit clock: counts in their sub-slots, and a clock that follows the edges unless it is frozen."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from line_events import line_events

from beacon_comm.core.bit_clock import (
    EDGE_LAG,
    OFF,
    ON,
    PULL,
    UNSURE_PHASE,
    go_on,
    make_clock,
    see_edge,
    take_events,
)
from beacon_comm.core.likelihood import COUNTS, SUB_SLOTS

RATE_BPS = 1000.0
BIT = 1e6


def clock_at(border=0.0, period=BIT, latencies=(0.0, 0.0), spread=0.05, period_error=0.003):
    return make_clock(border, period, np.array(latencies), spread, period_error)[0]


def run(clock, t, polarity, bits, sign=1, first=0, line=None, since=0):
    """Take so many bits; return the counts of each, ``(bits, COUNTS)``, their borders, and the next event's index.

    ``line`` are the bits that were sent, as a receiver decides them; the first one to be taken is number ``since``.
    """
    counts, borders = [], []
    for n in range(since, since + bits):
        borders.append(clock['border'])
        first = take_events(clock, t, polarity, first, sign, True)
        counts.append(clock['counts'].copy())
        follow(clock, line, n)
        go_on(clock, 1)
    return np.array(counts), np.array(borders), first


def follow(clock, line, n):
    """Let the clock see the edge that is known at the end of the bit ``n``, if there is one."""
    here = n - EDGE_LAG
    if line is not None and 0 < here < len(line) and line[here] != line[here - 1]:
        see_edge(clock, ON if line[here] else OFF)


def random_line(bits, seed=0):
    return np.random.default_rng(seed).integers(0, 2, bits).astype(np.uint8)


def events_of(bits, rate_bps=RATE_BPS, t0_ns=0, **options):
    t_ns, polarity = line_events(bits, rate_bps, t0_ns, **options)
    return t_ns.astype(np.float64), polarity


def off(clock, rate_bps=RATE_BPS, t0=0.0):
    """Return how far the clock's border is from the nearest true one (bit)."""
    bits = (clock['border'] - t0) * rate_bps / 1e9
    return bits - round(bits)


# --- counting -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize('sign', [1, -1])
def test_counts_land_in_their_sub_slots(sign):
    t = np.array([0.0, 0.24, 0.25, 0.5, 0.74, 0.75, 0.999, 1.0, 1.3, 2.9]) * BIT
    polarity = np.array([1, -1, 1, 1, -1, -1, 1, -1, 1, 1], np.int8)
    clock = clock_at()
    counts, borders, first = run(clock, t, polarity, 3, sign)
    expected = [[1, 1, 1, 1, 1, 0, 1, 1], [0, 1, 0, 0, 1, 0, 0, 0], [0, 0, 0, 1, 0, 0, 0, 0]]
    if sign < 0:
        expected = [row[SUB_SLOTS:] + row[:SUB_SLOTS] for row in expected]
    assert counts.tolist() == expected
    assert first == len(t) and borders.tolist() == [0.0, BIT, 2 * BIT]


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 2**32 - 1), st.integers(0, 400), st.floats(-2.0, 2.0))
def test_every_event_is_counted_once(seed, count, begin):
    random = np.random.default_rng(seed)
    t = np.sort(random.random(count)) * 50 * BIT
    polarity = random.choice(np.array([-1, 1], np.int8), count)
    counts, _, first = run(clock_at(begin * BIT), t, polarity, 60)
    # What lies before the first border goes to its bit.
    assert first == count and counts.sum() == count
    assert counts[:, :SUB_SLOTS].sum() == np.count_nonzero(polarity > 0)
    assert counts.shape == (60, COUNTS)


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 2**32 - 1), st.lists(st.integers(0, 2000), max_size=30), st.sampled_from([1, -1]))
def test_any_batching_gives_the_same_counts_and_the_same_clock(seed, cuts, sign):
    line = random_line(100, seed)
    t, polarity = events_of(line, RATE_BPS * 1.001, burst=15, width_bits=0.6)
    line = line if sign > 0 else 1 - line
    whole, parted = clock_at(), clock_at()
    expected, _, _ = run(whole, t, polarity, 120, sign, line=line)
    edges = [0, *sorted(min(cut, len(t)) for cut in cuts), len(t)]
    counts = []
    for start, stop in zip(edges[:-1], edges[1:], strict=True):
        first, batch = 0, (t[start:stop], polarity[start:stop])
        while True:
            first = take_events(parted, *batch, first, sign, True)
            if first == stop - start:
                break
            follow(parted, line, len(counts))
            counts.append(parted['counts'].copy())
            go_on(parted, 1)
    rest, _, _ = run(parted, t, polarity, 120 - len(counts), sign, first=len(t), line=line, since=len(counts))
    assert np.array_equal(np.concatenate([np.reshape(counts, (-1, COUNTS)), rest]), expected)
    assert parted.tobytes() == whole.tobytes()


# --- following ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize('late', [-0.2, -0.1, 0.1, 0.2])
def test_a_clock_that_began_beside_the_borders_comes_back(late):
    line = random_line(300)
    t, polarity = events_of(line)
    clock = clock_at(border=late * BIT)
    run(clock, t, polarity, 300, line=line)
    assert abs(off(clock)) < 0.02
    assert clock['period'] == pytest.approx(BIT, rel=2e-4)


@pytest.mark.parametrize('wrong', [-0.003, -0.001, 0.0, 0.001, 0.003])
def test_a_period_that_was_a_little_wrong_is_put_right(wrong):
    line = random_line(400)
    t, polarity = events_of(line, RATE_BPS * (1.0 + wrong))
    clock = clock_at()
    run(clock, t, polarity, 400, line=line)
    assert clock['period'] == pytest.approx(BIT / (1.0 + wrong), rel=1e-4)
    assert abs(off(clock, RATE_BPS * (1.0 + wrong))) < 0.02


@pytest.mark.parametrize('by', [-0.02, 0.02])
def test_a_clock_that_drifts_away_is_followed(by):
    # The rate goes to 2 % off within 2000 bits.
    bits = random_line(2500)
    changes = np.flatnonzero(np.diff(bits.astype(int))) + 1
    lengths = BIT / (1.0 + by * np.minimum(np.arange(2500) / 2000.0, 1.0))
    borders = np.concatenate([[0.0], np.cumsum(lengths)])
    t = (borders[changes][:, None] + np.arange(10) * 5e3).ravel()
    polarity = np.repeat(np.where(bits[changes] == 1, 1, -1), 10).astype(np.int8)
    clock = clock_at()
    _, found, _ = run(clock, t, polarity, 2450, line=bits)
    assert np.abs(found - borders[:2450]).max() < 0.1 * BIT
    assert clock['period'] == pytest.approx(BIT / (1.0 + by), rel=5e-4)


def test_the_period_does_not_leave_its_bounds():
    line = np.arange(3000) % 2
    t, polarity = events_of(line, RATE_BPS * 1.2)
    clock = clock_at()
    for n in range(3000):
        run(clock, t, polarity, 1, first=int(np.searchsorted(t, clock['border'])), line=line, since=n)
        assert BIT * (1.0 - PULL) <= clock['period'] <= BIT * (1.0 + PULL)


def test_each_polarity_has_its_own_latency():
    bits = random_line(2000)
    t, polarity = events_of(bits, burst=10, width_bits=0.01)
    t = t + np.where(polarity > 0, 0.20, 0.10) * BIT
    order = np.argsort(t, kind='stable')
    clock = clock_at(latencies=(0.15 * BIT, 0.15 * BIT))
    run(clock, t[order], polarity[order], 2000, line=bits)
    assert clock['latencies'][ON] - clock['latencies'][OFF] == pytest.approx(0.1 * BIT, abs=0.01 * BIT)
    assert clock['latencies'].sum() == pytest.approx(0.3 * BIT)  # their mean is the phase
    assert abs(off(clock)) < 0.02


def test_frozen_it_only_predicts():
    line = random_line(200)
    t, polarity = events_of(line, RATE_BPS * 1.003, t0_ns=100_000)
    clock = clock_at()
    clock['frozen'] = True
    counts, borders, first = run(clock, t, polarity, 220, line=line)
    assert np.array_equal(borders, BIT * np.arange(220))
    assert clock['period'] == BIT and (clock['latencies'] == 0.0).all()
    assert counts.sum() == first == len(t)  # it counts all the same


def test_three_events_are_no_edge_and_four_are():
    for count, moves in ((3, False), (4, True)):
        clock = clock_at()
        t = np.concatenate([np.arange(4) * 0.01, 2.1 + np.arange(count) * 0.1]) * BIT
        polarity = np.repeat([1, -1], [4, count]).astype(np.int8)
        run(clock, t, polarity, 5, line=[1, 1, 0, 0, 0])
        assert (clock['border'] != 5 * BIT) == moves
    assert 0.0 < clock['border'] - 5 * BIT < 0.1 * BIT + 1.0


def test_wrongly_decided_bits_do_not_move_it_far():
    line = random_line(400)
    t, polarity = events_of(line)
    decided = line ^ (np.random.default_rng(3).random(400) < 0.05)
    clock = clock_at()
    _, borders, _ = run(clock, t, polarity, 400, line=decided)
    assert np.abs(borders - np.arange(400) * BIT).max() < 0.05 * BIT


@pytest.mark.parametrize('ratio', [1.0, 2.0])
def test_background_does_not_move_it(ratio):
    random, line = np.random.default_rng(1), random_line(600)
    t, polarity = events_of(line, burst=20, width_bits=0.3)
    count = round(ratio * len(t))
    t = np.concatenate([t, random.random(count) * 600 * BIT])
    polarity = np.concatenate([polarity, random.choice(np.array([-1, 1], np.int8), count)])
    order = np.argsort(t, kind='stable')
    clock = clock_at(spread=0.1)
    _, borders, _ = run(clock, t[order], polarity[order], 600, line=line)
    assert np.abs(borders - np.arange(600) * BIT)[100:].max() < 0.1 * BIT


@pytest.mark.parametrize('late', [-0.3, -0.1, 0.1, 0.3])
def test_after_a_long_idle_line_a_fall_sets_the_phase_at_once(late):
    line = np.array([1, 1, 1, 0, 1, 0, 0, 1])
    t, polarity = events_of(line, burst=10, width_bits=0.01)
    clock = clock_at(border=late * BIT)
    clock['p_phase'] = (3.0 * UNSURE_PHASE) ** 2
    run(clock, t, polarity, 4)  # the fall is in the third or the fourth
    assert abs(off(clock)) < 0.02
    assert clock['p_phase'] < UNSURE_PHASE**2


# --- uncertainty --------------------------------------------------------------------------------------------------


def test_uncertainty_falls_with_edges_and_grows_without():
    line = random_line(200)
    t, polarity = events_of(line)
    clock = clock_at()
    known = [np.array([clock['p_phase'], clock['p_period']])]
    first = 0
    for since in (0, 100):
        _, _, first = run(clock, t, polarity, 100, first=first, line=line, since=since)
        known.append(np.array([clock['p_phase'], clock['p_period']]))
    assert (known[1] < known[0]).all() and known[2][1] < known[1][1]
    for _ in range(2):
        run(clock, t, polarity, 200, first=len(t))
        known.append(np.array([clock['p_phase'], clock['p_period']]))
    assert (known[3] > known[2]).all() and (known[4] > known[3]).all()
    # However long the silence is, phase and period are not unknown altogether, and the matrix stays one.
    go_on(clock, 10_000_000)
    assert all(np.isfinite(clock[name]).all() for name in clock.dtype.names)
    assert 0.0 < clock['p_phase'] <= 0.3**2 + 1e-12 and 0.0 < clock['p_period'] <= 0.003**2 + 1e-12
    assert clock['border'] == pytest.approx((600 + 10_000_000) * BIT, rel=1e-3)


def test_the_estimate_of_the_period_is_as_good_as_it_says():
    wrongs, deviations = [], []
    for seed in range(60):
        random = np.random.default_rng(seed)
        bits = random_line(300, seed)
        edges = np.flatnonzero(np.diff(bits.astype(int))) + 1
        at = (edges + random.normal(0.0, 0.05, len(edges))) * BIT
        t = (at[:, None] + np.arange(4) * 1.0).ravel()
        polarity = np.repeat(np.where(bits[edges] == 1, 1, -1), 4).astype(np.int8)
        clock = clock_at(period=BIT * (1.0 + random.normal(0.0, 1e-3)), period_error=1e-3)
        run(clock, t, polarity, 300, line=bits)
        wrongs.append(clock['period'] / BIT - 1.0)
        deviations.append(clock['p_period'] ** 0.5)
    # Edges jitter by 0.05 bit; the clock also allows for a drift that is not there.
    assert 0.3 < np.std(wrongs) / np.mean(deviations) < 1.3
