"""The pace of the search for bit rates, counted in event time.

To look for a bit rate costs a thousand times what it costs to follow one.  Where a scene is full of blobs that are no beacons,
all slots look for rates all the time; the node would fall behind, and while it looks, everything else would wait.  So a look
is charged to a bucket that fills with the time of the *events*: the next one waits until its debt is paid.  And what it finds
counts a little later, so that it can be worked on piece by piece meanwhile::

    level   ▔▔╲                   ╱▔▔▔╲
       0 ──────│─────────────────╱─────│────    the level rises by the load
               │ ▓ ▓ ▓ ▓│      ╱       │ ▓ ▓
               └────────│───╱          └────
            begun     done     ready to begin the next one

Costs are nominal, from the window's bits and events, and nothing is measured, so that any batching gives the same.
"""

from __future__ import annotations

import math

from beacon_comm.core.events import NS_PER_S

BIT_COST_S, EVENT_COST_S = 25e-6, 30e-9
"""What it costs to look at a bit, and at an event, of a window (s of one core of a small computer)."""

PIECE_COST_S, PASS_COST_S = 0.6e-3, 1.2e-9
"""What a piece of a look costs, of hundreds, and each event that it goes through."""

BURST_S = 0.0025
"""A full bucket holds so much computing time (s): enough for a first look, at five characters, which is done at once."""

WORK_LOAD = 0.25
"""What is beyond that is worked on at this load, or the bucket's if that is more (1: one core)."""


class SearchPace:
    """One look after the other; times are in ns from any origin.

    Args:
        load: computing time per event time, 1: one core.

    Attributes:
        done_at: when the look that was begun last counts.
    """

    def __init__(self, load: float) -> None:
        self._load = load
        self._level_s = BURST_S
        self._at = self._begun_at = self.done_at = -math.inf

    def set_load(self, load: float, t: float) -> None:
        """Let the level rise at another rate from the time ``t`` on; nothing is looked at before it."""
        self._level_s = self._level_at(t)
        self._at = max(self._at, t)
        self._load = load

    def begin(self, t: float, bits: float, events: int) -> None:
        """Begin to look at so many bits and events at ``t``."""
        self._level_s = self._level_at(t) - BIT_COST_S * bits - EVENT_COST_S * events
        self._at = self._begun_at = max(self._at, t)
        self.done_at = self._at - min(self._level_s, 0.0) / max(self._load, WORK_LOAD) * NS_PER_S

    @property
    def ready_at(self) -> float:
        """When the next look may begin."""
        return max(self.done_at, self._at - min(self._level_s, 0.0) / self._load * NS_PER_S)

    def done_by(self, t: float) -> float:
        """Return how much of the look is done by ``t``, 0 to 1."""
        if t >= self.done_at:
            return 1.0
        return max(t - self._begun_at, 0.0) / (self.done_at - self._begun_at)

    def when(self, share: float) -> float:
        """Return when so much of the look is done, 0 to 1."""
        return self._begun_at + share * (self.done_at - self._begun_at)

    def _level_at(self, t: float) -> float:
        if t <= self._at:
            return self._level_s
        return min(self._level_s + (t - self._at) / NS_PER_S * self._load, BURST_S)
