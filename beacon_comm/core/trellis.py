"""Sequence detection: the most likely bits, free and under the frame's structure (maximum likelihood, Viterbi).

Both trellises advance bit by bit on log p(counts | last 3 bits).  The *free* one knows nothing but those.  In the
*framed* one a state also says where in a character frame the bit lies and what parity it should have::

                ┌──────────────────────────────────────────────┐
                ▼                                              │
    start 0 ─► data ─► … ─► data ─► parity ─► stop 1 ─► stop 1 ┤        idle: only ones
                                                               ├─► idle ─┐
                                 every state ─► noise ─────────┘   ▲ └───┘
                                                 └─► start, idle

The state *noise* explains what is no character: any bits, at a price for each.  It is where an occlusion, another
light or an unknown sender leads, so that no character has to be read into them.
"""

from __future__ import annotations

from functools import lru_cache
from itertools import product

import numpy as np
from numba import njit
from numpy.typing import NDArray

from beacon_comm.core.character import Status
from beacon_comm.core.framing import CharacterFrame
from beacon_comm.core.likelihood import CONTEXTS

IDLE_COST = 8.0
"""Price of leaving the stream of characters for the idle line (nat)."""

IDLE_STAY_COST = 0.1
"""Price of each further idle bit (nat)."""

NOISE_COST = 40.0
"""Price of giving the frame up (nat)."""

NOISE_STAY_COST = 1.0
"""Price of each bit that is free (nat): more than a bit of a frame, that is free itself, should cost."""

NOISE_EXIT_COST = 2.0
"""Price of finding back into a frame (nat)."""

UNLIKELY = -1e30
"""Metric of a state that nothing leads to (nat): what is added to it is lost in rounding."""

MOST_BITS = 12
"""The longest frame: a start bit, 8 data bits, a parity bit and 2 stop bits."""

PLACE = 2 * CONTEXTS
"""States of one place in the frame: both parities, all contexts."""

STATES = (MOST_BITS + 2) * PLACE + CONTEXTS
"""Room for the states of any frame, and behind them for one block of contexts that nothing leads to."""

LAYOUT = np.dtype(
    [
        ('length', np.int64),
        ('states', np.int64),
        ('before', np.uint8, (STATES,)),
        ('words', np.uint8, (1 << MOST_BITS,)),
        ('fixed', np.int8, (MOST_BITS,)),
        ('parity', np.int64),
        ('checked', np.uint8, (MOST_BITS,)),
    ],
    align=True,
)
"""A character frame as numbers for the kernels.

A state of the framed trellis is ``(place · 2 + parity) · CONTEXTS + context``; the place is that of the state's own bit,
with ``length`` for idle and ``length + 1`` for noise.

Fields:
    length: bits of a frame.
    states: number of states.
    before: the lower one of the two states that lead to a state within the frame; the other is ``CONTEXTS // 2`` above.
    words: whether that many bits, the first one most significant, are a frame.
    fixed: forced bit of each place, -1 where it is free.
    parity: 0 even, 1 odd, -1 none.
    checked: whether a place is under the parity (data bits and parity bit).
"""


@lru_cache(maxsize=16)
def frame_layout(frame: CharacterFrame) -> NDArray[np.void]:
    """Return a character frame's layout, ``(1,)`` of ``LAYOUT``; computed once for equal frames, nobody writes to it."""
    layouts = np.zeros(1, LAYOUT)
    layout, length, first_stop = layouts[0], frame.length, frame.length - frame.stop_bits
    layout['length'], layout['states'] = length, (length + 2) * PLACE
    layout['words'][: 1 << length] = [status is Status.OK for _, status in frame.decoding_table()]
    layout['fixed'] = -1
    layout['fixed'][0] = 0
    layout['fixed'][first_stop:length] = 1
    layout['parity'] = {'even': 0, 'odd': 1, 'none': -1}[frame.parity]
    layout['checked'][1:first_stop] = frame.parity_bits
    layout['before'] = layout['states']
    parity_at = 1 + frame.data_bits if frame.parity_bits else -1
    for place, parity, context in product(range(1, length), (0, 1), range(CONTEXTS)):
        bit, parity_before = context & 1, 0
        if place >= first_stop:
            reached = bit == 1 and parity == 0
        elif place == parity_at:
            reached, parity_before = parity == 0, bit ^ (frame.parity == 'odd')
        elif frame.parity_bits:
            parity_before = parity ^ bit
            reached = place > 1 or parity_before == 0
        else:
            reached = parity == 0
        if reached:
            layout['before'][place * PLACE + parity * CONTEXTS + context] = (
                (place - 1) * PLACE + parity_before * CONTEXTS + (context >> 1)
            )
    return layouts


@njit(cache=True, nogil=True)
def free_step(metric, best, likelihoods):  # type: ignore[no-untyped-def]
    """Advance the free trellis by one bit; ``best[context]`` becomes the context before on its best path."""
    fresh = np.empty(CONTEXTS)
    top = UNLIKELY
    for context in range(CONTEXTS):
        low = context >> 1
        high = low | CONTEXTS >> 1
        best[context] = high if metric[high] > metric[low] else low
        fresh[context] = metric[best[context]] + likelihoods[context]
        top = max(top, fresh[context])
    for context in range(CONTEXTS):
        metric[context] = fresh[context] - top


@njit(cache=True, nogil=True)
def framed_step(layout, metric, fresh, best, likelihoods):  # type: ignore[no-untyped-def]
    """Advance the framed trellis by one bit; ``best[state]`` becomes the state before on its best path.

    Args:
        layout: a record of ``LAYOUT``.
        metric: ``(STATES,)`` float64, changed in place; ``UNLIKELY`` behind the layout's last state.
        fresh, best: room, ``(STATES,)`` float64 and uint8; behind the last state used for what is best of each context.
        likelihoods: log p of the bit's counts, ``(CONTEXTS,)`` float64.

    Returns:
        what the best metric rose by; it is 0 afterwards.
    """
    half, states, before = CONTEXTS // 2, layout.states, layout.before
    end, idle, noise = _special_states(layout)
    for to in range(PLACE, idle):
        low = before[to]
        high = low + half
        higher = metric[high] > metric[low]
        fresh[to] = metric[high] if higher else metric[low]
        best[to] = high if higher else low
    for place in (0, idle, noise):
        fresh[place : place + PLACE] = UNLIKELY
        best[place : place + PLACE] = 0
    for context in range(CONTEXTS):
        low, bit = context >> 1, context & 1
        to = context + (idle if bit else 0)
        for source, cost in ((end, IDLE_COST * bit), (idle, IDLE_STAY_COST), (noise, NOISE_EXIT_COST)):
            _take(metric, fresh, best, source + low, to, cost)
            _take(metric, fresh, best, source + low + half, to, cost)
        _take(metric, fresh, best, noise + low, noise + context, NOISE_STAY_COST)
        _take(metric, fresh, best, noise + low + half, noise + context, NOISE_STAY_COST)
    _enter_noise(metric, fresh, best, states, noise)
    tops = fresh[states : states + CONTEXTS]
    tops[:] = UNLIKELY
    for first in range(0, states, CONTEXTS):
        for context in range(CONTEXTS):
            value = fresh[first + context] + likelihoods[context]
            fresh[first + context] = value
            tops[context] = value if value > tops[context] else tops[context]
    top = tops.max()
    for state in range(states):
        metric[state] = fresh[state] - top
    return top


@njit(cache=True, nogil=True)
def _special_states(layout):  # type: ignore[no-untyped-def]
    """Return the first states of the last bit of a frame, of idle and of noise."""
    return (layout.length - 1) * PLACE, layout.length * PLACE, (layout.length + 1) * PLACE


@njit(cache=True, nogil=True)
def _take(metric, fresh, best, source, to, cost):  # type: ignore[no-untyped-def]
    """Lead ``source`` to ``to`` if nothing better does."""
    value = metric[source] - cost
    if value > fresh[to]:
        fresh[to] = value
        best[to] = source


@njit(cache=True, nogil=True)
def _enter_noise(metric, fresh, best, states, noise):  # type: ignore[no-untyped-def]
    """Lead the best state of each context to noise."""
    value, nearest = fresh[states : states + CONTEXTS], best[states : states + CONTEXTS]
    value[:] = UNLIKELY
    nearest[:] = 0
    for first in range(0, states, CONTEXTS):
        for context in range(CONTEXTS):
            here = metric[first + context]
            if here > value[context]:
                value[context] = here
                nearest[context] = first + context
    for context in range(CONTEXTS):
        for bit in range(2):
            to = noise + ((context << 1 | bit) & (CONTEXTS - 1))
            _take(metric, fresh, best, nearest[context], to, NOISE_COST)


@njit(cache=True, nogil=True)
def framed_metric(layout):  # type: ignore[no-untyped-def]
    """Return the metric with which every path begins alike, ``(STATES,)`` float64."""
    metric = np.full(STATES, UNLIKELY)
    metric[: layout.states] = 0.0
    return metric


@njit(cache=True, nogil=True)
def free_bits(likelihoods):  # type: ignore[no-untyped-def]
    """Return the most likely bits of a stretch, ``(n,)`` uint8, from log p ``(n, CONTEXTS)``."""
    count = len(likelihoods)
    metric = np.zeros(CONTEXTS)
    best = np.empty((count, CONTEXTS), np.int32)
    for n in range(count):
        free_step(metric, best[n], likelihoods[n])
    bits = np.empty(count, np.uint8)
    state = np.argmax(metric)
    for n in range(count - 1, -1, -1):
        bits[n] = state & 1
        state = best[n, state]
    return bits


@njit(cache=True, nogil=True)
def framed_path(layouts, likelihoods):  # type: ignore[no-untyped-def]
    """Return the states on the most likely framed path, ``(n,)`` int32, and its log likelihood (nat)."""
    layout, count = layouts[0], len(likelihoods)
    metric, fresh = framed_metric(layout), np.empty(STATES)
    best = np.empty((count, STATES), np.uint8)
    total = 0.0
    for n in range(count):
        total += framed_step(layout, metric, fresh, best[n], likelihoods[n])
    path = np.empty(count, np.int32)
    state = np.argmax(metric)
    for n in range(count - 1, -1, -1):
        path[n] = state
        state = best[n, state]
    return path, total


@njit(cache=True, nogil=True)
def place_margin(layouts, likelihoods, at):  # type: ignore[no-untyped-def]
    """Return by how much (nat) the best path beats the best one on which the bit ``at`` has another place in its frame."""
    layout = layouts[0]
    metric, fresh, best = framed_metric(layout), np.empty(STATES), np.empty(STATES, np.uint8)
    for n in range(at + 1):
        framed_step(layout, metric, fresh, best, likelihoods[n])
    later = framed_metric(layout)
    for n in range(len(likelihoods) - 1, at, -1):
        _framed_step_back(layout, later, fresh, likelihoods[n])
    places = np.full(layout.length + 2, UNLIKELY)
    for state in range(layout.states):
        place = state // PLACE
        places[place] = max(places[place], metric[state] + later[state])
    places.sort()
    return places[-1] - places[-2]


@njit(cache=True, nogil=True)
def _framed_step_back(layout, later, fresh, likelihoods):  # type: ignore[no-untyped-def]
    """Take the metric of what follows, ``(STATES,)`` float64, back by the bit that has these likelihoods."""
    half, states, before = CONTEXTS // 2, layout.states, layout.before
    end, idle, noise = _special_states(layout)
    for state in range(states):
        later[state] += likelihoods[state & (CONTEXTS - 1)]
    for state in range(states):
        to = noise + ((state << 1) & (CONTEXTS - 1))
        fresh[state] = max(later[to], later[to + 1]) - NOISE_COST
    for to in range(PLACE, idle):
        low = before[to]
        fresh[low] = max(fresh[low], later[to])
        fresh[low + half] = max(fresh[low + half], later[to])
    for context in range(CONTEXTS):
        start = (context << 1) & (CONTEXTS - 1)  # of a frame, or idle with the next context
        for source, cost in ((end, IDLE_COST), (idle, IDLE_STAY_COST), (noise, NOISE_EXIT_COST)):
            begins = later[start] - (0.0 if source == end else cost)
            fresh[source + context] = max(fresh[source + context], begins, later[idle + start + 1] - cost)
        stays = max(later[noise + start], later[noise + start + 1]) - NOISE_STAY_COST
        fresh[noise + context] = max(fresh[noise + context], stays)
    later[:states] = fresh[:states]
