"""The locked part of the sequence receiver: events in, decided words out, bit by bit and with a bounded delay.

::

    events ─► bit clock ─► counts ─► log p(counts | last 3 bits) ─┬─► free trellis ───┬─► word ─► soft decision
                 ▲                        ▲                       └─► framed trellis ─┘             │
                 └── frozen or not ───────┴── histograms, gain ◄────── words that are ok ◄──────────┘

A word is decided two frames after its end (22 bits): by then every path that survives shares it, and a slip of the
frame has shown itself.  With it the paths that disagree are dropped, so that what follows fits what was said.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from beacon_comm.core.bit_clock import BORDER, EDGE_LAG, P_PHASE, PERIOD, VARIANCE, go_on, see_edge, take_events
from beacon_comm.core.likelihood import CONTEXTS, COUNTS, LEVELS, MEMORY_BITS, SUB_SLOTS, learn, logarithms, weigh
from beacon_comm.core.soft_decision import bit_ratios, margins
from beacon_comm.core.trellis import NOISE_COST, UNLIKELY, framed_step, free_step

DELAY_FRAMES = 2
"""A word is decided so many frames after its end."""

OK_FRAME_MARGIN = 6.0
"""A frame margin (nat) from which on a word is ok although the free bits differ …"""

OK_MARGIN = 12.0
"""… or a bit of it is an erasure; and in any case it has to beat every other word and path by this (nat): the calibration
of the confidence gives such a word 0.98."""

SEEN_MARGIN = 4.0
"""A word that is otherwise ok and beats the others by this (nat) is not ok, but shows that there is a beacon."""

READABLE_MARGIN = 3.0
"""A word with an erased bit that beats the next one by less (nat) is not given out: it would be invented."""

LEAST_FIT, FEW_WORDS = 8.0, 4
"""A word whose bits are so much less likely (nat a bit) than usual is not ok: other light, and noise, can look like bits.
Twice as much where the tables are of so few words: words that were learnt from fit too well."""

UNSEEN_FALL = 15.0
"""A word is not ok that is so much likelier (nat) to follow a 0 than a 1."""

LEAST_EVENTS = 0.1
"""A word with less than this share of the events that its bits should have is read into a silence: it is not given out.

A start bit is a fall and the stop bits end in a rise, so that there is no word without events, nor without ON events
(a fall may go unseen far away).
"""

RISES_WEIGHT = 3.0
"""The ON events are at least a third of a word's."""

MOST_MARGIN = 100.0
"""Margins are not told beyond this (nat)."""

LEARNING_MARGIN = 8.0
"""A word margin (nat) from which on a word is learnt from, ok or only repaired: the ok ones alone would bias."""

LEARNING_MEMORY = 300
"""Words after which what was learnt has faded to 1/e."""

RELEARN_EVERY = 8
"""The tables are computed anew after so many words (at first after 1, 2, 4)."""

GAIN_SHARE = 0.2
"""Share of a word's log amplitude that the gain follows."""

SILENT_SHARE = 0.1
"""A bit with less than this share of a mean bit's events is silent …"""

RARELY_SILENT = 0.02
"""… and an erasure if no more than this share of the signal's bits is silent.

Where held bits are often silent, silence says that they are held.
"""

EMPTY_EVIDENCE = 9.0
"""Bits without any event are erasures, too, where so many follow one another that held bits are so seldom (nat)."""

LEAST_EMPTY, MOST_EMPTY = 0.1, 0.99
"""The share of held bits without any event is never taken for less or for more."""

LOST_FRAMES = 15
"""So many frames more in doubt than ok, and the lock is given up."""

SLEEP_FRAMES = 6
"""After so many frames without any event nothing is left to decide, and the clock runs on alone."""

UNKNOWN_PLACE_COST = 8.0
"""Price of beginning at another place in the frame than the lock's, or the one that the clock says behind a gap (nat)."""

MOST_UNSURE = 0.12
"""Where the phase is less sure than this (bit) behind a gap, the lock is given up: a new one reads what came since."""

RING = 64
_RING_MASK = RING - 1

GAIN, SILENCE, USUAL, EMPTY = range(4)
HEARD, SILENT, MISSING = range(3)

# Whole numbers of the state.
BIT, LEARNT, NEXT_TABLES, NOISE_RUN, DOUBT, SILENT_RUN, ASLEEP, BEGUN = range(8)

# What a row of words tells.
WORD, KIND, BORDER_OF_START, MARGIN, PERIOD_THEN, SPREAD_THEN, FIRST_RATIO = range(7)
KIND_OK, KIND_SEEN, KIND_REPAIRED, KIND_NOISE, KIND_UNREADABLE = range(5)
STILL_LOCKED, LOST, LOST_IN_GAP, FULL = range(4)


class Detection(NamedTuple):
    """State of the locked receiver.

    Attributes:
        histograms, tables: see :mod:`beacon_comm.core.likelihood`, ``(CONTEXTS, COUNTS, LEVELS)`` float64.
        means: events of a bit for each context, after the gain, ``(CONTEXTS,)`` float64.
        levels: ``(4,)`` float64: the gain, by which counts are divided before they are compressed, the share of
            silent bits in words, the mean log p of a word's bit (nat), and the share of held bits without any event.
        compression: see :func:`beacon_comm.core.likelihood.compression_table`.
        free_metric, free_bits: of the free trellis, ``(CONTEXTS,)`` float64 and int64 (last 64 bits of the path).
        metric, bits, ends, noises: of the framed trellis, ``(states,)`` float64 and int64: the last 64 bits of the
            best path to the state, and for each of them whether it ended a frame or was noise.
        likelihoods, counts, totals, rises, borders, silent: of the last ``RING`` bits; rises are the ON events, and silent is
            ``HEARD``, ``SILENT`` or ``MISSING``.
        numbers: see the constants above, ``(8,)`` int64; a word's bits begin at ``BEGUN`` at the earliest.
    """

    histograms: NDArray[np.float64]
    tables: NDArray[np.float64]
    means: NDArray[np.float64]
    levels: NDArray[np.float64]
    compression: NDArray[np.uint8]
    free_metric: NDArray[np.float64]
    free_bits: NDArray[np.int64]
    metric: NDArray[np.float64]
    bits: NDArray[np.int64]
    ends: NDArray[np.int64]
    noises: NDArray[np.int64]
    likelihoods: NDArray[np.float64]
    counts: NDArray[np.uint8]
    totals: NDArray[np.float64]
    rises: NDArray[np.float64]
    borders: NDArray[np.float64]
    silent: NDArray[np.uint8]
    numbers: NDArray[np.int64]


def make_detection(
    histograms: NDArray[np.float64],
    means: NDArray[np.float64],
    gain: float,
    silence: float,
    usual: float,
    empty: float,
    learnt: int,
    compression: NDArray[np.uint8],
    states: int,
) -> Detection:
    """Return the state at the start of a lock.

    Args:
        histograms, means: learnt while the lock was sought.
        gain, silence, usual, empty: see :class:`Detection`.
        learnt: number of words in the histograms.
        compression: table of compressed counts.
        states: of the framed trellis.
    """
    tables = np.empty_like(histograms)
    logarithms(histograms, tables)
    return Detection(
        histograms=histograms,
        tables=tables,
        means=means,
        levels=np.array([gain, silence, usual, empty]),
        compression=compression,
        free_metric=np.zeros(CONTEXTS),
        free_bits=np.zeros(CONTEXTS, np.int64),
        metric=np.zeros(states),
        bits=np.zeros(states, np.int64),
        ends=np.zeros(states, np.int64),
        noises=np.zeros(states, np.int64),
        likelihoods=np.zeros((RING, CONTEXTS)),
        counts=np.zeros((RING, COUNTS), np.uint8),
        totals=np.zeros(RING),
        rises=np.zeros(RING),
        borders=np.zeros(RING),
        silent=np.zeros(RING, np.uint8),
        numbers=np.array([0, learnt, learnt + 1, 0, 0, 0, 0, MEMORY_BITS - 1], np.int64),
    )


def start_at(state: Detection, position: int, length: int) -> None:
    """Begin with a bit at a place of the frame; ``length`` or above: at none.

    The bit's own likelihood is still to come, so the paths begin one place before.
    """
    state.metric[:] = -UNKNOWN_PLACE_COST
    before = (position - 1) % length if position < length else position
    state.metric[before * 2 * CONTEXTS : (before + 1) * 2 * CONTEXTS] = 0.0


@njit(cache=True, nogil=True)
def detect(  # type: ignore[no-untyped-def]
    clock, state, transitions, layout, inverted, t, polarity, t_end, gaps, rows
):
    """Take events, then the stream's time; write rows of decided words.

    Args:
        clock, state: changed in place.
        transitions, layout: of the character frame.
        inverted: True if the LED is on for 0.
        t, polarity: events, ns from the origin (float64) and ±1 (int8).
        t_end: the stream's time (ns from the origin).
        gaps: beginnings and ends of stretches whose events are missing (ns from the origin), ``(k, 2)`` float64.
        rows: ``(n, FIRST_RATIO + length)`` float64, to be written.

    Returns:
        number of rows, number of events taken, and STILL_LOCKED, LOST, LOST_IN_GAP or FULL (call again with the rest).
    """
    values, numbers, length = clock.values, state.numbers, transitions.length
    sign = -1 if inverted else 1
    i, count = 0, 0
    while True:
        if count + 2 > len(rows):
            return count, i, FULL
        if numbers[ASLEEP]:
            if i == len(t):
                return count, i, STILL_LOCKED
            if not _wake(clock, state, transitions, gaps, t[i]):
                return count, i, LOST_IN_GAP
        end = values[BORDER] + values[PERIOD]
        i = take_events(clock, t, polarity, i, sign, not _missing(gaps, end - (EDGE_LAG + 2) * values[PERIOD], end))
        if i == len(t) and t_end < values[BORDER] + values[PERIOD]:
            return count, i, STILL_LOCKED
        count = _close_bit(clock, state, transitions, layout, gaps, rows, count)
        go_on(clock, 1)
        if numbers[DOUBT] > LOST_FRAMES * length:
            return count, i, LOST
        if numbers[SILENT_RUN] > SLEEP_FRAMES * length:
            numbers[ASLEEP] = 1


@njit(cache=True, nogil=True)
def _missing(gaps, start, stop):  # type: ignore[no-untyped-def]
    """Return whether events are missing between two times (ns)."""
    missing = False
    for k in range(len(gaps)):
        missing |= gaps[k, 0] < stop and start < gaps[k, 1]
    return missing


@njit(cache=True, nogil=True)
def silent_since(clock, state):  # type: ignore[no-untyped-def]
    """Return since when (ns from the origin) there has been no event; the present bit not counted."""
    return clock.values[BORDER] - state.numbers[SILENT_RUN] * clock.values[PERIOD]


@njit(cache=True, nogil=True)
def _wake(clock, state, transitions, gaps, t):  # type: ignore[no-untyped-def]
    """Go on just before an event after a long silence.

    A silence is an idle line, which a start bit ends.  Where events were missing, the sender is taken to have gone on:
    the first place in a frame is the one that is next by the clock.

    Returns:
        whether the clock still says where the bits begin.
    """
    values, numbers, length = clock.values, state.numbers, transitions.length
    in_gap = _missing(gaps, silent_since(clock, state), t)
    skipped = max(np.floor((t - values[BORDER]) / values[PERIOD]) - 1.0, 0.0)
    if skipped > 0.0:
        go_on(clock, skipped)
    clock.frozen[0] = False
    clock.run[0] = 0
    if in_gap:
        place = np.argmax(state.metric) // (2 * CONTEXTS)
        state.metric[:] = -UNKNOWN_PLACE_COST
        if place < length:
            place = (place + int(skipped)) % length
        state.metric[place * 2 * CONTEXTS : (place + 1) * 2 * CONTEXTS] = 0.0
    else:
        state.metric[:] = UNLIKELY
        state.metric[length * 2 * CONTEXTS + CONTEXTS - 1] = 0.0
        for context in range(CONTEXTS):
            state.metric[(length + 1) * 2 * CONTEXTS + context] = -0.5 * NOISE_COST
    state.free_metric[:] = 0.0
    state.ends[:] = 0
    state.noises[:] = 0
    numbers[SILENT_RUN] = 0
    numbers[ASLEEP] = 0
    numbers[BEGUN] = numbers[BIT]
    return not (in_gap and values[P_PHASE] > MOST_UNSURE * MOST_UNSURE)


@njit(cache=True, nogil=True)
def _close_bit(clock, state, transitions, layout, gaps, rows, count):  # type: ignore[no-untyped-def]
    """Take the present bit, whose events are all there; return the number of rows."""
    numbers = state.numbers
    place = numbers[BIT] & _RING_MASK
    counts, compression, events = state.counts[place], state.compression, clock.counts
    gain, silence = state.levels[GAIN], state.levels[SILENCE]
    per_gain = 1.0 / gain
    total = 0
    for c in range(COUNTS):
        n = events[c]
        total += n
        scaled = int(n * per_gain + 0.5)
        counts[c] = compression[min(scaled, len(compression) - 1)]
    state.totals[place] = total
    state.rises[place] = events[:SUB_SLOTS].sum()
    state.borders[place] = clock.values[BORDER]
    numbers[SILENT_RUN] = numbers[SILENT_RUN] + 1 if total == 0 else 0
    likelihoods = state.likelihoods[place]
    weigh(state.tables, counts, likelihoods)
    silent = SILENT if total < SILENT_SHARE * state.means.mean() * gain else HEARD
    if _missing(gaps, clock.values[BORDER], clock.values[BORDER] + clock.values[PERIOD]):
        silent = MISSING
    state.silent[place] = silent
    if numbers[BIT] < MEMORY_BITS - 1 or silent == MISSING or (silent and silence < RARELY_SILENT):
        likelihoods[:] = 0.0  # an erasure, or before the first event
    _step_free(state, likelihoods)
    decided = state.free_bits[np.argmax(state.free_metric)] >> EDGE_LAG
    if (decided ^ decided >> 1) & 1 and numbers[BIT] >= EDGE_LAG + MEMORY_BITS:
        beside_gap = False
        for back in range(EDGE_LAG + 2):
            beside_gap |= state.silent[(numbers[BIT] - back) & _RING_MASK] == MISSING
        if not beside_gap:
            see_edge(clock, decided & 1)
    _step_framed(state, transitions, likelihoods)
    numbers[BIT] += 1
    best = np.argmax(state.metric)
    return _decide(clock, state, transitions, layout, best, DELAY_FRAMES * transitions.length, rows, count)


@njit(cache=True, nogil=True)
def _step_free(state, likelihoods):  # type: ignore[no-untyped-def]
    best = np.empty(CONTEXTS, np.int32)
    metric, bits = state.free_metric, state.free_bits
    free_step(metric, best, likelihoods)
    old = bits.copy()
    for context in range(CONTEXTS):
        bits[context] = old[best[context]] << 1 | context & 1


@njit(cache=True, nogil=True)
def _step_framed(state, transitions, likelihoods):  # type: ignore[no-untyped-def]
    metric, bits, ends, noises = state.metric, state.bits, state.ends, state.noises
    count = len(metric)
    fresh, best = np.empty(count), np.empty(count, np.int32)
    framed_step(transitions.source, transitions.target, transitions.cost, metric, fresh, best, likelihoods)
    old_bits, old_ends, old_noises = bits.copy(), ends.copy(), noises.copy()
    end, noise = (transitions.length - 1) * 2 * CONTEXTS, (transitions.length + 1) * 2 * CONTEXTS
    for to in range(count):
        source = best[to]
        if source >= 0:
            bits[to] = old_bits[source] << 1 | to & 1
            ends[to] = old_ends[source] << 1
            noises[to] = old_noises[source] << 1
    for to in range(end, end + 2 * CONTEXTS):
        ends[to] |= 1
    for to in range(noise, noise + 2 * CONTEXTS):
        noises[to] |= 1


@njit(cache=True, nogil=True)
def _decide(clock, state, transitions, layout, best, lag, rows, count):  # type: ignore[no-untyped-def]
    """Decide the bit ``lag`` bits back on the path to the state ``best``; return the number of rows."""
    numbers, length = state.numbers, transitions.length
    at = numbers[BIT] - 1 - lag
    if at < 0:
        return count
    if state.ends[best] >> lag & 1:
        numbers[NOISE_RUN] = 0
        if at - length + 1 >= numbers[BEGUN]:
            _decide_word(clock, state, layout, length, best, at, lag, rows[count])
            count += 1
    elif state.noises[best] >> lag & 1:
        clock.frozen[0] = True
        if state.silent[at & _RING_MASK] == HEARD:  # silence is not in doubt
            numbers[NOISE_RUN] += 1
            numbers[DOUBT] += 1
            if numbers[NOISE_RUN] == length:
                numbers[NOISE_RUN] = 0
                row = rows[count]
                row[:] = 0.0
                free = state.free_bits[np.argmax(state.free_metric)] >> lag
                row[WORD] = free & ((1 << length) - 1)
                row[KIND] = KIND_NOISE
                row[BORDER_OF_START] = state.borders[(at - length + 1) & _RING_MASK]
                row[PERIOD_THEN] = clock.values[PERIOD]
                count += 1
    else:
        numbers[NOISE_RUN] = 0
        # Idle where the events say 0: a lock whose clock has slipped may read an idle line for ever.
        if state.silent[at & _RING_MASK] == HEARD:
            numbers[DOUBT] += not state.free_bits[np.argmax(state.free_metric)] >> lag & 1
    return count


@njit(cache=True, nogil=True)
def _decide_word(clock, state, layout, length, best, at, lag, row):  # type: ignore[no-untyped-def]
    numbers = state.numbers
    mask = (1 << length) - 1
    word = state.bits[best] >> lag & mask
    free = state.free_bits[np.argmax(state.free_metric)] >> lag & mask
    before = state.bits[best] >> (lag + length) & (CONTEXTS - 1)
    # At the end of the stream the bits after the word are not there: ones without evidence stand in for them.
    following = state.bits[best] << (MEMORY_BITS - 1) | (CONTEXTS // 2 - 1)
    after = following >> lag & (CONTEXTS // 2 - 1)
    likelihoods = np.zeros((length + MEMORY_BITS - 1, CONTEXTS))
    erased, first = 0, at - length + 1
    for k in range(len(likelihoods)):
        bit = first + k
        if bit < numbers[BIT] and not _in_gap(state, bit):
            likelihoods[k] = state.likelihoods[bit & _RING_MASK]
        if k < length:
            erased += not likelihoods[k].any()
    frame_margin, word_margin = margins(likelihoods, before, after, word, layout)
    bit_ratios(likelihoods, before, after, length, row[FIRST_RATIO:])
    agreeing, other = UNLIKELY, UNLIKELY
    metric, bits, ends = state.metric, state.bits, state.ends
    for to in range(len(metric)):
        if ends[to] >> lag & 1 and bits[to] >> lag & mask == word:
            agreeing = max(agreeing, metric[to])
        else:
            other = max(other, metric[to])
            metric[to] = UNLIKELY
    margin = min(word_margin, agreeing - other, MOST_MARGIN)
    contexts = np.empty(length, np.int64)
    context, fit = before, 0.0
    for k in range(length):
        context = (context << 1 | (word >> (length - 1 - k) & 1)) & (CONTEXTS - 1)
        contexts[k] = context
        fit += likelihoods[k, context]
    fit /= length
    if _events_share(state, contexts, first) < LEAST_EVENTS:
        row[WORD], row[KIND] = word, KIND_UNREADABLE
        return
    alike = fit >= state.levels[USUAL] - LEAST_FIT * (1.0 + FEW_WORDS / max(numbers[LEARNT], 1))
    # A word that is read into what was dark before has no fall: neither the free bits nor the frame look at what lies before.
    start, then, data = likelihoods[0], likelihoods[1], contexts[1] & 1
    fall = max(start[2], start[6]) + then[4 + data] - max(start[0], start[4]) - then[data]
    falls = fall > -UNSEEN_FALL
    passes = alike and falls and (frame_margin >= OK_FRAME_MARGIN or (word == free and not erased))
    if passes:
        numbers[DOUBT] = max(0, numbers[DOUBT] - length)
    elif not erased:
        numbers[DOUBT] += length
    if passes or word_margin >= LEARNING_MARGIN:
        _learn_word(state, contexts, first)
        if not erased:
            state.levels[USUAL] += (fit - state.levels[USUAL]) / LEARNING_MEMORY
    clock.frozen[0] = not passes
    row[WORD], row[MARGIN], row[PERIOD_THEN] = word, margin, clock.values[PERIOD]
    row[SPREAD_THEN] = np.sqrt(clock.values[VARIANCE])
    if passes and margin >= SEEN_MARGIN:
        row[KIND] = KIND_OK if margin >= OK_MARGIN else KIND_SEEN
    else:
        row[KIND] = KIND_UNREADABLE if erased and margin < READABLE_MARGIN else KIND_REPAIRED
    row[BORDER_OF_START] = state.borders[first & _RING_MASK]


@njit(cache=True, nogil=True)
def _in_gap(state, bit):  # type: ignore[no-untyped-def]
    """Return whether a bit lies in so long a run of bits without any event that events were lost."""
    totals, newest = state.totals, state.numbers[BIT] - 1
    first = last = bit
    while totals[first & _RING_MASK] == 0.0 and first > max(newest - RING + 1, 0):
        first -= 1
    while totals[last & _RING_MASK] == 0.0 and last < newest:
        last += 1
    # Where a signal has faded, more held bits are empty than were learnt to be.
    faded = np.exp(-min(state.means[0], state.means[CONTEXTS - 1]) * state.levels[GAIN])
    share = min(max(state.levels[EMPTY], faded, LEAST_EMPTY), MOST_EMPTY)
    return (last - first - 1) * -np.log(share) > EMPTY_EVIDENCE


@njit(cache=True, nogil=True)
def _events_share(state, contexts, first):  # type: ignore[no-untyped-def]
    """Return the events of a word from the bit ``first`` on, ON and all, as a share of those that its bits should have."""
    seen, rises, expected = 0.0, 0.0, 1e-9
    for k in range(len(contexts)):
        place = (first + k) & _RING_MASK
        seen += state.totals[place]
        expected += state.means[contexts[k]] * state.levels[GAIN]
        rises += state.rises[place]
    return min(seen, RISES_WEIGHT * rises) / expected


@njit(cache=True, nogil=True)
def _learn_word(state, contexts, first):  # type: ignore[no-untyped-def]
    """Learn from a word from the bit ``first`` on, and follow the amplitude."""
    numbers = state.numbers
    histograms, counts, means = state.histograms, state.counts, state.means
    levels, silent, totals = state.levels, state.silent, state.totals
    fading = 1.0 - 1.0 / LEARNING_MEMORY
    for c in range(CONTEXTS):
        for d in range(COUNTS):
            for level in range(LEVELS):
                histograms[c, d, level] *= fading
    seen, expected = 0.0, 0.0
    for k in range(len(contexts)):
        context, place = contexts[k], (first + k) & _RING_MASK
        if silent[place] == MISSING or _in_gap(state, first + k):
            continue
        levels[SILENCE] += (silent[place] - levels[SILENCE]) / (LEARNING_MEMORY * len(contexts))
        if context == 0 or context == CONTEXTS - 1:
            levels[EMPTY] += ((totals[place] == 0.0) - levels[EMPTY]) / (LEARNING_MEMORY * len(contexts))
        if silent[place] and levels[SILENCE] < RARELY_SILENT:
            continue
        learn(histograms, counts[place], context, 1.0)
        total = totals[place] / levels[GAIN]
        seen += total
        expected += means[context]
        means[context] += (total - means[context]) / LEARNING_MEMORY
    if seen > 0.0 and expected > 0.0:
        levels[GAIN] *= np.exp(GAIN_SHARE * np.log(seen / expected))
    numbers[LEARNT] += 1
    if numbers[LEARNT] >= numbers[NEXT_TABLES]:
        logarithms(state.histograms, state.tables)
        numbers[NEXT_TABLES] = numbers[LEARNT] + min(RELEARN_EVERY, max(1, numbers[LEARNT] // 8))


@njit(cache=True, nogil=True)
def end_detection(clock, state, transitions, layout, rows):  # type: ignore[no-untyped-def]
    """Decide what is still open, as if nothing more came; return the number of rows."""
    count = 0
    best = np.argmax(state.metric)
    for lag in range(DELAY_FRAMES * transitions.length - 1, -1, -1):
        count = _decide(clock, state, transitions, layout, best, lag, rows, count)
    return count
