"""A disc of pixels that moves and bounces: where the events of a recording without pixels are put.

    centre(t) = start + velocity · t, folded at the borders      ┌──────────────┐
    (the disc's rim touches the outer pixels and turns back)     │  ( · ) →     │
                                                                 └──────────────┘
Every event gets a point drawn uniformly from the disc's area around the centre at its own time; its pixel is the one
that holds the point.  The blob of the real recordings has some 49 pixels: a disc of radius 4.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from beacon_comm.core.errors import ParameterError
from beacon_comm.simulation.trajectory import Trajectory

DEFAULT_RADIUS_PX = 4.0


@dataclass(frozen=True, slots=True)
class Disc:
    """A disc on a sensor.

    Attributes:
        x_px, y_px: its centre at time 0; the middle of the first pixel is (0, 0).
        radius_px: its radius.
        vx_px_per_s, vy_px_per_s: its velocity at time 0.
        width, height: the sensor's size (pixels).

    Raises:
        ParameterError: the disc does not lie on the sensor.
    """

    x_px: float
    y_px: float
    radius_px: float
    vx_px_per_s: float
    vy_px_per_s: float
    width: int
    height: int

    def __post_init__(self) -> None:
        values = (self.x_px, self.y_px, self.radius_px, self.vx_px_per_s, self.vy_px_per_s)
        if not all(math.isfinite(value) for value in values) or self.radius_px <= 0:
            raise ParameterError(f'disc {self.text()}: needs finite numbers and a radius above 0')
        if 2 * self.radius_px > min(self.width, self.height) - 1:
            raise ParameterError(f'disc {self.text()}: does not fit on the {self.width}×{self.height} sensor')
        for name, at, size in (('x', self.x_px, self.width), ('y', self.y_px, self.height)):
            if not self.radius_px <= at <= size - 1 - self.radius_px:
                raise ParameterError(
                    f'disc {self.text()}: with its radius, {name} must lie in '
                    f'[{self.radius_px:g}, {size - 1 - self.radius_px:g}] px of the {self.width}×{self.height} sensor'
                )

    @classmethod
    def parse(cls, text: str, width: int, height: int) -> Disc:
        """Read ``x,y[,radius[,vx,vy]]`` (px, px/s).

        Raises:
            ParameterError: not such a text, or the disc does not lie on the sensor.
        """
        try:
            numbers = [float(part) for part in text.split(',')]
        except ValueError:
            numbers = []
        if len(numbers) not in (2, 3, 5):
            raise ParameterError(f'disc {text!r}: must be x,y[,radius[,vx,vy]] in px and px/s')
        x, y, radius, vx, vy = [*numbers, *(DEFAULT_RADIUS_PX, 0.0, 0.0)[len(numbers) - 2 :]]
        return cls(x, y, radius, vx, vy, width, height)

    def text(self) -> str:
        """Return the disc as :meth:`parse` reads it."""
        values = (self.x_px, self.y_px, self.radius_px, self.vx_px_per_s, self.vy_px_per_s)
        return ','.join(f'{value:g}' for value in values)

    def centre(self, t_s: ArrayLike) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the true centre ``(x, y)`` at times ``t_s`` (s, any shape) as two float64 arrays of that shape."""
        t = np.asarray(t_s, np.float64)
        x = _folded(self.x_px + self.vx_px_per_s * t, self.radius_px, self.width - 1 - self.radius_px)
        y = _folded(self.y_px + self.vy_px_per_s * t, self.radius_px, self.height - 1 - self.radius_px)
        return x, y

    def trajectory(self, until_s: float) -> Trajectory:
        """Return the path from time 0 to ``until_s`` (s): the knots are the bounces."""
        turns = [np.array([0.0, until_s])]
        for at, speed, size in ((self.x_px, self.vx_px_per_s, self.width), (self.y_px, self.vy_px_per_s, self.height)):
            span = size - 1 - 2 * self.radius_px
            if speed and span:
                to_wall = (size - 1 - self.radius_px - at if speed > 0 else at - self.radius_px) / abs(speed)
                turns.append(np.arange(to_wall, until_s, span / abs(speed)))
        t_ns = np.unique(np.rint(np.concatenate(turns) * 1e9).astype(np.int64))
        return Trajectory(t_ns, *self.centre(t_ns * 1e-9))

    def pixels(self, t_ns: NDArray[np.int64], seed: int | list[int]) -> tuple[NDArray[np.uint16], NDArray[np.uint16]]:
        """Return a pixel for each event at ``t_ns`` (ns since time 0, ``(n,)``): ``(x, y)``, each ``(n,)`` uint16.

        The same times and seed give the same pixels.
        """
        random = np.random.default_rng(seed)
        distance = self.radius_px * np.sqrt(random.random(len(t_ns)))  # the root makes it uniform over the area
        angle = 2.0 * np.pi * random.random(len(t_ns))
        x, y = self.centre(t_ns * 1e-9)
        return (
            np.rint(x + distance * np.cos(angle)).astype(np.uint16),
            np.rint(y + distance * np.sin(angle)).astype(np.uint16),
        )


def _folded(position: NDArray[np.float64], low: float, high: float) -> NDArray[np.float64]:
    """Fold a straight path back and forth between two borders."""
    span = high - low
    if span == 0.0:
        return np.full_like(position, low)
    phase = np.mod(position - low, 2.0 * span)
    return low + np.where(phase > span, 2.0 * span - phase, phase)
