"""The motion filter on observations made by hand."""

import numpy as np
import pytest

from beacon_comm.core import motion


def row(x: float = 0.0, y: float = 0.0, speed_variance: float = 1e4) -> np.ndarray:
    state = np.zeros(motion.WIDTH)
    motion.begin(state, 0.0, x, y, 0.0, 0.0, 1.0, speed_variance)
    return state


def predicted(state: np.ndarray, t_s: float) -> np.ndarray:
    s = motion.fading_s(t_s - state[motion.T])
    return np.array([state[motion.X] + s * state[motion.VX], state[motion.Y] + s * state[motion.VY]])


def follow(state: np.ndarray, path, times, deviation: float, seed: int = 0) -> list[tuple[float, float, float]]:
    """Observe a path; return error, normalised error squared and variance of each prediction."""
    random = np.random.default_rng(seed)
    found = []
    for t_s in times:
        error = predicted(state, t_s) - path(t_s)
        variance = motion.variance_at(state, t_s - state[motion.T])
        found.append((float(np.hypot(*error)), float(error @ error / variance / 2), variance))
        seen = path(t_s) + random.normal(0.0, deviation, 2) - predicted(state, t_s)
        motion.observe(state, t_s, *seen, deviation**2)
    return found


@pytest.mark.parametrize('speed', [0.0, 500.0, 5000.0])
def test_uniform_motion_is_foreseen_as_well_as_it_says(speed: float) -> None:
    times = np.arange(1, 400) * 1e-3
    late = [
        follow(row(speed_variance=speed**2 + 100), lambda t: np.array([speed * t, -speed * t]), times, 0.3, seed)[200:]
        for seed in range(20)
    ]
    error, normalised, _ = np.concatenate(late).T
    assert np.sqrt(np.mean(error**2)) < 0.2
    assert 0.4 < normalised.mean() < 1.1  # cautious: other models of motion stay possible


@pytest.mark.parametrize('speed', [500.0, 2000.0, 11_000.0])
def test_something_that_turns_back_is_followed_within_milliseconds(speed: float) -> None:
    times = np.arange(1, 300) * 5e-4
    found = follow(row(speed_variance=speed**2), lambda t: np.array([speed * (0.1 - abs(t - 0.1)), 0.0]), times, 0.3)
    after = [error for t_s, (error, _, _) in zip(times, found, strict=True) if t_s > 0.104]
    assert max(after) < 2.0


def test_a_circle_is_followed() -> None:
    speed, radius = 2000.0, 200.0
    times = np.arange(1, 800) * 5e-4
    path = lambda t: radius * np.array([np.cos(t * speed / radius), np.sin(t * speed / radius)])  # noqa: E731
    found = follow(row(radius, 0.0, speed**2), path, times, 0.3)
    assert np.sqrt(np.mean([error**2 for error, _, _ in found[400:]])) < 0.6


def test_time_may_be_counted_from_anywhere() -> None:
    one, other = row(), row()
    motion.observe(one, 0.02, 1.0, 2.0, 0.1)
    motion.rebase(other, 5.0)
    motion.observe(other, 0.02 - 5.0, 1.0, 2.0, 0.1)
    np.testing.assert_allclose(one[motion.X : motion.NOISE + 1], other[motion.X : motion.NOISE + 1])


def test_a_late_observation_counts_as_of_now() -> None:
    state = row()
    motion.observe(state, 0.02, 0.0, 0.0, 0.1)
    motion.observe(state, 0.01, 0.5, 0.0, 0.1)
    assert state[motion.T] == 0.02 and 0.0 < state[motion.X] < 0.5
