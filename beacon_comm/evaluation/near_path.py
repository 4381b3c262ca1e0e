"""Events near a track's path: what a camera saw of one beacon, however the receiver fared with it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from beacon_comm.core.events import EventBatch
from beacon_comm.evaluation.held import Signal
from beacon_comm.evaluation.result import PathPoint


class NearPath:
    """Collects the events of batches that lie near a path; before and after it the beacon is taken to stand still.

    Args:
        path: positions in order of time, at least one.
        extent_factor, margin_px: an event is near within extent · factor + margin (as the receiver routes).
    """

    def __init__(self, path: Sequence[PathPoint], extent_factor: float, margin_px: float) -> None:
        self._t_ns = np.array([point.t_ns for point in path], np.float64)
        self._x_px = np.array([point.x_px for point in path])
        self._y_px = np.array([point.y_px for point in path])
        self._reach_px = np.array([point.extent_px for point in path]) * extent_factor + margin_px
        self._times: list[NDArray[np.int64]] = []
        self._polarities: list[NDArray[np.int8]] = []

    def push(self, batch: EventBatch, origin_ns: int = 0) -> None:
        """Take the next events; ``origin_ns`` is the time of the batch at the path's time 0 (ns)."""
        times_ns = batch.t_ns - origin_ns
        t_ns = times_ns.astype(np.float64)
        reach_px = np.interp(t_ns, self._t_ns, self._reach_px)
        near = np.hypot(
            batch.x - np.interp(t_ns, self._t_ns, self._x_px), batch.y - np.interp(t_ns, self._t_ns, self._y_px)
        ) <= reach_px
        self._times.append(times_ns[near])
        self._polarities.append(batch.polarity[near])

    def signal(self) -> Signal:
        """Return the events so far."""
        if not self._times:
            return Signal(np.empty(0, np.int64), np.empty(0, np.int8))
        return Signal(np.concatenate(self._times), np.concatenate(self._polarities))
