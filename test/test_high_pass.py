"""The high-pass filter and its levels."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from beacon_comm.core.high_pass import HighPassFilter
from beacon_comm.core.parameters import Parameters

FIXED = Parameters(levels='fixed', high_level=2.5, low_level=-1.5)
RATE_BPS = 1000.0
ALPHA_PER_NS = 2.0 * math.pi / 3.0 * RATE_BPS / 1e9


def edges_of(t_ns, polarity, parameters=FIXED, bit_rate_bps=RATE_BPS):
    edges = HighPassFilter(bit_rate_bps, parameters).push(np.array(t_ns, np.int64), np.array(polarity, np.int8))
    return list(zip(edges.t_ns.tolist(), edges.rising.tolist(), strict=True))


def random_events(seed, count=400, span_ns=20_000_000, t0_ns=0):
    random = np.random.default_rng(seed)
    t_ns = np.sort(random.integers(0, span_ns // 1000, count)) * 1000
    mood = np.sin(t_ns / 1e6)  # runs of one polarity, so that there are edges
    return t0_ns + t_ns, np.where(random.random(count) < 0.5 + 0.5 * mood, 1, -1).astype(np.int8)


def test_output_starts_high_and_has_hysteresis():
    # The level has to pass -1.5 to fall, and 2.5 to rise again; a second fall needs a rise first.
    assert edges_of([0, 0, 0], [1, 1, 1]) == []
    assert edges_of([0, 0, 0, 0], [-1, -1, -1, -1]) == [(0, False)]
    assert edges_of([0] * 7, [-1, -1, 1, 1, 1, 1, 1]) == [(0, False), (0, True)]
    assert edges_of([0] * 6, [-1, -1, 1, 1, 1, 1]) == [(0, False)]


def test_decays_over_the_gap_then_adds_then_compares():
    # One event leaves exp(-alpha dt); a second one makes it 1 + exp(-alpha dt) against the level of 1.5.
    longest = int(math.log(2.0) / ALPHA_PER_NS)
    assert edges_of([0, longest - 1], [-1, -1]) == [(longest - 1, False)]
    assert edges_of([0, longest + 1], [-1, -1]) == []


def test_cutoff_scales_with_the_bit_rate():
    longest = int(math.log(2.0) / ALPHA_PER_NS)
    assert edges_of([0, longest // 4 - 1], [-1, -1], bit_rate_bps=4 * RATE_BPS) == [(longest // 4 - 1, False)]
    assert edges_of([0, longest // 4 + 2], [-1, -1], bit_rate_bps=4 * RATE_BPS) == []
    slow = Parameters(levels='fixed', high_level=2.5, low_level=-1.5, cutoff_per_bit=1.0 / 3.0)
    assert edges_of([0, 5 * longest], [-1, -1], slow) == [(5 * longest, False)]


@pytest.mark.parametrize('size', [10, 100, 1000])
def test_adaptive_levels_follow_the_amplitude(size):
    # A fall and a rise of the same size, then a dip of a share of it: an edge above low_share, none below.
    parameters = Parameters(high_share=0.5, low_share=0.4, least_level=0.0, amplitude_memory_bits=1e6)
    t_ns = np.repeat(np.array([0, 20_000_000]), size)  # 20 bits apart: the filter is back at 0
    polarity = np.repeat(np.array([-1, 1]), size)

    def dip(count):
        edges = edges_of(np.append(t_ns, [40_000_000] * count), np.append(polarity, [-1] * count), parameters)
        return sum(t == 40_000_000 for t, _ in edges)

    assert dip(int(0.4 * size) - 1) == 0
    assert dip(int(0.4 * size) + 1) == 1


def test_amplitude_fades_with_its_time_constant():
    parameters = Parameters(high_share=0.5, low_share=0.4, least_level=0.0, amplitude_memory_bits=10.0)
    big = [0] * 100
    # After 10 memories (100 bits) the amplitude of 50 has faded to nothing: two events are a fall, after 10 bits not.
    assert edges_of(big + [100_000_000] * 2, [1] * 100 + [-1] * 2, parameters) == [(100_000_000, False)]
    assert edges_of(big + [10_000_000] * 2, [1] * 100 + [-1] * 2, parameters) == []


def test_single_events_are_no_edges_on_a_silent_line():
    t_ns = np.arange(0, 1_000_000_000, 1_500_000)
    polarity = np.where(np.arange(len(t_ns)) % 2, 1, -1)
    assert edges_of(t_ns, polarity, Parameters()) == []
    assert edges_of([0, 0], [-1, -1], Parameters()) == []  # least_level: two events do not pass 2.0
    assert edges_of([0, 0, 0], [-1, -1, -1], Parameters()) == [(0, False)]


def test_edges_take_turns_and_have_the_documented_types():
    t_ns, polarity = random_events(0)
    edges = HighPassFilter(RATE_BPS, Parameters()).push(t_ns, polarity)
    assert edges.t_ns.dtype == np.int64 and edges.rising.dtype == np.bool_
    assert len(edges.t_ns) > 4
    assert np.all(edges.rising == (np.arange(len(edges.rising)) % 2 == 1))
    assert np.all(np.isin(edges.t_ns, t_ns))


@pytest.mark.parametrize('parameters', [Parameters(), FIXED])
def test_clock_may_start_anywhere(parameters):
    expected = edges_of(*random_events(1), parameters)
    shifted = edges_of(*random_events(1, t0_ns=2**40), parameters)
    assert [(t - 2**40, rising) for t, rising in shifted] == expected


@settings(max_examples=50, deadline=None)
@given(st.integers(0, 1000), st.lists(st.integers(0, 400), max_size=8), st.sampled_from([Parameters(), FIXED]))
def test_any_batching_gives_the_same_edges(seed, cuts, parameters):
    t_ns, polarity = random_events(seed)
    line = HighPassFilter(RATE_BPS, parameters)
    parts = [line.push(t, p) for t, p in zip(np.split(t_ns, sorted(cuts)), np.split(polarity, sorted(cuts)), strict=True)]
    got = [edge for part in parts for edge in zip(part.t_ns.tolist(), part.rising.tolist(), strict=True)]
    assert got == edges_of(t_ns, polarity, parameters)
