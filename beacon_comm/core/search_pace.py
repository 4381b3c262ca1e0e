"""The pace of the search for bit rates, counted in event time.

To look for a bit rate costs a thousand times what it costs to follow one.  Where a scene is full of blobs that are no beacons,
all slots look for rates all the time; the node would fall behind, and while it looks, everything else would wait.  So a look
is charged to a bucket that fills with the time of the *events*, and it is done when its debt is paid; it is worked on piece by
piece meanwhile::

    level   ▔▔╲            ╱▔▔▔▔▔▔▔▔╲
       0 ──────│──────────╱──────────│────    the first look a new candidate needs is done at once, or nearly
               │ ▓ ▓ ▓ ▓ ╱           │ ▓ ▓
               └────────╱            └────    the level rises by the load
            begun       done         the next one

Costs are nominal, from the window's bits and events, and nothing is measured, so that any batching gives the same.
"""

from __future__ import annotations

import math

from beacon_comm.core.events import NS_PER_S

BIT_COST_S, EVENT_COST_S = 25e-6, 30e-9
"""What it costs to look at a bit, and at an event, of a window (s of one core of a small computer)."""

BURST_S = 0.01
"""A full bucket holds the load of so much event time (s): enough for a look at five characters."""


class SearchPace:
    """One look after the other; times are in ns from any origin.

    Args:
        load: computing time per event time, 1: one core.
    """

    def __init__(self, load: float) -> None:
        self._load = load
        self._level_s = load * BURST_S
        self._debt_s = 0.0  # when the look was begun
        self._at = -math.inf

    def set_load(self, load: float, t: float) -> None:
        """Let the level rise at another rate from the time ``t`` on; nothing is looked at before it."""
        self._level_s = min(self._level_at(t), load * BURST_S)
        self._at = max(self._at, t)
        self._load = load

    def begin(self, t: float, bits: float, events: int) -> None:
        """Begin to look at so many bits and events at ``t``, when the look before is done."""
        self._level_s = self._level_at(t) - BIT_COST_S * bits - EVENT_COST_S * events
        self._debt_s = -min(self._level_s, 0.0)
        self._at = max(self._at, t)

    @property
    def done_at(self) -> float:
        """When the look is done; without one, when the next one may begin."""
        return self._at - min(self._level_s, 0.0) / self._load * NS_PER_S

    def done_by(self, t: float) -> float:
        """Return how much of the look is done by ``t``, 0 to 1."""
        return 1.0 + min(self._level_at(t), 0.0) / self._debt_s if self._debt_s > 0.0 else 1.0

    def when(self, share: float) -> float:
        """Return when so much of the look is done, 0 to 1."""
        return self.done_at - (1.0 - share) * self._debt_s / self._load * NS_PER_S

    def _level_at(self, t: float) -> float:
        if t <= self._at:
            return self._level_s
        return min(self._level_s + (t - self._at) / NS_PER_S * self._load, self._load * BURST_S)
