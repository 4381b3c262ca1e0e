"""Events and event batches: what every stage of the receiver is fed with.

An *event* is one brightness change ``(x, y, polarity, t)``.  A *batch* holds the events handed in at once as
four parallel arrays, and the time up to which the stream is known:

    every event delivered so far has   t <= t_end_ns,
    every event still to come has      t >= t_end_ns.

A batch without events still moves the stream's time on, so that a silence ends characters and tracks.

Where messages were lost, time is no silence but *missing*: nobody knows what was in it.  The batch after it says so:
the stream between the batches before and ``missing_until_ns`` is missing.

A batch that is *carried on* has no events and moves time by a clock alone: nobody said that nothing happened.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

NS_PER_S = 1_000_000_000


@dataclass(slots=True)
class EventBatch:
    """Events in order of time, all of one sensor; not to be changed.

    Attributes:
        x, y: pixel column and row, ``(n,)`` uint16.
        polarity: +1 for a rise, -1 for a fall of brightness, ``(n,)`` int8.
        t_ns: sensor time (ns), non-decreasing, ``(n,)`` int64.
        t_end_ns: the stream's time (ns) after this batch; see the module's head.
        missing_until_ns: end of the missing stretch before this batch (ns), at most ``t_end_ns`` and no later than the first
            event; None without one.
        carried_on: see the module's head.
    """

    x: NDArray[np.uint16]
    y: NDArray[np.uint16]
    polarity: NDArray[np.int8]
    t_ns: NDArray[np.int64]
    t_end_ns: int
    missing_until_ns: int | None = None
    carried_on: bool = False

    def __len__(self) -> int:
        return len(self.t_ns)

    @classmethod
    def empty(cls, t_end_ns: int) -> EventBatch:
        """Return a batch without events that moves the stream's time to ``t_end_ns`` (ns)."""
        return cls(
            np.empty(0, np.uint16), np.empty(0, np.uint16), np.empty(0, np.int8), np.empty(0, np.int64), t_end_ns
        )

    def slice(self, start: int, stop: int, t_end_ns: int) -> EventBatch:
        """Return events ``start:stop`` as views, with the stream's time ``t_end_ns`` (ns).

        What is missing before the batch is missing before a slice from its first event on, up to ``t_end_ns``.
        """
        missing_ns = self.missing_until_ns if start == 0 else None
        return EventBatch(
            self.x[start:stop],
            self.y[start:stop],
            self.polarity[start:stop],
            self.t_ns[start:stop],
            t_end_ns,
            None if missing_ns is None else min(missing_ns, t_end_ns),
        )
