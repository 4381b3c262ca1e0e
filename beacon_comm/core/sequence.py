"""The sequence demodulator: blind, soft and streaming; reads what a threshold throws away.

::

    searching   events ─► buffer ─► looks at times of the stream: rate, phase, histograms ─────┐
                            ▲                                                                   │ a lock
                            └────────── too many words in doubt ────────┐                       ▼
    locked      events ─► bit clock ─► counts ─► free and framed trellis ─► words ─► characters

A lock is followed from the buffer's beginning on, so that what was said before it is not lost.  Everything happens at
times of the stream, whatever the batches: an attempt sees the events before its time, a word is decided at a bit.
"""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from beacon_comm.core.acquisition import Demands, Lock, acquiring, look_at_once
from beacon_comm.core.character import Character, Status
from beacon_comm.core.event_buffer import EVENT_BYTES, EventArrays
from beacon_comm.core.events import NS_PER_S
from beacon_comm.core.framing import CharacterFrame
from beacon_comm.core.last_looks import all_of
from beacon_comm.core.likelihood import MEMORY_BITS
from beacon_comm.core.parameters import Parameters
from beacon_comm.core.search_pace import PASS_COST_S, PIECE_COST_S
from beacon_comm.core.searcher import Found, RateSearcher
from beacon_comm.core.sequence_detection import (
    BORDER_OF_START,
    FIRST_RATIO,
    FULL,
    KIND,
    KIND_NOISE,
    KIND_OK,
    KIND_REPAIRED,
    KIND_SEEN,
    KIND_UNREADABLE,
    LOST,
    LOST_IN_GAP,
    MARGIN,
    PERIOD_THEN,
    SPREAD_THEN,
    STILL_LOCKED,
    WORD,
    detect,
    end_detection,
    silent_since,
    start_at,
)
from beacon_comm.core.signature import Signature
from beacon_comm.core.soft_decision import confidence_of
from beacon_comm.core.trellis import frame_layout

ADJACENT_BITS = 15
"""The character before the one from which on a lock is trusted is given out, too, if no more bits lie between their starts."""

REFINED_AFTER = 25
"""Phase and histograms of a lock are learnt anew once over so many characters: a lock begins with a handful."""

REFINED_PERIODS: NDArray[np.float64] = 1.0 + 0.001 * np.arange(-8.0, 9.0)
"""Periods that a refinement looks at, as shares of the clock's."""

REFINED_DEMANDS = Demands(REFINED_AFTER // 2, most_spread=math.inf)

READ_BACK_CHARACTERS, REREAD_CHARACTERS = 400, 100
"""What was said before a lock is read from the buffer, so many characters back at most; after a lost lock, so many."""

_ROWS = 512

_FEW_EVENTS, _MANY_GAPS = 4096, 16


class SequenceDemodulator:
    """Demodulates one beacon; see the module.

    Args:
        parameters: the rates to look for, the character frame and the bound of the buffer.
    """

    def __init__(self, parameters: Parameters) -> None:
        self._frame = CharacterFrame.from_parameters(parameters)
        self._layout = frame_layout(self._frame)
        self._decode = self._frame.decoding_table()
        self._most_events = parameters.buffer_max_bytes // EVENT_BYTES
        self._searcher = RateSearcher(parameters, self._most_events)
        self._rows = np.zeros((_ROWS, FIRST_RATIO + self._frame.length))
        self._lock: Lock | None = None
        self._ended: Lock | None = None  # the lock at the stream's end
        self._pending: Character | None = None  # said before the lock is trusted
        self._trusted = False  # the lock has seen a character that is ok, or nearly
        self._origin_ns: int | None = None
        self._events = EventArrays(np.float64)
        self._gaps = np.empty((0, 2))  # whose events are missing
        self._known_to = -math.inf  # the stream's time
        self._forget_at = _FEW_EVENTS  # with so many events in the buffer
        self._taken = 0  # events of the buffer that the lock has seen
        self._given_to = -math.inf  # end of the last character that was given out …
        self._read_to = -math.inf  # … or read, and not given out yet
        self._refine_at = math.inf  # time at which the lock is to be refined
        self._usable_from = -math.inf  # events before this are not read again
        self._found_at = -math.inf  # end of the window that the lock was found in …
        self._known_at = -math.inf  # … and when it was known
        self._searched_to_ns: int | None = None  # by the demodulator before this one
        self._shared: tuple[float, int] | None = None  # load, from when on (ns), before the first event

    @property
    def _t(self) -> NDArray[np.float64]:
        """Times of the buffered events (ns from the origin)."""
        return self._events.times

    @property
    def _polarity(self) -> NDArray[np.int8]:
        return self._events.polarity

    @property
    def bit_rate_bps(self) -> float | None:
        """The bit rate of the present lock, or of the one at the stream's end (bit/s), None without one."""
        lock = self._lock or self._ended
        return None if lock is None else NS_PER_S / float(lock.clock['period'][0])

    @property
    def bit_rate_std_bps(self) -> float | None:
        """Standard deviation of :attr:`bit_rate_bps` (bit/s), None without a lock."""
        lock = self._lock or self._ended
        if lock is None:
            return None
        clock = lock.clock[0]
        return math.sqrt(float(clock['p_period'])) * NS_PER_S / float(clock['period'])

    def signature(self) -> Signature | None:
        """Return how the beacon can be known again; see :class:`beacon_comm.core.demodulator.Recognising`."""
        lock = self._lock
        if lock is None or self._origin_ns is None:
            return None
        return Signature(lock.clock.copy(), lock.detection.copy(), self._layout, lock.inverted, self._origin_ns)

    @property
    def given_up(self) -> bool:
        """Whether every rate has been looked for long enough in vain."""
        return self._lock is None and self._searcher.exhausted

    def push(self, t_ns: NDArray[np.int64], polarity: NDArray[np.int8], t_end_ns: int) -> list[Character]:
        """Take the next events; see :class:`beacon_comm.core.demodulator.Demodulator`."""
        if self._origin_ns is None:
            if not len(t_ns):
                return []
            self._origin_ns = int(t_ns[0])
            if self._shared is not None:
                self.share(*self._shared)
            to_ns = self._origin_ns if self._searched_to_ns is None else self._searched_to_ns
            self._searcher.restart(max(0.0, float(to_ns - self._origin_ns)))
        self._ended = None
        self._events.append(t_ns - self._origin_ns, polarity)
        t_end = float(t_end_ns - self._origin_ns)
        if len(t_ns):
            self._searcher.wake(float(t_ns[0] - self._origin_ns))
        characters: list[Character] = []
        while True:
            if self._lock is not None:
                status, read = self._follow(self._lock, t_end)
                characters += read
                if status in (LOST, LOST_IN_GAP):
                    self._unlock(reread=status == LOST)
                elif status != FULL:
                    break
            elif self._searcher.rests(t_end):
                break
            else:
                found = self._searcher.search(self._t, self._polarity, self._usable_from, t_end)
                if found is None:
                    break
                self._start(found)
        if len(self._events) > min(self._forget_at, self._most_events) or len(self._gaps) > _MANY_GAPS:
            self._forget(t_end)
            self._forget_at = max(2 * len(self._events), _FEW_EVENTS)
        self._known_to = t_end
        return characters

    def share(self, load: float, t_ns: int) -> None:
        """Spend no more on searching; see :class:`beacon_comm.core.demodulator.Searching`."""
        if self._origin_ns is None:
            self._shared = load, t_ns
            return
        self._searcher.share(load, float(t_ns - self._origin_ns))

    def searched(self, to_ns: int) -> None:
        """Hear of searched events; see :class:`beacon_comm.core.demodulator.Searching`."""
        self._searched_to_ns = to_ns

    def miss(self, start_ns: int, stop_ns: int) -> None:
        """Hear of missing events; see :class:`beacon_comm.core.demodulator.GapAware`."""
        if self._origin_ns is not None:
            gap = np.array([[start_ns - self._origin_ns, stop_ns - self._origin_ns]], np.float64)
            self._gaps = np.concatenate((self._gaps, gap))
            self._searcher.miss(*gap[0].tolist())

    def flush(self) -> list[Character]:
        """End the stream; see :class:`beacon_comm.core.demodulator.Demodulator`."""
        return all_of(self.ending())

    def ending(self) -> Iterator[list[Character] | float]:
        """End the stream in parts; see :class:`beacon_comm.core.demodulator.Searching`."""
        while True:
            if self._lock is None and len(self._t):
                piece_s = PIECE_COST_S + PASS_COST_S * len(self._events)
                for _ in self._search_the_last():
                    yield piece_s
            lock = self._lock
            if lock is None:
                return
            status, read = self._follow(lock, self._known_to)
            yield read
            if status == STILL_LOCKED:
                break
            if status != FULL:
                self._unlock(reread=status == LOST)
        count = end_detection(lock.clock, lock.detection, self._layout, self._rows)
        characters = self._characters(self._rows[:count])
        self._unlock(reread=True)
        self._ended = lock
        yield characters

    # Locked

    def _follow(self, lock: Lock, t_end: float) -> tuple[int, list[Character]]:
        """Take events up to ``t_end``; return whether the lock holds, and the characters."""
        rows = self._rows
        t, polarity = self._t, self._polarity
        refining = self._refine_at <= t_end
        until = self._refine_at if refining else t_end
        stop = int(np.searchsorted(t, until)) if refining else len(t)
        count, taken, status = detect(
            lock.clock,
            lock.detection,
            self._layout,
            lock.inverted,
            t[self._taken : stop],
            polarity[self._taken : stop],
            until,
            self._gaps,
            rows,
        )
        self._taken += taken
        characters = self._characters(rows[:count]) if count else []
        if refining and status == STILL_LOCKED:
            self._refine(lock, stop)
            status = FULL
        return status, characters

    def _refine(self, lock: Lock, stop: int) -> None:
        """Learn phase and histograms anew from what came since the lock, and go on from the last character."""
        period = float(lock.clock['period'][0])
        begin = self._refine_at - REFINED_AFTER * self._frame.length * period
        first = min(self._searcher.first(self._t, begin, max(self._refine_at, self._known_at)), stop)
        self._refine_at = math.inf
        window = slice(first, stop)
        periods = period * REFINED_PERIODS
        better = look_at_once(acquiring(self._t[window], self._polarity[window], periods, self._layout, REFINED_DEMANDS))
        if better is not None and better.inverted == lock.inverted:
            self._begin(better, max(self._given_to - 2.0 * self._frame.length * period, float(self._t[first])))

    def _unlock(self, *, reread: bool) -> None:
        assert self._lock is not None
        lost_at = float(self._lock.clock['border'][0])
        # What is lost in what was said before it was found would be found and lost there for ever.
        reread &= lost_at >= self._found_at
        self._usable_from = max(self._given_to, lost_at - self._reread(self._lock) if reread else lost_at)
        self._lock = None
        self._refine_at = math.inf
        self._taken = 0
        self._searcher.restart(max(lost_at, self._found_at))

    def _characters(self, rows: NDArray[np.float64]) -> list[Character]:
        characters = []
        for row in rows.tolist():
            character = self._character(row)
            if character is None:
                continue
            if self._trusted or row[KIND] in (KIND_OK, KIND_SEEN):
                pending, self._pending = self._pending, None
                if pending is not None and character.t_ns - pending.t_ns < ADJACENT_BITS * row[PERIOD_THEN]:
                    characters.append(pending)
                characters.append(character)
                self._trusted = True
                self._given_to = self._read_to
            else:
                self._pending = character  # perhaps read into what was there before the beacon
        return characters

    def _character(self, row: list[float]) -> Character | None:
        """Return the character of a row, None if it is not to be given out."""
        word, kind, period, start = int(row[WORD]), row[KIND], row[PERIOD_THEN], row[BORDER_OF_START]
        if kind == KIND_UNREADABLE or start < self._read_to - 0.5 * self._frame.length * period:
            return None
        self._read_to = start + self._frame.length * period
        code, status = self._decode[word]
        if kind in (KIND_SEEN, KIND_REPAIRED):
            status = Status.REPAIRED
        elif kind == KIND_NOISE and status is Status.OK:
            status = Status.FRAMING_ERROR
        return Character(
            t_ns=(self._origin_ns or 0) + round(start),
            code=code,
            status=status,
            confidence=0.0 if kind == KIND_NOISE else confidence_of(row[MARGIN]),
            frame=word,
            bit_rate_bps=NS_PER_S / period,
            bit_llr=tuple(row[FIRST_RATIO:]),
            edge_spread=row[SPREAD_THEN],
        )

    # Found

    def _search_the_last(self) -> Iterator[None]:
        """Search what the stream's end has left, piece by piece."""
        t, polarity = self._t, self._polarity
        found = yield from self._searcher.end_looks(t, self._usable_from)
        if found is not None:
            self._start(found)
            return
        found = yield from self._searcher.look_at_all(t, polarity, self._usable_from, self._known_to)
        if found is not None:
            self._start(found)
            self._refine_at = math.inf

    def _start(self, found: Found) -> None:
        """Follow a lock from the buffer's beginning on."""
        lock, now = found.lock, found.now
        border = float(lock.clock['border'][0])
        self._trusted = False
        self._pending = None
        self._read_to = self._given_to
        self._found_at, self._known_at = now, found.known_at
        self._refine_at = border + REFINED_AFTER * self._frame.length * lock.period
        if len(lock.positions) > (REFINED_AFTER - 5) * self._frame.length:
            self._refine_at = math.inf
        kept = min(self._searcher.longest, READ_BACK_CHARACTERS * self._frame.length * lock.period)
        # From an event on, as what lies before may be gone from the buffer already.
        self._begin(lock, float(self._t[max(found.first, int(np.searchsorted(self._t, now - kept)))]))

    def _begin(self, lock: Lock, t: float) -> None:
        """Follow a lock from about the time ``t`` (ns) on."""
        length = self._frame.length
        clock = lock.clock[0]
        bits = math.floor((t - clock['border']) / lock.period) - (MEMORY_BITS - 1)
        clock['border'] += bits * lock.period
        since_middle = bits - 0.5 * len(lock.positions)  # of the window, where the phase is known best
        clock['p_phase'] += since_middle * since_middle * clock['p_period']
        clock['p_cross'] += since_middle * clock['p_period']
        positions = lock.positions
        at = min(max(bits, 0), len(positions) - 1)
        framed = np.flatnonzero(positions[at:] < length)
        place = length
        if len(framed):
            at += int(framed[0])
            place = (int(positions[at]) + bits - at) % length
        start_at(lock.detection, place, length)
        self._taken = int(np.searchsorted(self._t, t))  # what lies before may be gone from the buffer
        self._lock = lock

    def _forget(self, t_end: float) -> None:
        """Drop the events that nothing can need any more."""
        if self._lock is not None:
            needed_from = max(self._given_to, t_end - self._reread(self._lock))
            if self._refine_at < math.inf:
                needed_from = min(needed_from, self._refine_at - 2.0 * REFINED_AFTER * self._frame.length * self._lock.period)
            too_much = len(self._t) - self._most_events
            first = min(self._taken, max(int(np.searchsorted(self._t, needed_from)), too_much))
        else:
            needed_from = self._searcher.needed_from(t_end)
            first = max(int(np.searchsorted(self._t, needed_from)), len(self._t) - self._most_events)
        if len(self._gaps):
            if self._lock is not None:  # how the next event is taken depends on whether the silence was one
                needed_from = min(needed_from, silent_since(self._lock.clock[0], self._lock.detection[0]))
            self._gaps = self._gaps[self._gaps[:, 1] > needed_from]
        self._events.drop(first)
        self._taken -= first

    def _reread(self, lock: Lock) -> float:
        return REREAD_CHARACTERS * self._frame.length * lock.period
