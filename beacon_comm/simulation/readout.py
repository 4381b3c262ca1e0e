"""From a pixel's request to an event on the bus: the arbiter, its time stamps, and what is lost when it is too busy.

    requests    row 3 ·· ·        ┐  the row that has waited longest is served: row_us + pixel_us a pixel;
                row 4 · · · ·     ├─ all its pixels that wait share one time stamp, of 1 µs
                row 7 ·           ┘  a request older than longest_wait_us is lost

Row-wise readout with shared stamps is that of Boahen (2000) and of Prophesee's sensors (Finateu et al. 2020): a bus that is
busy delays events, groups them by rows, and at last loses them.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from beacon_comm.core.events import EventBatch
from beacon_comm.simulation.description import Sensor
from beacon_comm.simulation.pixels import RawEvents


class Readout:
    """The arbiter of one sensor; keeps what waits from piece to piece."""

    def __init__(self, sensor: Sensor) -> None:
        self._sensor = sensor
        self._waiting: RawEvents = _nothing()
        self._free_ns = 0.0
        self.lost = 0

    def read(self, requests: list[RawEvents], end_ns: int) -> EventBatch:
        """Return the events that are on the bus before ``end_ns``, in order.

        Args:
            requests: all pixels' that come before ``end_ns``, in any order; later calls bring later ones.
            end_ns: until when (ns); whole microseconds.
        """
        t_ns, x, y, polarity = (np.concatenate(parts) for parts in zip(self._waiting, *requests, strict=True))
        order = np.argsort(t_ns, kind='stable')
        t_ns, x, y, polarity = t_ns[order], x[order], y[order], polarity[order]
        sensor = self._sensor
        served, stamps, place, self._free_ns, waiting, lost = _serve(
            t_ns,
            y,
            sensor.height,
            float(end_ns),
            self._free_ns,
            sensor.row_us * 1e3,
            sensor.pixel_us * 1e3,
            sensor.longest_wait_us * 1e3,
        )
        self.lost += lost
        self._waiting = t_ns[waiting], x[waiting], y[waiting], polarity[waiting]
        # In the order of the bus; within a row from left to right.
        by_bus = np.lexsort((x[served], place))
        served, stamps = served[by_bus], stamps[by_bus]
        return EventBatch(x[served], y[served], polarity[served], stamps, end_ns)


def _nothing() -> RawEvents:
    return np.empty(0, np.int64), np.empty(0, np.uint16), np.empty(0, np.uint16), np.empty(0, np.int8)


@njit(cache=True, nogil=True)
def _serve(t_ns, row_of, height, end_ns, free_ns, row_ns, pixel_ns, longest_ns):  # type: ignore[no-untyped-def]
    """Serve rows until ``end_ns``.

    Returns:
        Indices of the events served, their stamps, their places on the bus; when the bus is free again; indices of those
        that wait; how many were lost.
    """
    n = len(t_ns)
    following = np.full(n, -1, np.int64)
    head = np.full(height, -1, np.int64)
    tail = np.full(height, -1, np.int64)
    queue = np.empty(n, np.int64)  # rows in the order of their oldest request; each row at most once
    first, last = 0, 0
    served = np.empty(n, np.int64)
    stamps = np.empty(n, np.int64)
    place = np.empty(n, np.int64)
    done, lost, at, turn = 0, 0, 0, 0
    now = free_ns
    while True:
        if first == last:  # nobody waits
            if at == n or t_ns[at] >= end_ns:
                break
            now = max(now, float(t_ns[at]))
        while at < n and t_ns[at] <= now:
            row = row_of[at]
            if head[row] < 0:
                head[row] = at
                queue[last] = row
                last += 1
            else:
                following[tail[row]] = at
            tail[row] = at
            at += 1
        if now >= end_ns:
            break
        row = queue[first]
        first += 1
        k = head[row]
        pixels = 0
        stamp = np.int64(now) // 1000 * 1000
        while k >= 0:
            if now - t_ns[k] > longest_ns:
                lost += 1
            else:
                served[done] = k
                stamps[done] = stamp
                place[done] = turn
                done += 1
                pixels += 1
            k = following[k]
        head[row] = -1
        turn += 1
        if pixels:
            now += row_ns + pixels * pixel_ns
    waiting = np.empty(n - done - lost, np.int64)
    count = 0
    for i in range(first, last):
        k = head[queue[i]]
        while k >= 0:
            waiting[count] = k
            count += 1
            k = following[k]
    while at < n:
        waiting[count] = at
        count += 1
        at += 1
    return served[:done], stamps[:done], place[:done], now, waiting[:count], lost
