"""The searcher: looks for the bit rate of what a slot was given, piece by piece, until there is a lock.

::

    searches ──► the one that is due ──► look: windows, periods ─► acquisition ──► lock, or the next attempt
                                          └── worked on at its pace ──┘

The listed rates and the blind search take turns by themselves: one look of each kind at a time.  What is looked at is the
window of events as it was when the look began, and what is found is known when the look is done, both times of the
stream: any batching gives the same.
"""

from __future__ import annotations

import math
from collections.abc import Generator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from beacon_comm.core.acquisition import Lock, Look, acquiring
from beacon_comm.core.framing import CharacterFrame
from beacon_comm.core.parameters import Parameters
from beacon_comm.core.rate_search import RateSearch, make_searches
from beacon_comm.core.search_pace import SearchPace
from beacon_comm.core.trellis import frame_layout

PIECES = 8
"""So many pieces of a look are done at even distances; what is left of it when it is to be done is done at once."""

Times = NDArray[np.float64]
Polarities = NDArray[np.int8]
Kind = type[RateSearch]


@dataclass(frozen=True, slots=True)
class Found:
    """What a search has found.

    Attributes:
        lock: the lock.
        now: end of the window that it was found in (ns).
        known_at: when it was known (ns).
        first: events before this one are not to be used.
    """

    lock: Lock
    now: float
    known_at: float
    first: int


Looks = Generator[None, None, Found | None]
"""Looks at all that is left, piece by piece; it returns what they have found."""


@dataclass(slots=True)
class _Begun:
    """A look that has begun: which rates at, when, and how far it has come."""

    search: RateSearch
    now: float
    look: Look
    pieces: float = 0
    lock: Lock | None = None

    def work(self, pieces: float) -> None:
        """Go on until so many pieces of it are done."""
        while self.pieces < pieces:
            self.pieces += 1
            try:
                next(self.look)
            except StopIteration as end:
                self.pieces, self.lock = math.inf, end.value


class RateSearcher:
    """Looks for the bit rates that the parameters ask for; times are in ns from the demodulator's origin.

    Args:
        parameters: the rates to look for, the character frame, ``search_load``.
        most_events: no look goes back by more events.

    Attributes:
        longest: events so far back from a look may be needed (ns).
    """

    def __init__(self, parameters: Parameters, most_events: int) -> None:
        frame = CharacterFrame.from_parameters(parameters)
        self._layout = frame_layout(frame)
        self._most_events = most_events
        self._searches = make_searches(parameters, frame)
        self.longest = max(search.longest for search in self._searches)
        kinds = dict.fromkeys(type(search) for search in self._searches)
        self._paces = {kind: SearchPace(parameters.search_load / len(kinds)) for kind in kinds}
        self._begun: dict[Kind, _Begun] = {}
        self._rests_until = -math.inf  # nothing is to be done before
        self._asleep = False  # a search waits for the next event

    @property
    def exhausted(self) -> bool:
        """Whether every rate has been looked for long enough in vain."""
        return all(search.exhausted for search in self._searches)

    def restart(self, t: float) -> None:
        """Begin anew with a first event at ``t`` (ns)."""
        self._begun.clear()
        self._rests_until = -math.inf
        for search in self._searches:
            search.restart(t)

    def wake(self, t: float) -> None:
        """Hear of an event at ``t`` (ns): searches that met a silence begin anew."""
        if not self._asleep:
            return
        self._asleep, self._rests_until = False, -math.inf
        for search in self._searches:
            if search.due == math.inf:
                search.restart(t)

    def share(self, load: float, t: float) -> None:
        """Spend from ``t`` (ns) on no more computing time per event time (1: one core)."""
        self._rests_until = -math.inf
        for pace in self._paces.values():
            pace.set_load(load / len(self._paces), t)

    def miss(self, start: float, stop: float) -> None:
        """Hear of missing events (ns)."""
        self._rests_until = -math.inf
        for search in self._searches:
            search.miss(start, stop)

    def needed_from(self, t: float) -> float:
        """Return from when on events may still be needed at ``t`` (ns)."""
        looks = [begun.now for begun in self._begun.values()]
        return min([t, *looks, *(search.due for search in self._searches if not search.made)]) - self.longest

    def rests(self, t: float) -> bool:
        """Return whether nothing is to be done up to the time ``t`` (ns)."""
        return t < self._rests_until

    def search(self, t: Times, polarity: Polarities, usable_from: float, t_end: float) -> Found | None:
        """Go on up to the time ``t_end`` (ns); return the first lock that is found by then.

        Args:
            t, polarity: the events, those since :meth:`needed_from` among them; views that stay as they are.
            usable_from: those before this (ns) are not looked at.
        """
        while True:
            at, kind = min(((self._next_at(kind), kind) for kind in self._paces), key=lambda entry: entry[0])
            if not at <= t_end:
                break
            begun = self._begun.pop(kind, None)
            if begun is None:
                self._begin(kind, at, t, polarity, usable_from)
                continue
            found = self._finish(begun, t, usable_from, at)
            if found is not None:
                return found
        self._rests_until = at
        for kind, begun in self._begun.items():
            begun.work(PIECES * self._paces[kind].done_by(t_end))
            if begun.pieces < PIECES:
                self._rests_until = min(self._rests_until, self._paces[kind].when(begun.pieces / PIECES))
        return None

    def end_looks(self, t: Times, usable_from: float) -> Looks:
        """Bring what has begun to an end now, piece by piece: the stream ends."""
        while self._begun:
            kind = min(self._begun, key=lambda kind: self._paces[kind].done_at)
            begun = self._begun.pop(kind)
            while begun.pieces < math.inf:
                begun.work(begun.pieces + 1)
                yield
            found = self._finish(begun, t, usable_from, math.inf)
            if found is not None:
                return found
        return None

    def look_at_all(self, t: Times, polarity: Polarities, usable_from: float, t_end: float) -> Looks:
        """Look for every rate a last time: the stream ends, and a short message may still wait for the slower ones."""
        first = self.first(t, max(usable_from, t_end - self.longest), math.inf)
        best: Lock | None = None
        for search in self._searches:
            window = search.window(t, float(t[-1]), first, len(t))
            if window is None:
                continue
            lock = yield from self._look(search, t[window], polarity[window])
            if lock is not None and (best is None or lock.verdict.merit > best.verdict.merit):
                best = lock
        return None if best is None else Found(best, float(t[-1]), math.inf, first)

    def _next_at(self, kind: Kind) -> float:
        """Return when a look of a kind is done, or the next one may begin."""
        pace = self._paces[kind]
        return pace.done_at if kind in self._begun else max(self._next(kind).due, pace.ready_at)

    def _next(self, kind: Kind) -> RateSearch:
        """Return the search that is next: of those that wait, one that has not looked yet, or that wanted to look first."""
        ready = self._paces[kind].ready_at
        return min((s for s in self._searches if isinstance(s, kind)), key=lambda s: (max(s.due, ready), s.made > 0, s.wanted))

    def first(self, t: Times, usable_from: float, at: float) -> int:
        """Return the first event that may be used at the time ``at`` (ns)."""
        return max(int(np.searchsorted(t, usable_from)), int(np.searchsorted(t, at)) - self._most_events)

    def _begin(self, kind: Kind, at: float, t: Times, polarity: Polarities, usable_from: float) -> None:
        """Begin a look at the time ``at`` (ns); a search's first one looks at its own time, however late it begins."""
        search = self._next(kind)
        if search.made and search.due < at:
            search.postpone(at)
        now = min(search.due, at)
        stop = int(np.searchsorted(t, now))
        first = self.first(t, usable_from, at)
        window = search.window(t, now, first, stop)
        if window is None:  # nothing there: wait for the next event
            later = max(stop, first)
            self._asleep |= later >= len(t)
            search.restart(float(t[later]) if later < len(t) else math.inf)
            return
        self._paces[kind].begin(at, (now - float(t[window.start])) / search.period, window.stop - window.start)
        # That a rate is listed says enough: blind searches are not asked about it.
        slower = [s for s in self._searches if s.period > search.period and isinstance(s, kind)]
        windows = [(other, other.window(t, now, first, stop)) for other in slower]
        others = [self._look(other, t[w], polarity[w]) for other, w in windows if w is not None]
        too_early = not all(other.had_a_chance(now) for other in slower)
        look = _chosen(self._look(search, t[window], polarity[window]), others, too_early)
        self._begun[kind] = _Begun(search, now, look)

    def _finish(self, begun: _Begun, t: Times, usable_from: float, at: float) -> Found | None:
        """Do what is left of a look, which is done at the time ``at`` (ns)."""
        begun.work(math.inf)
        begun.search.failed()
        if begun.lock is None:
            return None
        self._begun.clear()
        return Found(begun.lock, begun.now, at, self.first(t, usable_from, at))

    def _look(self, search: RateSearch, t: Times, polarity: Polarities) -> Look:
        """Look at a window for a search's periods."""
        for periods in search.periods(t, polarity):
            lock = yield from acquiring(t, polarity, periods, self._layout, search.demands)
            if lock is not None:
                return lock
        return None


def _chosen(look: Look, slower: list[Look], too_early: bool) -> Look:
    """Look, and return the lock to follow.

    A fast rate finds short frames in one character of a slow signal, with idle line between them: where the words
    leave much of the time unexplained, the slower searches are asked first, and nothing is said where that is too early.
    """
    lock = yield from look
    if lock is None or lock.verdict.full:
        return lock
    if too_early:
        return None
    for other in slower:
        its_lock = yield from other
        if its_lock is not None and its_lock.verdict.merit > lock.verdict.merit:
            lock = its_lock
    return lock
