"""A path over the sensor as a polyline: straight between knots, still before the first and after the last.

    x, y  ·────·          ┌ a bounce is a knot: exact
               \\        ·────·
                ·───────· ┘            a curve has knots so dense that it strays less than STRAY_PX

What is simulated and what the truth says are the same polyline, so that the truth is exact whatever the curve was.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

Floats = NDArray[np.float64]
Times = NDArray[np.int64]

STRAY_PX = 0.01


@dataclass(frozen=True, slots=True, eq=False)
class Trajectory:
    """A polyline in time; the middle of the first pixel is (0, 0).

    Attributes:
        t_ns: knots (ns, increasing), ``(k,)`` int64, at least one.
        x_px, y_px: where it is then (px), ``(k,)`` float64.
    """

    t_ns: Times
    x_px: Floats
    y_px: Floats

    @classmethod
    def still(cls, x_px: float, y_px: float) -> Trajectory:
        """Return a path that stays at one point."""
        return cls(np.zeros(1, np.int64), np.array([x_px], np.float64), np.array([y_px], np.float64))

    def at(self, t_ns: ArrayLike) -> tuple[Floats, Floats]:
        """Return ``(x, y)`` (px) at times (ns, any shape), float64 of that shape."""
        t = np.asarray(t_ns, np.float64)
        return np.interp(t, self.t_ns, self.x_px), np.interp(t, self.t_ns, self.y_px)

    def plus(self, other: Trajectory) -> Trajectory:
        """Return the sum of two paths: one moves on top of the other."""
        t_ns = np.union1d(self.t_ns, other.t_ns)
        x, y = self.at(t_ns)
        dx, dy = other.at(t_ns)
        return Trajectory(t_ns, x + dx, y + dy)

    def speed_px_per_s(self) -> float:
        """Return the greatest speed between two knots (px/s)."""
        if len(self.t_ns) < 2:
            return 0.0
        return float(np.max(np.hypot(np.diff(self.x_px), np.diff(self.y_px)) / np.diff(self.t_ns) * 1e9))
