"""Events in order of time that come at the end and go at the beginning; and those of one track's last ``buffer_s``.

    times     [ free | live events ……………………… | room ]
    polarity  [ free | live events ……………………… | room ]       one array each, moved to another one when full

In a track's buffer, what is too old or too much is decided at hops alone and by event time, so that any batching
leaves the same events.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from beacon_comm.core.events import NS_PER_S
from beacon_comm.core.framing import CharacterFrame
from beacon_comm.core.parameters import Parameters

EVENT_BYTES = 9  # int64 time and int8 polarity
_FIRST_ROOM = 256


class EventArrays:
    """Times and polarities of events.  Views of them stay as they are, whatever comes or goes.

    Args:
        time_type: of the times.
    """

    def __init__(self, time_type: type[np.int64] | type[np.float64]) -> None:
        self._times = np.empty(_FIRST_ROOM, time_type)
        self._polarity = np.empty(_FIRST_ROOM, np.int8)
        self._start = 0
        self._stop = 0

    def __len__(self) -> int:
        return self._stop - self._start

    @property
    def times(self) -> NDArray[Any]:
        """View of the times, ``(n,)``."""
        return self._times[self._start : self._stop]

    @property
    def polarity(self) -> NDArray[np.int8]:
        """View of the polarities, ``(n,)`` of ±1."""
        return self._polarity[self._start : self._stop]

    def append(self, times: NDArray[Any], polarity: NDArray[np.int8]) -> None:
        """Copy events to the end; they must not be older than those before."""
        n = len(times)
        if self._stop + n > len(self._times):
            self._make_room(n)
        self._times[self._stop : self._stop + n] = times
        self._polarity[self._stop : self._stop + n] = polarity
        self._stop += n

    def drop(self, count: int) -> None:
        """Let the first events go."""
        self._start += count

    def _make_room(self, n: int) -> None:
        times, polarity, kept = self.times, self.polarity, len(self)
        room = max(2 * (kept + n), _FIRST_ROOM)
        self._times, self._polarity = np.empty(room, times.dtype), np.empty(room, np.int8)
        self._times[:kept] = times
        self._polarity[:kept] = polarity
        self._start, self._stop = 0, kept


class EventBuffer(EventArrays):
    """Routed events of one track.

    Args:
        length_ns: events older than this are dropped (ns).
        max_bytes: bound of the kept events, at a hop (byte).

    Attributes:
        overflow_events: events dropped because of ``max_bytes``.
    """

    def __init__(self, length_ns: int, max_bytes: int) -> None:
        super().__init__(np.int64)
        self._length_ns = length_ns
        self._max_events = max(1, max_bytes // EVENT_BYTES)
        self._oldest_ns = np.iinfo(np.int64).min
        self.overflow_events = 0

    def trim(self, t_hop_ns: int) -> int:
        """Let go what is too old at ``t_hop_ns`` (ns) or too much; return how many events were too much."""
        self._oldest_ns = t_hop_ns - self._length_ns
        if len(self) <= self._max_events:
            return 0  # what is too old goes when it is in the way
        self._drop_old()
        excess = max(0, len(self) - self._max_events)
        self.drop(excess)
        self.overflow_events += excess
        return excess

    def events(self) -> tuple[NDArray[np.int64], NDArray[np.int8]]:
        """Return views of the times (ns), ``(n,)`` int64, and polarities, ``(n,)`` int8 of ±1."""
        self._drop_old()
        return self.times, self.polarity

    def _drop_old(self) -> None:
        times = self.times
        if len(times) and times[0] < self._oldest_ns:
            self.drop(int(np.searchsorted(times, self._oldest_ns)))

    def _make_room(self, n: int) -> None:
        self._drop_old()
        super()._make_room(n)


def buffer_length_ns(parameters: Parameters) -> int:
    """Return how long a track's events are kept (ns): a time, or characters of the slowest listed rate."""
    frame_bits = CharacterFrame.from_parameters(parameters).length
    characters_s = parameters.buffer_characters * frame_bits * parameters.slowest_bit_s
    return round(max(parameters.buffer_min_s, characters_s) * NS_PER_S)
