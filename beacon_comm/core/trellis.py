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
from typing import NamedTuple

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


class Transitions(NamedTuple):
    """All transitions of the framed trellis but those into noise, sorted by where they lead.

    A state is ``(position · 2 + parity) · CONTEXTS + context``; the position is that of the state's own bit, with
    ``length`` for idle and ``length + 1`` for noise.  Noise can be entered from everywhere, for ``NOISE_COST``: of the states
    of one context the best does it.

    Attributes:
        source, target: states, ``(n,)`` int32.
        cost: price (nat), ``(n,)`` float64.
        states: number of states.
        length: bits of a frame.
        words: whether that many bits, the first one most significant, are a frame, ``(2**length,)`` bool.
    """

    source: NDArray[np.int32]
    target: NDArray[np.int32]
    cost: NDArray[np.float64]
    states: int
    length: int
    words: NDArray[np.bool_]


@lru_cache(maxsize=16)
def framed_transitions(frame: CharacterFrame) -> Transitions:
    """Return the framed trellis of a character frame; computed once for equal layouts, nobody writes to it."""
    length = frame.length
    idle, noise = length, length + 1
    parity_at = 1 + frame.data_bits if frame.parity_bits else -1
    first_stop = length - frame.stop_bits
    found: list[tuple[int, int, float]] = []

    def state(position: int, parity: int, context: int) -> int:
        return (position * 2 + parity) * CONTEXTS + context

    def add(source: int, position: int, parity: int, context: int, bit: int, cost: float) -> None:
        found.append((state(position, parity, (context << 1 | bit) & (CONTEXTS - 1)), source, cost))

    def add_within(source: int, position: int, parity: int, context: int) -> None:
        """Add what may follow inside a frame: ``position`` is the next bit's."""
        for bit in (0, 1):
            if position >= first_stop:
                if bit == 1:
                    add(source, position, 0, context, bit, 0.0)
            elif position == parity_at:
                if bit == parity ^ (frame.parity == 'odd'):
                    add(source, position, 0, context, bit, 0.0)
            else:
                after = parity ^ bit if frame.parity_bits else 0
                add(source, position, after, context, bit, 0.0)

    for context in range(CONTEXTS):
        for position in range(length):
            for parity in (0, 1) if 0 < position < first_stop else (0,):
                here = state(position, parity, context)
                if position == length - 1:
                    add(here, 0, 0, context, 0, 0.0)
                    add(here, idle, 0, context, 1, IDLE_COST)
                else:
                    add_within(here, position + 1, parity, context)
        here = state(idle, 0, context)
        add(here, idle, 0, context, 1, IDLE_STAY_COST)
        add(here, 0, 0, context, 0, IDLE_STAY_COST)
        here = state(noise, 0, context)
        for bit in (0, 1):
            add(here, noise, 0, context, bit, NOISE_STAY_COST)
        add(here, 0, 0, context, 0, NOISE_EXIT_COST)
        add(here, idle, 0, context, 1, NOISE_EXIT_COST)
    found.sort()
    target, source, cost = zip(*found, strict=True)
    return Transitions(
        np.array(source, np.int32),
        np.array(target, np.int32),
        np.array(cost, np.float64),
        (length + 2) * 2 * CONTEXTS,
        length,
        np.array([status is Status.OK for _, status in frame.decoding_table()]),
    )


UNLIKELY = -1e30


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
def framed_step(source, target, cost, metric, fresh, best, likelihoods):  # type: ignore[no-untyped-def]
    """Advance the framed trellis by one bit; ``best[state]`` becomes the state before on its best path."""
    for state in range(len(metric)):
        fresh[state] = UNLIKELY
        best[state] = -1
    for i in range(len(source)):
        value = metric[source[i]] - cost[i]
        if value > fresh[target[i]]:
            fresh[target[i]] = value
            best[target[i]] = source[i]
    noise = len(metric) - 2 * CONTEXTS
    for context in range(CONTEXTS):
        nearest = context
        for state in range(context, len(metric), CONTEXTS):
            if metric[state] > metric[nearest]:
                nearest = state
        for bit in range(2):
            to = noise + ((context << 1 | bit) & (CONTEXTS - 1))
            if metric[nearest] - NOISE_COST > fresh[to]:
                fresh[to] = metric[nearest] - NOISE_COST
                best[to] = nearest
    top = UNLIKELY
    for state in range(len(metric)):
        if fresh[state] > UNLIKELY / 2:
            fresh[state] += likelihoods[state & (CONTEXTS - 1)]
            top = max(top, fresh[state])
    for state in range(len(metric)):
        metric[state] = fresh[state] - top if fresh[state] > UNLIKELY / 2 else UNLIKELY
    return top


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
def framed_path(transitions, likelihoods):  # type: ignore[no-untyped-def]
    """Return the states on the most likely framed path, ``(n,)`` int32, and its log likelihood (nat)."""
    count = len(likelihoods)
    metric = np.zeros(transitions.states)
    fresh = np.empty(transitions.states)
    best = np.empty((count, transitions.states), np.int32)
    total = 0.0
    for n in range(count):
        total += framed_step(
            transitions.source, transitions.target, transitions.cost, metric, fresh, best[n], likelihoods[n]
        )
    path = np.empty(count, np.int32)
    state = np.argmax(metric)
    for n in range(count - 1, -1, -1):
        path[n] = state
        state = best[n, state]
    return path, total


@njit(cache=True, nogil=True)
def place_margin(transitions, likelihoods, at):  # type: ignore[no-untyped-def]
    """Return by how much (nat) the best path beats the best one on which the bit ``at`` has another place in its frame."""
    metric = np.zeros(transitions.states)
    fresh = np.empty(transitions.states)
    best = np.empty(transitions.states, np.int32)
    for n in range(at + 1):
        framed_step(transitions.source, transitions.target, transitions.cost, metric, fresh, best, likelihoods[n])
    source, target, cost = transitions.source, transitions.target, transitions.cost
    later = np.zeros(transitions.states)
    for n in range(len(likelihoods) - 1, at, -1):
        noise = transitions.states - 2 * CONTEXTS
        for state in range(transitions.states):
            to = (state << 1) & (CONTEXTS - 1)
            low, high = later[noise + to] + likelihoods[n, to], later[noise + to + 1] + likelihoods[n, to + 1]
            fresh[state] = max(low, high) - NOISE_COST
        for i in range(len(source)):
            value = later[target[i]] + likelihoods[n, target[i] & (CONTEXTS - 1)] - cost[i]
            if value > fresh[source[i]]:
                fresh[source[i]] = value
        later[:] = fresh
    places = np.full(transitions.length + 2, UNLIKELY)
    for state in range(transitions.states):
        place = state // (2 * CONTEXTS)
        places[place] = max(places[place], metric[state] + later[state])
    places.sort()
    return places[-1] - places[-2]
