"""The signature of a beacon that is being read: when its bits and characters begin, and what they look like.

It tells whether other events are of the same beacon: where they lie in its bits, and in which places of the frame, each bit
weighed by what was learnt of it before (:func:`beacon_comm.core.sequence_detection.explain`).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from beacon_comm.core.sequence_detection import explain


@dataclass(frozen=True, slots=True)
class Signature:
    """A locked receiver's state at some time, a copy.

    Attributes:
        clock, detection, layout: ``(1,)`` of ``CLOCK``, ``DETECTION`` and ``LAYOUT``.
        inverted: the LED is on for 0.
        origin_ns: what the clock's times count from (ns).
    """

    clock: NDArray[np.void]
    detection: NDArray[np.void]
    layout: NDArray[np.void]
    inverted: bool
    origin_ns: int

    @property
    def character_ns(self) -> float:
        """Duration of a character (ns)."""
        return float(self.clock['period'][0]) * int(self.layout['length'][0])

    def explain(self, t_ns: NDArray[np.int64], polarity: NDArray[np.int8], start_ns: int, stop_ns: int) -> float | None:
        """Return log p (nat) of the events between two times under it, None: the clock is not sure any more where bits begin.

        Args:
            t_ns, polarity: the events, ``(n,)`` int64 (ns) and ±1 int8.
            start_ns, stop_ns: times (ns), not before the signature's own.
        """
        clock, detection = self.clock.copy(), self.detection.copy()
        t = (t_ns - self.origin_ns).astype(np.float64)
        total, sure = explain(
            clock, detection, self.layout, self.inverted, t, polarity, float(start_ns - self.origin_ns),
            float(stop_ns - self.origin_ns),
        )  # fmt: skip
        return float(total) if sure else None
