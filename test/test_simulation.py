"""The LED model: close to the measured signal in what it claims, and repeatable."""

from pathlib import Path

import numpy as np
import pytest

from beacon_comm.core.errors import FramingError, ParameterError
from beacon_comm.core.events import NS_PER_S
from beacon_comm.core.framing import CharacterFrame, transitions
from beacon_comm.recordings.mat import read_mat
from beacon_comm.simulation.led import noise, sensor_noise, simulate_levels, simulate_text, square_wave

TEXT = "Shall I compare thee to a summer's day?\n" * 5


@pytest.mark.parametrize('bit_rate_bps', [504.0, 3125.0])
def test_counts_are_near_the_real_signal(data_folder: Path, bit_rate_bps: float) -> None:
    t_ns, polarity = simulate_text(TEXT, bit_rate_bps, lead_s=0.0, tail_s=0.0)
    real_t_ns, real_polarity = read_mat(data_folder / f'{bit_rate_bps:.0f}hz_30m.mat')
    real_s = (real_t_ns[-1] - real_t_ns[0]) / NS_PER_S
    assert len(t_ns) / (len(TEXT) * 11) == pytest.approx(len(real_t_ns) / real_s / bit_rate_bps, rel=0.1)
    ratio, real_ratio = (np.sum(p > 0) / np.sum(p < 0) for p in (polarity, real_polarity))
    assert ratio == pytest.approx(real_ratio, rel=0.12)


def test_events_carry_the_bits() -> None:
    """Bursts of ON follow rises, bursts of OFF follow falls, at 504 bps nearly all within half a bit."""
    bits = CharacterFrame().encode_bits(TEXT)
    changes_ns, levels = transitions(bits, 504.0)
    t_ns, polarity = simulate_text(TEXT, 504.0)
    for k in range(0, len(changes_ns), 7):
        near = polarity[(t_ns > changes_ns[k] + 100_000) & (t_ns < changes_ns[k] + 990_000)]
        sign = 1 if levels[k] else -1
        assert np.sum(near == sign) > 40
        assert np.mean(near == sign) > 0.95


def test_a_held_level_goes_on_giving_its_polarity() -> None:
    for level, sign in ((1, 1), (0, -1)):
        changes = np.array([NS_PER_S], np.int64)
        t_ns, polarity = simulate_levels(changes, np.array([level], np.uint8), 0, 3 * NS_PER_S)
        held = polarity[t_ns > 2 * NS_PER_S]
        assert len(held) > 1000 and np.mean(held == sign) > 0.75


@pytest.mark.parametrize(('frequency_hz', 'duty'), [(50.0, 0.1), (120.0, 0.5), (1000.0, 0.9)])
def test_square_wave(frequency_hz: float, duty: float) -> None:
    t_ns, polarity = square_wave(frequency_hz, duty, 1.0, t0_ns=2**40, seed=3)
    assert t_ns[0] >= 2**40 - 1000 and t_ns[-1] < 2**40 + NS_PER_S
    assert np.all(np.diff(t_ns) >= 0)
    # Where a burst's delay has passed, events are of the level's polarity; before that, still of the other one.
    phase_s = np.mod((t_ns - 2**40) * 1e-9, 1.0 / frequency_hz)
    high = (phase_s > 130e-6) & (phase_s < duty / frequency_hz + 100e-6)
    low = (phase_s > duty / frequency_hz + 130e-6) | (phase_s < 100e-6)
    assert np.sum(high) > 50 * frequency_hz and np.mean(polarity[high] > 0) > 0.9
    assert np.sum(low) > 5 * frequency_hz and np.mean(polarity[low] < 0) > 0.9


def test_noise() -> None:
    t_ns, polarity = noise(10_000.0, 2.0, on_share=0.25, t0_ns=5 * NS_PER_S, seed=4)
    assert len(t_ns) == pytest.approx(20_000, abs=600)
    assert t_ns[0] >= 5 * NS_PER_S and t_ns[-1] < 7 * NS_PER_S and np.all(np.diff(t_ns) >= 0)
    assert np.mean(polarity > 0) == pytest.approx(0.25, abs=0.02)
    batch = sensor_noise(10_000.0, 1.0, 64, 48, seed=4)
    assert (batch.x.max(), batch.y.max()) == (63, 47) and batch.t_end_ns == NS_PER_S
    assert len(np.unique(batch.x.astype(int) * 48 + batch.y)) > 2500


def test_seeds_repeat() -> None:
    first, again, other = (simulate_text('abc', 504.0, seed=seed) for seed in (1, 1, 2))
    assert np.array_equal(first[0], again[0]) and np.array_equal(first[1], again[1])
    assert not np.array_equal(first[0][:50], other[0][:50])
    assert first[0].dtype == np.int64 and first[1].dtype == np.int8
    assert not np.any(first[0] % 1000)


def test_what_cannot_be_is_refused() -> None:
    with pytest.raises(FramingError, match="'é'"):
        simulate_text('é', 504.0)
    for duty in (0.0, 1.0):
        with pytest.raises(ParameterError, match='duty'):
            square_wave(100.0, duty, 1.0)
    with pytest.raises(ParameterError, match='frequency'):
        square_wave(0.0, 0.5, 1.0)
    with pytest.raises(ParameterError, match='must increase'):
        simulate_levels(np.array([2, 1]), np.array([1, 0]), 0, 10)
    with pytest.raises(ParameterError, match='alternate'):
        simulate_levels(np.array([1, 2]), np.array([1, 1]), 0, 10)
