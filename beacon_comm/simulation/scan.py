"""When a row's requests are seen: the arbiter comes by every row in turn, at its own pace.

    scans  │←  scan_us  →│←   a little   →│←   more   →│
    row r      ┊ φ_r          ┊                ┊                 φ_r = r · scan_row_us, modulo scan_us
    request          ×───────→ seen: the event's time; only then is the pixel reset

A pixel can fire at most once a scan, and the pixels of a spot fire together: bursts that are locked to the scans, not to
the light.  Row arbiters hand a token on from row to row (Boahen 2000; Finateu et al. 2020); that the token needs so long,
and goes on at its own pace, is what the recordings show (docs/simulator.md): no literature was found for the figure.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from beacon_comm.simulation.description import Sensor
from beacon_comm.simulation.trajectory import Floats

_AHEAD_NS = 20_000_000
_CHUNK = 1024


class Scan:
    """The scans of one sensor; none if its ``scan_us`` is 0."""

    def __init__(self, sensor: Sensor, random: np.random.Generator) -> None:
        self._random = random
        self._mean_ns = sensor.scan_us * 1e3
        self._jitter = sensor.scan_jitter
        self.phase_ns = np.zeros(sensor.height)
        if self._mean_ns:
            self.phase_ns = np.remainder(np.arange(sensor.height) * sensor.scan_row_us * 1e3, self._mean_ns)
        self._begins_ns = np.array([-2.0 * self._mean_ns])

    def begins_ns(self, from_ns: float) -> Floats:
        """Return the begins of the scans from shortly before ``from_ns`` to far behind it; empty without scans.

        Calls go forward in time.
        """
        if not self._mean_ns:
            return np.empty(0)
        while self._begins_ns[-1] < from_ns + _AHEAD_NS:
            steps = self._mean_ns * np.maximum(1.0 + self._jitter * self._random.normal(size=_CHUNK), 0.2)
            self._begins_ns = np.concatenate((self._begins_ns, self._begins_ns[-1] + np.cumsum(steps)))
        first = np.searchsorted(self._begins_ns, from_ns - 3.0 * self._mean_ns) - 1
        self._begins_ns = self._begins_ns[max(int(first), 0) :]
        return self._begins_ns

    def seen_ns(self, t_ns: NDArray[np.int64], row: NDArray[np.uint16], from_ns: int) -> NDArray[np.int64]:
        """Return when requests, none before ``from_ns``, are seen (ns)."""
        begins_ns = self.begins_ns(from_ns)
        return t_ns if not len(begins_ns) else _all_seen(t_ns, row, begins_ns, self.phase_ns)


@njit(cache=True, nogil=True)
def seen(t_ns, phase_ns, begins_ns):  # type: ignore[no-untyped-def]
    """Return when a request is seen by a row of a phase."""
    return begins_ns[np.searchsorted(begins_ns, t_ns - phase_ns)] + phase_ns


@njit(cache=True, nogil=True)
def _all_seen(t_ns, row, begins_ns, phase_ns):  # type: ignore[no-untyped-def]
    out = np.empty(len(t_ns), np.int64)
    for k in range(len(t_ns)):
        out[k] = np.int64(seen(float(t_ns[k]), phase_ns[row[k]], begins_ns))
    return out
