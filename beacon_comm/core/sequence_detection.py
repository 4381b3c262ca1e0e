"""The locked part of the sequence receiver: events in, decided words out, bit by bit and with a bounded delay.

::

    events ─► bit clock ─► counts ─► log p(counts | last 3 bits) ─┬─► free trellis ───┬─► word ─► soft decision
                 ▲                        ▲                       └─► framed trellis ─┘             │
                 └── frozen or not ───────┴── histograms, gain ◄────── words that are ok ◄──────────┘

A word is decided two frames after its end (22 bits): by then every path that survives shares it, and a slip of the
frame has shown itself.  With it the paths that disagree are dropped, so that what follows fits what was said.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from beacon_comm.core.bit_clock import EDGE_LAG, go_on, see_edge, take_events
from beacon_comm.core.likelihood import COMPRESSION, CONTEXTS, COUNTS, LEVELS, MEMORY_BITS, SUB_SLOTS, learn, logarithms, weigh
from beacon_comm.core.soft_decision import bit_ratios, margins
from beacon_comm.core.trellis import NOISE_COST, PLACE, STATES, UNLIKELY, framed_step, free_step

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

HEARD, SILENT, MISSING = range(3)

# What a row of words tells.
WORD, KIND, BORDER_OF_START, MARGIN, PERIOD_THEN, SPREAD_THEN, FIRST_RATIO = range(7)
KIND_OK, KIND_SEEN, KIND_REPAIRED, KIND_NOISE, KIND_UNREADABLE = range(5)
STILL_LOCKED, LOST, LOST_IN_GAP, FULL = range(4)


IN_FRAME, END, NOISE = range(3)
"""What a bit of a framed path may be, in 2 bits: idle counts as in a frame."""

DETECTION = np.dtype(
    [
        ('histograms', np.float64, (CONTEXTS, COUNTS, LEVELS)),
        ('tables', np.float64, (CONTEXTS, COUNTS, LEVELS)),
        ('means', np.float64, (CONTEXTS,)),
        ('gain', np.float64),
        ('silence', np.float64),
        ('usual', np.float64),
        ('empty', np.float64),
        ('free_metric', np.float64, (CONTEXTS,)),
        ('free_bits', np.int64, (CONTEXTS,)),
        ('metric', np.float64, (STATES,)),
        ('bits', np.int64, (STATES,)),
        ('kinds', np.int64, (STATES,)),
        ('fresh', np.float64, (STATES,)),
        ('source', np.uint8, (STATES,)),
        ('bits_before', np.int64, (STATES,)),
        ('kinds_before', np.int64, (STATES,)),
        ('likelihoods', np.float64, (RING, CONTEXTS)),
        ('counts', np.uint8, (RING, COUNTS)),
        ('totals', np.float64, (RING,)),
        ('rises', np.float64, (RING,)),
        ('borders', np.float64, (RING,)),
        ('silent', np.uint8, (RING,)),
        ('bit', np.int64),
        ('begun', np.int64),
        ('learnt', np.int64),
        ('next_tables', np.int64),
        ('noise_run', np.int64),
        ('doubt', np.int64),
        ('silent_run', np.int64),
        ('asleep', np.bool_),
    ],
    align=True,
)
"""State of the locked receiver.

Fields:
    histograms, tables: see :mod:`beacon_comm.core.likelihood`.
    means: events of a bit for each context, after the gain.
    gain: counts are divided by it before they are compressed.
    silence: share of silent bits in words.
    usual: mean log p of a word's bit (nat).
    empty: share of held bits without any event.
    free_metric, free_bits: of the free trellis; the last 64 bits of the path to each state.
    metric, bits, kinds: of the framed trellis; the last 64 bits of the path to each state, and of the last 32 of them what
        they are, see ``END``.
    fresh, source, bits_before, kinds_before: room for a step of the framed trellis; to make room costs as much as the step.
    likelihoods, counts, totals, rises, borders, silent: of the last ``RING`` bits; rises are the ON events, and silent is
        ``HEARD``, ``SILENT`` or ``MISSING``.
    bit: number of the present bit.
    begun: a word's bits begin here at the earliest.
    learnt, next_tables: words in the histograms, and how many it takes to compute the tables anew.
    noise_run, doubt: bits of noise in a row, and bits in doubt less those that are not.
    silent_run, asleep: bits without any event in a row, and whether they were so many that the clock runs on alone.
"""


def make_detection(
    histograms: NDArray[np.float64],
    means: NDArray[np.float64],
    gain: float,
    silence: float,
    usual: float,
    empty: float,
    learnt: int,
) -> NDArray[np.void]:
    """Return the state at the start of a lock, one record ``(1,)`` of ``DETECTION``.

    Args:
        histograms, means: learnt while the lock was sought.
        gain, silence, usual, empty: see ``DETECTION``.
        learnt: number of words in the histograms.
    """
    states = np.zeros(1, DETECTION)
    state = states[0]
    state['histograms'] = histograms
    logarithms(histograms, state['tables'])
    state['means'], state['gain'], state['silence'], state['usual'], state['empty'] = means, gain, silence, usual, empty
    state['metric'] = UNLIKELY
    state['learnt'], state['next_tables'] = learnt, learnt + 1
    state['begun'] = MEMORY_BITS - 1
    return states


def start_at(states: NDArray[np.void], position: int, length: int) -> None:
    """Begin with a bit at a place of the frame; ``length`` or above: at none.

    The bit's own likelihood is still to come, so the paths begin one place before.
    """
    metric = states['metric'][0]
    metric[: (length + 2) * PLACE] = -UNKNOWN_PLACE_COST
    before = (position - 1) % length if position < length else position
    metric[before * PLACE : (before + 1) * PLACE] = 0.0


@njit(cache=True, nogil=True)
def detect(  # type: ignore[no-untyped-def]
    clocks, states, layouts, inverted, t, polarity, t_end, gaps, rows
):
    """Take events, then the stream's time; write rows of decided words.

    Args:
        clocks, states, layouts: a record each of ``CLOCK`` and ``DETECTION``, changed in place, and of ``LAYOUT``.
        inverted: True if the LED is on for 0.
        t, polarity: events, ns from the origin (float64) and ±1 (int8).
        t_end: the stream's time (ns from the origin).
        gaps: beginnings and ends of stretches whose events are missing (ns from the origin), ``(k, 2)`` float64.
        rows: ``(n, FIRST_RATIO + length)`` float64, to be written.

    Returns:
        number of rows, number of events taken, and STILL_LOCKED, LOST, LOST_IN_GAP or FULL (call again with the rest).
    """
    clock, state, layout = clocks[0], states[0], layouts[0]
    length = layout.length
    sign = -1 if inverted else 1
    i, count = 0, 0
    while True:
        if count + 2 > len(rows):
            return count, i, FULL
        if state.asleep:
            if i == len(t):
                return count, i, STILL_LOCKED
            if not _wake(clock, state, layout, gaps, t[i]):
                return count, i, LOST_IN_GAP
        end = clock.border + clock.period
        i = take_events(clock, t, polarity, i, sign, not _missing(gaps, end - (EDGE_LAG + 2) * clock.period, end))
        if i == len(t) and t_end < clock.border + clock.period:
            return count, i, STILL_LOCKED
        count = _close_bit(clock, state, layout, gaps, rows, count)
        go_on(clock, 1)
        if state.doubt > LOST_FRAMES * length:
            return count, i, LOST
        if state.silent_run > SLEEP_FRAMES * length:
            state.asleep = True


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
    return clock.border - state.silent_run * clock.period


@njit(cache=True, nogil=True)
def _wake(clock, state, layout, gaps, t):  # type: ignore[no-untyped-def]
    """Go on just before an event after a long silence.

    A silence is an idle line, which a start bit ends.  Where events were missing, the sender is taken to have gone on:
    the first place in a frame is the one that is next by the clock.

    Returns:
        whether the clock still says where the bits begin.
    """
    length = layout.length
    in_gap = _missing(gaps, silent_since(clock, state), t)
    skipped = max(np.floor((t - clock.border) / clock.period) - 1.0, 0.0)
    if skipped > 0.0:
        go_on(clock, skipped)
    clock.frozen = False
    clock.run = 0
    if in_gap:
        place = np.argmax(state.metric) // PLACE
        state.metric[: layout.states] = -UNKNOWN_PLACE_COST
        if place < length:
            place = (place + int(skipped)) % length
        state.metric[place * PLACE : (place + 1) * PLACE] = 0.0
    else:
        state.metric[:] = UNLIKELY
        state.metric[length * PLACE + CONTEXTS - 1] = 0.0
        for context in range(CONTEXTS):
            state.metric[(length + 1) * PLACE + context] = -0.5 * NOISE_COST
    state.free_metric[:] = 0.0
    state.kinds[:] = 0
    state.silent_run = 0
    state.asleep = False
    state.begun = state.bit
    return not (in_gap and clock.p_phase > MOST_UNSURE * MOST_UNSURE)


@njit(cache=True, nogil=True)
def explain(clocks, states, layouts, inverted, t, polarity, start, stop):  # type: ignore[no-untyped-def]
    """Return how likely events are (log p, nat) to be those of a locked signal, in the bits between two times.

    The clock only predicts, and nothing is learnt.  How many events there are does not count: another track may have a share.

    Args:
        clocks, states, layouts, inverted: see :func:`detect`; of the signal some time before, changed in place.
        t, polarity: see :func:`detect`.
        start, stop: the first bit begins, and the last one ends, between these times (ns from the origin).

    Returns:
        log p, and whether the clock is still sure enough to say.
    """
    clock, state, layout = clocks[0], states[0], layouts[0]
    skipped = np.floor((start - clock.border) / clock.period) + 1.0
    if skipped > 0.0:
        go_on(clock, skipped)
    place = np.argmax(state.metric) // PLACE
    if place < layout.length:
        place = (place + int(skipped)) % layout.length
    state.metric[: layout.states] = -UNKNOWN_PLACE_COST
    state.metric[place * PLACE : (place + 1) * PLACE] = 0.0
    clock.frozen, state.bit = True, MEMORY_BITS
    gaps, total = np.empty((0, 2)), 0.0
    i = np.searchsorted(t, clock.border)
    bits = max((stop - clock.border) / clock.period, 1.0)
    state.gain = max((np.searchsorted(t, stop) - i) / bits / state.means.mean(), 1e-3)
    while clock.border + clock.period <= stop:
        i = take_events(clock, t, polarity, i, -1 if inverted else 1, False)
        total += framed_step(layout, state.metric, state.fresh, state.source, _weigh_bit(clock, state, gaps))
        state.bit += 1
        go_on(clock, 1)
    return total, clock.p_phase <= MOST_UNSURE * MOST_UNSURE


@njit(cache=True, nogil=True)
def _close_bit(clock, state, layout, gaps, rows, count):  # type: ignore[no-untyped-def]
    """Take the present bit, whose events are all there; return the number of rows."""
    likelihoods = _weigh_bit(clock, state, gaps)
    _step_free(state, likelihoods)
    decided = state.free_bits[np.argmax(state.free_metric)] >> EDGE_LAG
    if (decided ^ decided >> 1) & 1 and state.bit >= EDGE_LAG + MEMORY_BITS:
        beside_gap = False
        for back in range(EDGE_LAG + 2):
            beside_gap |= state.silent[(state.bit - back) & _RING_MASK] == MISSING
        if not beside_gap:
            see_edge(clock, decided & 1)
    best = _step_framed(state, layout, likelihoods)
    state.bit += 1
    return _decide(clock, state, layout, best, DELAY_FRAMES * layout.length, rows, count)


@njit(cache=True, nogil=True)
def _weigh_bit(clock, state, gaps):  # type: ignore[no-untyped-def]
    """Take the counts of the present bit; return log p of them, ``(CONTEXTS,)``."""
    place = state.bit & _RING_MASK
    counts, events = state.counts[place], clock.counts
    gain, silence = state.gain, state.silence
    per_gain = 1.0 / gain
    total = 0
    for c in range(COUNTS):
        n = events[c]
        total += n
        scaled = int(n * per_gain + 0.5)
        counts[c] = COMPRESSION[min(scaled, len(COMPRESSION) - 1)]
    state.totals[place] = total
    state.rises[place] = events[:SUB_SLOTS].sum()
    state.borders[place] = clock.border
    state.silent_run = state.silent_run + 1 if total == 0 else 0
    likelihoods = state.likelihoods[place]
    weigh(state.tables, counts, likelihoods)
    silent = SILENT if total < SILENT_SHARE * state.means.mean() * gain else HEARD
    if _missing(gaps, clock.border, clock.border + clock.period):
        silent = MISSING
    state.silent[place] = silent
    if state.bit < MEMORY_BITS - 1 or silent == MISSING or (silent and silence < RARELY_SILENT):
        likelihoods[:] = 0.0  # an erasure, or before the first event
    return likelihoods


@njit(cache=True, nogil=True)
def _step_free(state, likelihoods):  # type: ignore[no-untyped-def]
    """Advance the free paths by a bit."""
    best, bits = np.empty(CONTEXTS, np.int32), np.empty(CONTEXTS, np.int64)
    free_step(state.free_metric, best, likelihoods)
    for context in range(CONTEXTS):
        bits[context] = state.free_bits[best[context]] << 1 | context & 1
    state.free_bits[:] = bits


@njit(cache=True, nogil=True)
def _step_framed(state, layout, likelihoods):  # type: ignore[no-untyped-def]
    """Advance the framed paths by a bit; return the state of the best one."""
    metric, source, states = state.metric, state.source, layout.states
    framed_step(layout, metric, state.fresh, source, likelihoods)
    bits, kinds = state.bits_before, state.kinds_before
    bits[:], kinds[:] = state.bits, state.kinds
    for to in range(states):
        state.bits[to] = bits[source[to]] << 1 | to & 1
        state.kinds[to] = kinds[source[to]] << 2
    end, noise = (layout.length - 1) * PLACE, (layout.length + 1) * PLACE
    for context in range(CONTEXTS):
        state.kinds[end + context] |= END
        state.kinds[noise + context] |= NOISE
    top = 0
    while metric[top] < 0.0:
        top += 1
    return top


@njit(cache=True, nogil=True)
def _decide(clock, state, layout, best, lag, rows, count):  # type: ignore[no-untyped-def]
    """Decide the bit ``lag`` bits back on the path to the state ``best``; return the number of rows."""
    length = layout.length
    at = state.bit - 1 - lag
    if at < 0:
        return count
    kind = state.kinds[best] >> 2 * lag & 3
    if kind == END:
        state.noise_run = 0
        if at - length + 1 >= state.begun:
            _decide_word(clock, state, layout, best, at, lag, rows[count])
            count += 1
    elif kind == NOISE:
        clock.frozen = True
        if state.silent[at & _RING_MASK] == HEARD:  # silence is not in doubt
            state.noise_run += 1
            state.doubt += 1
            if state.noise_run == length:
                state.noise_run = 0
                row = rows[count]
                row[:] = 0.0
                free = state.free_bits[np.argmax(state.free_metric)] >> lag
                row[WORD] = free & ((1 << length) - 1)
                row[KIND] = KIND_NOISE
                row[BORDER_OF_START] = state.borders[(at - length + 1) & _RING_MASK]
                row[PERIOD_THEN] = clock.period
                count += 1
    else:
        state.noise_run = 0
        # Idle where the events say 0: a lock whose clock has slipped may read an idle line for ever.
        if state.silent[at & _RING_MASK] == HEARD:
            state.doubt += not state.free_bits[np.argmax(state.free_metric)] >> lag & 1
    return count


@njit(cache=True, nogil=True)
def _decide_word(clock, state, layout, best, at, lag, row):  # type: ignore[no-untyped-def]
    length = layout.length
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
        if bit < state.bit and not _in_gap(state, bit):
            likelihoods[k] = state.likelihoods[bit & _RING_MASK]
        if k < length:
            erased += not likelihoods[k].any()
    frame_margin, word_margin = margins(likelihoods, before, after, word, layout)
    bit_ratios(likelihoods, before, after, length, row[FIRST_RATIO:])
    agreeing, other = UNLIKELY, UNLIKELY
    metric, bits, kinds = state.metric, state.bits, state.kinds
    for to in range(layout.states):
        if kinds[to] >> 2 * lag & 3 == END and bits[to] >> lag & mask == word:
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
    alike = fit >= state.usual - LEAST_FIT * (1.0 + FEW_WORDS / max(state.learnt, 1))
    # A word that is read into what was dark before has no fall: neither the free bits nor the frame look at what lies before.
    start, then, data = likelihoods[0], likelihoods[1], contexts[1] & 1
    fall = max(start[2], start[6]) + then[4 + data] - max(start[0], start[4]) - then[data]
    falls = fall > -UNSEEN_FALL
    passes = alike and falls and (frame_margin >= OK_FRAME_MARGIN or (word == free and not erased))
    if passes:
        state.doubt = max(0, state.doubt - length)
    elif not erased:
        state.doubt += length
    if passes or word_margin >= LEARNING_MARGIN:
        _learn_word(state, contexts, first)
        if not erased:
            state.usual += (fit - state.usual) / LEARNING_MEMORY
    clock.frozen = not passes
    row[WORD], row[MARGIN], row[PERIOD_THEN] = word, margin, clock.period
    row[SPREAD_THEN] = np.sqrt(clock.variance)
    if passes and margin >= SEEN_MARGIN:
        row[KIND] = KIND_OK if margin >= OK_MARGIN else KIND_SEEN
    else:
        row[KIND] = KIND_UNREADABLE if erased and margin < READABLE_MARGIN else KIND_REPAIRED
    row[BORDER_OF_START] = state.borders[first & _RING_MASK]


@njit(cache=True, nogil=True)
def _in_gap(state, bit):  # type: ignore[no-untyped-def]
    """Return whether a bit lies in so long a run of bits without any event that events were lost."""
    totals, newest = state.totals, state.bit - 1
    first = last = bit
    while totals[first & _RING_MASK] == 0.0 and first > max(newest - RING + 1, 0):
        first -= 1
    while totals[last & _RING_MASK] == 0.0 and last < newest:
        last += 1
    # Where a signal has faded, more held bits are empty than were learnt to be.
    faded = np.exp(-min(state.means[0], state.means[CONTEXTS - 1]) * state.gain)
    share = min(max(state.empty, faded, LEAST_EMPTY), MOST_EMPTY)
    return (last - first - 1) * -np.log(share) > EMPTY_EVIDENCE


@njit(cache=True, nogil=True)
def _events_share(state, contexts, first):  # type: ignore[no-untyped-def]
    """Return the events of a word from the bit ``first`` on, ON and all, as a share of those that its bits should have."""
    seen, rises, expected = 0.0, 0.0, 1e-9
    for k in range(len(contexts)):
        place = (first + k) & _RING_MASK
        seen += state.totals[place]
        expected += state.means[contexts[k]] * state.gain
        rises += state.rises[place]
    return min(seen, RISES_WEIGHT * rises) / expected


@njit(cache=True, nogil=True)
def _learn_word(state, contexts, first):  # type: ignore[no-untyped-def]
    """Learn from a word from the bit ``first`` on, and follow the amplitude."""
    histograms, counts, means, silent, totals = state.histograms, state.counts, state.means, state.silent, state.totals
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
        state.silence += (silent[place] - state.silence) / (LEARNING_MEMORY * len(contexts))
        if context == 0 or context == CONTEXTS - 1:
            state.empty += ((totals[place] == 0.0) - state.empty) / (LEARNING_MEMORY * len(contexts))
        if silent[place] and state.silence < RARELY_SILENT:
            continue
        learn(histograms, counts[place], context, 1.0)
        total = totals[place] / state.gain
        seen += total
        expected += means[context]
        means[context] += (total - means[context]) / LEARNING_MEMORY
    if seen > 0.0 and expected > 0.0:
        state.gain *= np.exp(GAIN_SHARE * np.log(seen / expected))
    state.learnt += 1
    if state.learnt >= state.next_tables:
        logarithms(state.histograms, state.tables)
        state.next_tables = state.learnt + min(RELEARN_EVERY, max(1, state.learnt // 8))


@njit(cache=True, nogil=True)
def end_detection(clocks, states, layouts, rows):  # type: ignore[no-untyped-def]
    """Decide what is still open, as if nothing more came; return the number of rows."""
    clock, state, layout = clocks[0], states[0], layouts[0]
    count = 0
    best = np.argmax(state.metric)
    for lag in range(DELAY_FRAMES * layout.length - 1, -1, -1):
        count = _decide(clock, state, layout, best, lag, rows, count)
    return count
