"""A budget of computing for the search of bit rates, counted in event time.

To look for a bit rate costs a thousand times what it costs to follow one.  Where a scene is full of blobs that are no beacons,
all slots look for rates all the time, and the node would fall behind.  So each demodulator has a bucket of computing time for
the listed rates and one for the blind search::

    level   ▔▔╲        ╱▔▔╲    ╱▔╲      a look costs what its window holds; below zero the next looks wait until
       0 ─────╲───╱─────╲─╱───╱──       the level is back: it rises by the bucket's share of the load
               ╲╱        ╲╱             with the time of the *events*

What was buffered before the demodulator began is read at once, and for it there is what the bucket holds, and no more.
Costs are nominal, from the window's bits and events, and nothing is measured, so that any batching gives the same.
"""

from __future__ import annotations

BURST_S = 0.15
"""A full bucket holds the share of so much event time (s)."""

BIT_COST_S, EVENT_COST_S = 25e-6, 30e-9
"""What it costs to look at a bit, and at an event, of a window (s of one core of a small computer)."""


class SearchBudget:
    """A bucket; times are in ns from any origin.

    Args:
        load: computing time per event time, 1: one core.
    """

    def __init__(self, load: float) -> None:
        self._load = load
        self._level_s = load * BURST_S
        self._at = 0.0

    def set_load(self, load: float, t: float) -> None:
        """Let the level rise at another rate from the time ``t`` on."""
        self._rise_to(t)
        self._load = load
        self._level_s = min(self._level_s, load * BURST_S)

    def ready_at(self, t: float) -> float:
        """Return when the next look may be, ``t`` or later."""
        self._rise_to(t)
        return t if self._level_s >= 0.0 else self._at - self._level_s / self._load * 1e9

    def spend(self, bits: float, events: int) -> None:
        """Take what a look at so many bits and events costs."""
        self._level_s -= BIT_COST_S * bits + EVENT_COST_S * events

    def _rise_to(self, t: float) -> None:
        if t > self._at:
            self._level_s = min(self._level_s + (t - self._at) * 1e-9 * self._load, self._load * BURST_S)
            self._at = t
