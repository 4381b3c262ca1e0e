"""Paths that a scene file can name, as polylines: still, line (bouncing), circle, waypoints; and a hand-held camera's.

    line    ·──→ speed, direction; turns back at the borders        circle   ( · )  radius, speed
    speed   v, or [v0, v1]: v0 until ramp_s[0], then even acceleration, v1 from ramp_s[1] on

A curve gets a knot so often that its chord strays less than ``STRAY_PX``: sagitta = (angle)²/8 · radius.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from beacon_comm.core.errors import ParameterError
from beacon_comm.core.events import NS_PER_S
from beacon_comm.simulation.keys import key, number, number_or_list, numbers, rows
from beacon_comm.simulation.trajectory import STRAY_PX, Floats, Trajectory

_MAX_SPEED = 50_000.0


@dataclass(frozen=True, slots=True)
class Still:
    """Stays where it is."""

    at_px: tuple[float, float] = key(numbers(2), 'px', 'where: x, y; the middle of the first pixel is 0, 0')

    def trajectory(self, duration_s: float, width: int, height: int) -> Trajectory:
        """Return the path for a scene of ``duration_s`` (s) on a sensor of ``width`` × ``height`` (px)."""
        return Trajectory.still(*self.at_px)


def _speed_key() -> tuple[float, ...]:
    value: tuple[float, ...] = key(
        number_or_list(2), 'px/s', 'speed; or two: until ramp_s[0], and from ramp_s[1] on', low=0, high=_MAX_SPEED
    )
    return value


@dataclass(frozen=True, slots=True)
class Line:
    """Runs straight and turns back at the borders, ``margin_px`` inside of them."""

    from_px: tuple[float, float] = key(numbers(2), 'px', 'where it is at the beginning: x, y')
    speed_px_per_s: tuple[float, ...] = _speed_key()
    direction_deg: float = key(number, 'degrees', 'where it goes first: 0 to the right, 90 downwards', 0.0, low=-360, high=360)
    margin_px: float = key(number, 'px', 'how far from the outer pixels its centre turns back', 8.0, low=0, high=1000)
    ramp_s: tuple[float, float] = key(numbers(2), 's', 'begin and end of the change of speed', (0.0, 0.0), low=0, high=86400)

    def __post_init__(self) -> None:
        _check_ramp(self.speed_px_per_s, self.ramp_s)

    def trajectory(self, duration_s: float, width: int, height: int) -> Trajectory:
        """Return the path for a scene of ``duration_s`` (s) on a sensor of ``width`` × ``height`` (px)."""
        angle = math.radians(self.direction_deg)
        ways = (math.cos(angle), math.sin(angle))
        sizes = (width, height)
        for name, at, size in zip('xy', self.from_px, sizes, strict=True):
            if not self.margin_px <= at <= size - 1 - self.margin_px:
                raise ParameterError(
                    f'from_px = {list(self.from_px)}: {name} must lie in [{self.margin_px:g}, {size - 1 - self.margin_px:g}]'
                    f' of the {width}×{height} sensor'
                )
        run = _Run(self.speed_px_per_s, self.ramp_s, duration_s)
        turns = [run.knots_s(lambda speed, _: math.inf)]
        for at, way, size in zip(self.from_px, ways, sizes, strict=True):
            if abs(way) > 1e-9:
                span = size - 1 - 2 * self.margin_px
                to_wall = (size - 1 - self.margin_px - at if way > 0 else at - self.margin_px) / abs(way)
                turns.append(run.when(np.arange(to_wall, float(run.length(duration_s)), max(span, 1e-3) / abs(way))))
        t_s = np.unique(np.concatenate(turns))
        lengths = run.length(t_s)
        x, y = (
            _folded(at + way * lengths, self.margin_px, size - 1 - self.margin_px)
            for at, way, size in zip(self.from_px, ways, sizes, strict=True)
        )
        return _trajectory(t_s, x, y)


@dataclass(frozen=True, slots=True)
class Circle:
    """Runs round a centre, clockwise as one sees it."""

    centre_px: tuple[float, float] = key(numbers(2), 'px', 'the middle of the circle: x, y')
    radius_px: float = key(number, 'px', 'its radius', low=0.1, high=5000)
    speed_px_per_s: tuple[float, ...] = _speed_key()
    from_deg: float = key(number, 'degrees', 'where it begins: 0 to the right of the centre, 90 below', 0.0, low=-360, high=360)
    ramp_s: tuple[float, float] = key(numbers(2), 's', 'begin and end of the change of speed', (0.0, 0.0), low=0, high=86400)

    def __post_init__(self) -> None:
        _check_ramp(self.speed_px_per_s, self.ramp_s)

    def trajectory(self, duration_s: float, width: int, height: int) -> Trajectory:
        """Return the path for a scene of ``duration_s`` (s)."""
        run = _Run(self.speed_px_per_s, self.ramp_s, duration_s)
        chord = math.sqrt(8.0 * STRAY_PX * self.radius_px)
        t_s = run.knots_s(lambda speed, _: chord / speed)
        angle = math.radians(self.from_deg) + run.length(t_s) / self.radius_px
        return _trajectory(
            t_s, self.centre_px[0] + self.radius_px * np.cos(angle), self.centre_px[1] + self.radius_px * np.sin(angle)
        )


@dataclass(frozen=True, slots=True)
class Waypoints:
    """Runs straight from point to point; stays at the last."""

    points: tuple[tuple[float, float, float], ...] = key(rows(3, '[time_s, x_px, y_px]'), 's, px, px', 'time, x and y of each')

    def __post_init__(self) -> None:
        times = [point[0] for point in self.points]
        if not times or any(b <= a for a, b in zip(times, times[1:], strict=False)):
            raise ParameterError('points: needs at least one, with increasing times')

    def trajectory(self, duration_s: float, width: int, height: int) -> Trajectory:
        """Return the path; the scene's duration does not matter."""
        t, x, y = np.array(self.points, np.float64).T
        return _trajectory(t, x, y)


PathKind = Still | Line | Circle | Waypoints
PATHS: dict[str, type] = {'still': Still, 'line': Line, 'circle': Circle, 'waypoints': Waypoints}

# Physiological and driving shake lies below some 15 Hz; three sines a direction make it irregular.
_SHARES = ((1.0, 0.60), (1.73, 0.30), (0.41, 0.25))


@dataclass(frozen=True, slots=True)
class Shake:
    """A camera that is held by hand, or on a robot that moves: the whole image shifts."""

    amplitude_px: float = key(number, 'px', 'rms of the shift, in each direction', 0.0, low=0, high=500)
    frequency_hz: float = key(number, 'Hz', 'its main frequency', 6.0, low=0.1, high=100)
    pan_px_per_s: tuple[float, float] = key(
        numbers(2),
        'px/s',
        'a steady motion besides: texture and beacons move with it',
        (0.0, 0.0),
        low=-5000,
        high=5000,
    )

    def trajectory(self, duration_s: float, seed: int) -> Trajectory | None:
        """Return by how much the image is shifted (px), None if it is not; the same seed gives the same motion."""
        if self.amplitude_px == 0.0 and self.pan_px_per_s == (0.0, 0.0):
            return None
        random = np.random.default_rng([seed, 71])
        norm = self.amplitude_px / math.sqrt(sum(share**2 for _, share in _SHARES) / 2)
        highest = 2 * math.pi * self.frequency_hz * max(ratio for ratio, _ in _SHARES)
        acceleration = max(norm * highest**2, 1e-9)
        step_s = min(math.sqrt(8.0 * STRAY_PX / acceleration), 0.05)
        t_s = np.linspace(0.0, duration_s, max(math.ceil(duration_s / step_s), 1) + 1)
        shift = []
        for pan in self.pan_px_per_s:
            phases = random.uniform(0.0, 2 * math.pi, len(_SHARES))
            waves = [
                share * (np.sin(2 * math.pi * self.frequency_hz * ratio * t_s + phase) - math.sin(phase))
                for (ratio, share), phase in zip(_SHARES, phases, strict=True)
            ]
            shift.append(norm * np.sum(waves, axis=0) + pan * t_s)
        return _trajectory(t_s, shift[0], shift[1])


class _Run:
    """How far along its way something is: steady, then evenly accelerated, then steady."""

    def __init__(self, speeds: tuple[float, ...], ramp_s: tuple[float, float], duration_s: float) -> None:
        self._v0, self._v1 = speeds[0], speeds[-1]
        self._t0, self._t1 = ramp_s if len(speeds) == 2 else (0.0, 0.0)
        self._end_s = duration_s

    def speed(self, t_s: float) -> float:
        if t_s >= self._t1:
            return self._v1
        if t_s <= self._t0:
            return self._v0
        return self._v0 + (self._v1 - self._v0) * (t_s - self._t0) / (self._t1 - self._t0)

    def length(self, t_s: Floats | float) -> Floats:
        t = np.asarray(t_s, np.float64)
        within = np.clip(t, self._t0, self._t1) - self._t0
        gain = (self._v1 - self._v0) / max(self._t1 - self._t0, 1e-12)
        before, after = np.minimum(t, self._t0), np.maximum(t - self._t1, 0.0)
        return np.asarray(self._v0 * before + self._v0 * within + 0.5 * gain * within**2 + self._v1 * after)

    def when(self, lengths: Floats) -> Floats:
        """Return when it has come so far; the inverse of :meth:`length`, by bisection."""
        low, high = np.zeros_like(lengths), np.full_like(lengths, self._end_s)
        for _ in range(60):
            middle = 0.5 * (low + high)
            short = self.length(middle) < lengths
            low, high = np.where(short, middle, low), np.where(short, high, middle)
        return high

    def knots_s(self, longest_s: object) -> Floats:
        """Return times from 0 to the end, at most ``longest_s(speed, t)`` apart and dense where the speed changes."""
        times = [0.0]
        while times[-1] < self._end_s:
            t = times[-1]
            speed = max(self.speed(t), self.speed(t + 1e-3), 1e-9)
            step = min(longest_s(speed, t), self._end_s - t)  # type: ignore[operator]
            if self._t0 <= t < self._t1:  # chord of an accelerated stretch: a t²/8
                change = abs(self._v1 - self._v0) / (self._t1 - self._t0)
                step = min(step, math.sqrt(8.0 * STRAY_PX / max(change, 1e-9)))
            elif t < self._t0:
                step = min(step, self._t0 - t)
            times.append(t + max(step, 1e-6))
        return np.array(times)


def _check_ramp(speeds: tuple[float, ...], ramp_s: tuple[float, float]) -> None:
    if len(speeds) == 2 and ramp_s[1] <= ramp_s[0]:
        raise ParameterError(f'ramp_s = {list(ramp_s)}: with two speeds, must be a begin and a later end')


def _trajectory(t_s: Floats, x: Floats, y: Floats) -> Trajectory:
    t_ns, first = np.unique(np.rint(t_s * NS_PER_S).astype(np.int64), return_index=True)
    return Trajectory(t_ns, np.asarray(x, np.float64)[first], np.asarray(y, np.float64)[first])


def _folded(position: Floats, low: float, high: float) -> Floats:
    span = high - low
    if span <= 0.0:
        return np.full_like(position, low)
    phase = np.mod(position - low, 2.0 * span)
    return np.asarray(low + np.where(phase > span, 2.0 * span - phase, phase))
