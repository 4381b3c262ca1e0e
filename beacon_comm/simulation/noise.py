"""Events without light: background activity and leakage of every pixel, and hot pixels, as Poisson processes.

Noise events of a dark, still scene are near Poisson in each pixel, and a few pixels fire far more often than the others
[Hu 2021]; leakage adds ON events [Nozaki 2017].  Under a light the pixels' own noise comes on top of it.
"""

from __future__ import annotations

import numpy as np

from beacon_comm.simulation.description import Sensor
from beacon_comm.simulation.pixels import RawEvents


class SensorNoise:
    """Draws the noise of a sensor, piece by piece."""

    def __init__(self, sensor: Sensor, random: np.random.Generator) -> None:
        self._sensor = sensor
        self._random = random
        pixels = sensor.width * sensor.height
        self._hot = random.choice(pixels, int(random.binomial(pixels, sensor.hot_share)), replace=False)
        self._hot_on = random.random(len(self._hot)) < 0.5  # a hot pixel is hot in one direction
        self._rate_hz = pixels * (sensor.noise_hz + sensor.leak_hz)

    def piece(self, begin_ns: int, end_ns: int) -> RawEvents:
        """Return the noise of a piece of time (ns), not in order."""
        sensor, random = self._sensor, self._random
        span_s = (end_ns - begin_ns) * 1e-9
        even = int(random.poisson(self._rate_hz * span_s))
        on_share = (0.5 * sensor.noise_hz + sensor.leak_hz) / max(sensor.noise_hz + sensor.leak_hz, 1e-12)
        hot = np.repeat(np.arange(len(self._hot)), random.poisson(sensor.hot_hz * span_s, len(self._hot)))
        pixel = np.concatenate((random.integers(sensor.width * sensor.height, size=even), self._hot[hot]))
        on = np.concatenate((random.random(even) < on_share, self._hot_on[hot]))
        t_ns = begin_ns + np.floor(random.random(len(pixel)) * (end_ns - begin_ns)).astype(np.int64)
        return (
            t_ns,
            (pixel % sensor.width).astype(np.uint16),
            (pixel // sensor.width).astype(np.uint16),
            np.where(on, 1, -1).astype(np.int8),
        )
