"""Last looks: what candidates that are lost have left to say, worked on piece by piece.

A short message may be over before the search has looked for its rate.  So a demodulator without a lock looks for every rate a
last time when its track is lost; in a cluttered view many are, and each look takes as long as a hundred packets.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Generic, NamedTuple, TypeVar

from beacon_comm.core.events import NS_PER_S

PIECE_COST_S = 0.25e-3
"""What a piece costs, nominally (s of one core of a small computer)."""

SHARE = 0.2
"""So much of what may be spent on searching is spent on last looks where any wait, beside it."""

MOST_WAITING, LONGEST_WAIT_NS = 16, 2 * NS_PER_S
"""So many wait at most, and so long (ns); what is beyond that is passed over."""

T = TypeVar('T')


class _Waiting(NamedTuple, Generic[T]):
    since_ns: int
    ending: Iterator[list[T]]


class LastLooks(Generic[T]):
    """Brings streams to their ends, one after the other; ``T``: what they give, characters.

    Args:
        hop_s: time between two calls of :meth:`work` (s).
    """

    def __init__(self, hop_s: float) -> None:
        self._hop_s = hop_s
        self._waiting: dict[int, _Waiting[T]] = {}
        self._pieces = 0.0  # that may be done

    def __bool__(self) -> bool:
        """Whether any wait."""
        return bool(self._waiting)

    def begin(self, track_id: int, ending: Iterator[list[T]], t_ns: int) -> list[T]:
        """Take what is left of a track that is lost at ``t_ns``; return what it gives before it looks for a bit rate.

        Args:
            track_id: its label.
            ending: its parts, empty ones for each piece of a look; see
                :meth:`beacon_comm.core.sequence.SequenceDemodulator.ending`.
            t_ns: the hop's time (ns).
        """
        given: list[T] = []
        for part in ending:
            if not part:
                if len(self._waiting) < MOST_WAITING:
                    self._waiting[track_id] = _Waiting(t_ns, ending)
                break
            given += part
        return given

    def work(self, load: float, t_ns: int) -> list[T]:
        """Go on at the hop at ``t_ns`` (ns), where ``load`` may be spent on searching (1: one core); return what that gives."""
        given: list[T] = []
        self._pieces = self._pieces + SHARE * load * self._hop_s / PIECE_COST_S if self._waiting else 0.0
        while self._waiting and self._pieces >= 1.0:
            track_id, (since_ns, ending) = next(iter(self._waiting.items()))
            part = next(ending, None) if t_ns - since_ns <= LONGEST_WAIT_NS else None
            if part is None:
                del self._waiting[track_id]
            else:
                given += part
                self._pieces -= 1.0
        return given

    def finish(self, track_id: int) -> list[T]:
        """Bring one to its end now; its label is another one's from now on."""
        waiting = self._waiting.pop(track_id, None)
        return [] if waiting is None else [one for part in waiting.ending for one in part]

    def finish_all(self) -> list[T]:
        """Bring all to their ends now: the stream ends."""
        return [one for track_id in list(self._waiting) for one in self.finish(track_id)]
