"""End-bit detection and synchronisation: edges in, the spans of characters out (section III-B.4).

From the start edge t₍ₖ₋₁₎ of a character, the start edge tₖ of the next one is looked for in a window::

        start                                                     stop stop start
    ────┐                                                        ┌─────────┐
        │   d6   d5   d4   d3   d2   d1   d0   p                 │         │
        └────╴                                             ──────┘         └────╴
        t₍ₖ₋₁₎                                        [t+T−5Δt        t+T  t+T+Δt]      T = 11 / f,  Δt = T / 22

The falling edge furthest to the right is taken.  Without one, t₍ₖ₋₁₎ + T is (*bridged*).  Out of synchronisation the
window sees a fall further left about every fourth time, so the estimate slips left until it sits on the start bit.

Added to the paper's rules:

* *Idle* (``idle_start``): a legal line is high for 10 bits at most (7 data bits, parity, 2 stop bits), so the first
  fall after 10.5 or more high bits is a start bit: bridging stops, the search starts anew.  Without the rule a line
  has to be high for three characters until the search starts anew.
* *Break*: a legal line is low for 9 bits at most; 12 or more low bits (11.5 as read) are a break, and no character
  that reaches into it is given out.
* *Silence decodes as nothing*: a character is given out if its start edge was seen, or if it was bridged between two
  seen edges two frames apart.
* *Trials*: the paper starts at the first falling edge it meets and slips left until it sits on a start bit, which
  takes some 30 characters of English text from an unlucky edge.  A character has five falling edges at most, so one
  of the first five *is* a start bit: with several trials, trial j starts at falling edge j.  Trials never know of each
  other; those that come to the same edge stay together.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from beacon_comm.core.events import NS_PER_S
from beacon_comm.core.framing import CharacterFrame
from beacon_comm.core.high_pass import Edges

BREAK_BITS_OVER_LENGTH = 0.5
"""A break is so many bits longer than a character: of 12 bits, less half a bit, since its edges come late or early."""

IDLE_BITS_OVER_LENGTH = -0.5
"""An idle line is high for so many bits more than a character has: 10.5 bits."""

BITS_AFTER_DUE = 0.5
"""Δt: the search window reaches so many bits behind where the next start edge is due; then the character is decided."""

QUIET_CHARACTERS = 3
"""Without ``idle_start``: a line that is high for so many characters has no synchronisation left to keep."""

# The state of one trial, an int64 array.
_IN_FRAME, _START, _BRIDGED, _HAS_END, _END, _LEVEL, _CHANGED, _EDGES_TO_SKIP, _TRIAL, _STATE_SIZE = range(10)
# The columns of a span, an int64 array.
_SPAN_START, _SPAN_STOP, _SPAN_START_SEEN, _SPAN_STOP_SEEN, _SPAN_DECIDED, _SPAN_BY_EDGE, _SPAN_TRIAL, _SPAN_SIZE = range(8)

_UNKNOWN = -(1 << 61)
"""Time of the last change of the level, before there was one."""


class Span(NamedTuple):
    """Where one character lies.

    Attributes:
        start_ns: its start edge (ns), or where that is bridged.
        stop_ns: the next character's start edge (ns), or ``start_ns + T``.
        start_seen: whether the start edge was seen.
        stop_seen: whether the end edge was seen.
        decided_ns: the stream's time from which on this is known (ns); never decreases from span to span.
        by_edge: whether an edge at ``decided_ns`` decided it, or that time alone.
        trial: which of the trials found it.
    """

    start_ns: int
    stop_ns: int
    start_seen: bool
    stop_seen: bool
    decided_ns: int
    by_edge: bool = False
    trial: int = 0


class EndBitSynchroniser:
    """Follows the characters of one line by the falling edges of their start bits.

    Args:
        bit_rate_bps: the nominal bit rate f (bit/s); the true one may differ by a percent.
        frame: the character frame.
        idle_start: whether the first fall after an idle line is taken as a start bit.
        trials: number of trials, 1 for the paper to the letter.
    """

    def __init__(self, bit_rate_bps: float, frame: CharacterFrame, idle_start: bool = True, trials: int = 1) -> None:
        length = frame.length
        bits = np.array(
            [
                length,  # T
                frame.stop_bits + 0.5,  # the window to the left: 5Δt, half a bit more than the stop bits
                BITS_AFTER_DUE,  # the window to the right: Δt
                length + IDLE_BITS_OVER_LENGTH if idle_start else length * QUIET_CHARACTERS,
                length + BREAK_BITS_OVER_LENGTH,
            ]
        )
        self._durations = np.rint(bits * (NS_PER_S / bit_rate_bps)).astype(np.int64)
        self._idle_start = idle_start
        self._states = np.zeros((trials, _STATE_SIZE), np.int64)
        self._states[:, _LEVEL] = 1
        self._states[:, _CHANGED] = _UNKNOWN
        self._states[:, _EDGES_TO_SKIP] = self._states[:, _TRIAL] = np.arange(trials)
        self._t_end_ns = 0

    @property
    def needed_from_ns(self) -> int:
        """Time (ns) from which on edges may still be needed: the earliest start of a character being received."""
        receiving = self._states[:, _IN_FRAME] != 0
        return int(np.where(receiving, self._states[:, _START], self._t_end_ns).min())

    def push(self, edges: Edges, t_end_ns: int) -> list[Span]:
        """Take the next edges and return the spans of the characters that are decided by now, in order of decision.

        Args:
            edges: the edges since the last call.
            t_end_ns: the stream's time (ns): every edge still to come has ``t >= t_end_ns``.
        """
        spans = np.empty((len(self._states) * (2 * len(edges.t_ns) + 2), _SPAN_SIZE), np.int64)
        count = _follow_all(
            self._states, self._durations, self._idle_start, edges.t_ns, edges.rising, t_end_ns, spans
        )
        self._t_end_ns = t_end_ns
        return _as_spans(spans[:count])

    def miss(self, stop_ns: int) -> None:
        """Know nothing of the line from now to ``stop_ns`` (ns): frames run on.

        The level may have changed unseen, and then so does the next edge pass: it says nothing for a character more.
        """
        self._states[:, _CHANGED] = stop_ns + self._durations[0]

    def lose(self) -> None:
        """Give every trial's synchronisation up."""
        self._states[:, _IN_FRAME] = 0
        self._states[:, _EDGES_TO_SKIP] = self._states[:, _TRIAL]

    def flush(self) -> list[Span]:
        """End the stream: return the character that has come as far as the middle of its last bit, if there is one."""
        spans = np.empty((len(self._states), _SPAN_SIZE), np.int64)
        count = _end_all(self._states, self._durations, self._t_end_ns, spans)
        return _as_spans(spans[:count])


def _as_spans(rows: NDArray[np.int64]) -> list[Span]:
    spans = [
        Span(start, stop, start_seen != 0, stop_seen != 0, decided, by_edge != 0, trial)
        for start, stop, start_seen, stop_seen, decided, by_edge, trial in rows.tolist()
    ]
    if len(spans) > 1:
        spans.sort(key=lambda span: (span.decided_ns, span.by_edge, span.trial))
    return spans


@njit(cache=True, nogil=True)
def _give(state, spans, count, stop, stop_seen, decided, by_edge):  # type: ignore[no-untyped-def]
    """Close the frame at ``stop`` and open the next one there; write the span if it is to be given out."""
    bridged = state[_BRIDGED]
    if bridged == 0 or (bridged == 1 and stop_seen):
        spans[count, _SPAN_START] = state[_START]
        spans[count, _SPAN_STOP] = stop
        spans[count, _SPAN_START_SEEN] = bridged == 0
        spans[count, _SPAN_STOP_SEEN] = stop_seen
        spans[count, _SPAN_DECIDED] = decided
        spans[count, _SPAN_BY_EDGE] = by_edge
        spans[count, _SPAN_TRIAL] = state[_TRIAL]
        count += 1
    state[_START] = stop
    state[_BRIDGED] = 0 if stop_seen else bridged + 1
    state[_HAS_END] = 0
    return count


@njit(cache=True, nogil=True)
def _lose(state):  # type: ignore[no-untyped-def]
    """Give the synchronisation up and wait for a falling edge."""
    state[_IN_FRAME] = 0
    state[_EDGES_TO_SKIP] = state[_TRIAL]


@njit(cache=True, nogil=True)
def _advance(state, durations, now, changes_now, spans, count):  # type: ignore[no-untyped-def]
    """Decide what is known at the time ``now``, at which the level changes or does not; return the span count."""
    length, _, after, idle, lowest = durations
    while state[_IN_FRAME]:
        high = state[_LEVEL] == 1
        since = state[_CHANGED]
        if high and state[_BRIDGED] > 0 and not state[_HAS_END] and now >= since + idle:
            _lose(state)
            break
        window_end = state[_START] + length + after
        if now <= window_end:
            break
        if state[_HAS_END]:
            count = _give(state, spans, count, state[_END], True, window_end + 1, False)
            continue
        stop = state[_START] + length
        if not high and since < stop:  # low across the frame's end: this may be the beginning of a break
            if now >= since + lowest or not changes_now:
                break
            count = _give(state, spans, count, stop, False, now, True)
        else:
            count = _give(state, spans, count, stop, False, window_end + 1, False)
    if state[_IN_FRAME] and state[_LEVEL] == 0 and now >= state[_CHANGED] + lowest:
        _lose(state)
    return count


@njit(cache=True, nogil=True)
def _fall(state, durations, idle_start, t, spans, count):  # type: ignore[no-untyped-def]
    """Take a falling edge; return the span count."""
    length, before, after, idle, _ = durations
    was_idle = idle_start and state[_CHANGED] != _UNKNOWN and t - state[_CHANGED] >= idle
    due = state[_START] + length
    if not state[_IN_FRAME]:
        if was_idle or state[_EDGES_TO_SKIP] == 0:
            state[_IN_FRAME] = 1
            state[_START] = t
            state[_BRIDGED] = 0
            state[_HAS_END] = 0
        else:
            state[_EDGES_TO_SKIP] -= 1
    elif due - before <= t <= due + after:
        if was_idle:  # a start bit for certain: no edge further right can be one
            count = _give(state, spans, count, t, True, t, True)
        else:
            state[_HAS_END] = 1
            state[_END] = t
    return count


@njit(cache=True, nogil=True)
def _follow_all(states, durations, idle_start, edge_t, edge_rising, t_end, spans):  # type: ignore[no-untyped-def]
    """Take edges one by one, then the stream's time; return the number of spans of all trials."""
    count = 0
    for state in states:
        for i in range(len(edge_t)):
            t = edge_t[i]
            count = _advance(state, durations, t, True, spans, count)
            if not edge_rising[i]:
                count = _fall(state, durations, idle_start, t, spans, count)
            state[_LEVEL] = 1 if edge_rising[i] else 0
            state[_CHANGED] = t
        count = _advance(state, durations, t_end, False, spans, count)
    return count


@njit(cache=True, nogil=True)
def _end_all(states, durations, t_end, spans):  # type: ignore[no-untyped-def]
    """Close the running frames whose last bit was seen; return the number of spans."""
    count = 0
    length, _, after, _, _ = durations
    for state in states:
        if state[_IN_FRAME]:
            stop = state[_START] + length
            low_across_end = state[_LEVEL] == 0 and state[_CHANGED] < stop
            if state[_HAS_END]:
                count = _give(state, spans, count, state[_END], True, t_end, False)
            elif t_end >= stop - after and not low_across_end:
                count = _give(state, spans, count, stop, False, t_end, False)
        _lose(state)
    return count
