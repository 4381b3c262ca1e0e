"""Last looks: what candidates that are lost have left to say, worked on piece by piece.

A short message may be over before the search has looked for its rate.  So a demodulator without a lock looks for every rate a
last time when its track is lost; in a cluttered view many are, and each look takes as long as a hundred packets::

    lost ──► characters, at once
         └─► waiting ──► a look, some pieces a hop, paid from search_load ──► characters, later
                └── too many, or for too long: passed over
"""

from __future__ import annotations

from collections.abc import Collection, Iterator
from dataclasses import dataclass
from typing import Generic, TypeVar

from beacon_comm.core.events import NS_PER_S

WEIGHT = 4
"""Of what may be spent on searching, last looks get as much as so many candidates …"""

MOST_LOAD = 0.25
"""… and no more than this (1: one core)."""

MOST_WAITING, LONGEST_WAIT_NS = 16, 5 * NS_PER_S
"""So many wait at most, each with its buffered events, and so long (ns)."""

T = TypeVar('T')
Part = list[T] | float
"""Of a stream's end: what it gives, or what a piece of a look has cost, nominally (s of one core of a small computer)."""


@dataclass(slots=True)
class _Waiting(Generic[T]):
    since_ns: int
    ending: Iterator[Part[T]]
    begun: bool = False


class LastLooks(Generic[T]):
    """Brings streams to their ends, one after the other; ``T``: what they give, characters.

    Args:
        hop_s: time between two calls of :meth:`work` (s).

    Attributes:
        passed_over: how many were not looked at.
    """

    def __init__(self, hop_s: float) -> None:
        self._hop_s = hop_s
        self._waiting: dict[int, _Waiting[T]] = {}
        self._left_s = 0.0  # computing time that may be spent
        self.passed_over = 0

    @property
    def track_ids(self) -> Collection[int]:
        """Labels of those that wait."""
        return self._waiting.keys()

    def begin(self, track_id: int, ending: Iterator[Part[T]], t_ns: int) -> list[T]:
        """Take what is left of a track that is lost at ``t_ns`` (ns); return what it gives before it looks for a bit rate.

        Args:
            track_id: its label.
            ending: see :meth:`beacon_comm.core.demodulator.Searching.ending`.
            t_ns: the hop's time (ns).
        """
        given: list[T] = []
        for part in ending:
            if isinstance(part, float):
                if len(self._waiting) < MOST_WAITING:
                    self._waiting[track_id] = _Waiting(t_ns, ending)
                else:
                    self.passed_over += 1
                break
            given += part
        return given

    def work(self, load: float, t_ns: int) -> list[T]:
        """Go on at the hop at ``t_ns`` (ns); return what that gives.

        Args:
            load: what may be spent on it (1: one core).
            t_ns: the hop's time (ns).
        """
        for track_id in [k for k, one in self._waiting.items() if not one.begun and t_ns - one.since_ns > LONGEST_WAIT_NS]:
            del self._waiting[track_id]
            self.passed_over += 1
        given: list[T] = []
        self._left_s = min(self._left_s, 0.0) + min(load, MOST_LOAD) * self._hop_s if self._waiting else 0.0
        while self._waiting and self._left_s > 0.0:
            track_id, one = next(iter(self._waiting.items()))
            one.begun = True
            part = next(one.ending, None)
            if part is None:
                del self._waiting[track_id]
            elif isinstance(part, float):
                self._left_s -= part
            else:
                given += part
        return given

    def finish(self, track_id: int) -> list[T]:
        """Bring one to its end now; its label is another one's from now on."""
        one = self._waiting.pop(track_id, None)
        return [] if one is None else all_of(one.ending)

    def finish_all(self) -> list[T]:
        """Bring all to their ends now: the stream ends."""
        return [given for track_id in list(self._waiting) for given in self.finish(track_id)]


def all_of(ending: Iterator[Part[T]]) -> list[T]:
    """Return all that the end of a stream gives."""
    return [one for part in ending if not isinstance(part, float) for one in part]
