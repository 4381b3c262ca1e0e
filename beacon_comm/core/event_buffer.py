"""The events of one track: those of the last ``buffer_s``, in order of time.

    t_ns      [ free | live events ……………………… | room ]
    polarity  [ free | live events ……………………… | room ]       one array each, moved down or doubled when full

What is too old or too much is decided at hops alone and by event time, so that any batching leaves the same events.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from beacon_comm.core.events import NS_PER_S
from beacon_comm.core.framing import CharacterFrame
from beacon_comm.core.parameters import Parameters

EVENT_BYTES = 9  # int64 time and int8 polarity
_FIRST_ROOM = 256


class EventBuffer:
    """Routed events of one track.

    Args:
        length_ns: events older than this are dropped (ns).
        max_bytes: bound of the kept events, at a hop (byte).

    Attributes:
        overflow_events: events dropped because of ``max_bytes``.
    """

    def __init__(self, length_ns: int, max_bytes: int) -> None:
        self._length_ns = length_ns
        self._max_events = max(1, max_bytes // EVENT_BYTES)
        self._t_ns = np.empty(_FIRST_ROOM, np.int64)
        self._polarity = np.empty(_FIRST_ROOM, np.int8)
        self._start = 0
        self._stop = 0
        self._oldest_ns = np.iinfo(np.int64).min
        self.overflow_events = 0

    def __len__(self) -> int:
        """Return how many events are held; some may be too old already."""
        return self._stop - self._start

    def append(self, t_ns: NDArray[np.int64], polarity: NDArray[np.int8]) -> None:
        """Copy events to the end; they must not be older than those before."""
        n = len(t_ns)
        if self._stop + n > len(self._t_ns):
            self._make_room(n)
        self._t_ns[self._stop : self._stop + n] = t_ns
        self._polarity[self._stop : self._stop + n] = polarity
        self._stop += n

    def trim(self, t_hop_ns: int) -> int:
        """Let go what is too old at ``t_hop_ns`` (ns) or too much; return how many events were too much."""
        self._oldest_ns = t_hop_ns - self._length_ns
        if len(self) <= self._max_events:
            return 0  # what is too old goes when it is in the way
        self._drop_old()
        excess = max(0, len(self) - self._max_events)
        self._start += excess
        self.overflow_events += excess
        return excess

    def events(self) -> tuple[NDArray[np.int64], NDArray[np.int8]]:
        """Return copies of the times (ns), ``(n,)`` int64, and polarities, ``(n,)`` int8 of ±1."""
        self._drop_old()
        live = slice(self._start, self._stop)
        return self._t_ns[live].copy(), self._polarity[live].copy()

    def _drop_old(self) -> None:
        if self._start < self._stop and self._t_ns[self._start] < self._oldest_ns:
            self._start += int(np.searchsorted(self._t_ns[self._start : self._stop], self._oldest_ns))

    def _make_room(self, n: int) -> None:
        self._drop_old()
        live = slice(self._start, self._stop)
        t_ns, polarity, kept = self._t_ns, self._polarity, len(self)
        if 2 * (kept + n) > len(t_ns):
            room = 2 * (kept + n)
            self._t_ns, self._polarity = np.empty(room, np.int64), np.empty(room, np.int8)
        self._t_ns[:kept] = t_ns[live]
        self._polarity[:kept] = polarity[live]
        self._start, self._stop = 0, kept


def buffer_length_ns(parameters: Parameters) -> int:
    """Return how long a track's events are kept (ns): a time, or characters of the slowest listed rate."""
    frame_bits = CharacterFrame.from_parameters(parameters).length
    characters_s = parameters.buffer_characters * frame_bits * parameters.slowest_bit_s
    return round(max(parameters.buffer_min_s, characters_s) * NS_PER_S)
