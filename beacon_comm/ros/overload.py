"""Overload: which messages to pass over so that the node stays near the present.

A message's *wait* is what it has spent in the node's queue: from its arrival, as the middleware stamped it, to its turn,
both on the host's clock.  Neither the publisher's clock nor ``use_sim_time`` is in it, so a bag that is replayed at ten
times its speed is ten times the load and nothing else.

::

    wait  max_lag ├ ─ ─ ─ ─ ─ ─ ─ ─ ─ ─ ─ ─ ─ ─        room for what reading it takes
                  │       ╱│            ╱│
                  │     ╱  │          ╱  │              read, and the queue grows
                  │   ╱    │        ╱    │              shed, in no time
         RESUMED  ├ ╱─ ─ ─ └ ─ ─ ─╱─ ─ ─ └ ─
                  └──────────────────────────────► time

Whole messages are shed, and many in a row: a character needs an unbroken stretch, and every gap costs the two that it
cuts.  So the longest stretches that the bound allows are read, with the shortest gaps that make up for them.
"""

from __future__ import annotations

RESUMED = 0.1
"""Share of the longest lag; at such a wait messages are read again."""
HURRIED = 0.3
"""Share of the longest lag; who has waited longer is in a hurry: what can wait is to wait."""
FORGOTTEN = 0.99
"""What is left, one message later, of the longest time that reading one took."""


class Shedder:
    """Says of each message, in order, whether it is to be shed.

    Args:
        max_lag_ns: longest time (ns) from a message's arrival to its having been read.
    """

    def __init__(self, max_lag_ns: int) -> None:
        self._max_lag_ns = max_lag_ns
        self._longest_ns = 0.0
        self.shedding = False

    def read(self, took_ns: int) -> None:
        """Learn how long reading a message took (ns)."""
        self._longest_ns = max(float(took_ns), FORGOTTEN * self._longest_ns)

    def hurries(self, waited_ns: int) -> bool:
        """Tell whether a message that has waited so long (ns) is in a hurry."""
        return waited_ns > HURRIED * self._max_lag_ns

    def sheds(self, waited_ns: int) -> bool:
        """Tell whether to shed a message that has waited so long (ns)."""
        least_ns = RESUMED * self._max_lag_ns
        limit_ns = least_ns if self.shedding else max(self._max_lag_ns - self._longest_ns, least_ns)
        self.shedding = waited_ns > limit_ns
        return self.shedding
