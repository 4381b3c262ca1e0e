"""Soft decisions: how sure a character is, and whether the evidence for it could have failed.

All compare the log-likelihoods of the 11 bits of a character, with the bits before and after it held:

- the *log-likelihood ratio of a bit*: the best bits with a 1 there against the best with a 0, no frame structure;
- the *frame margin*: the decided word against the best word that is no frame (wrong start, parity or stop);
- the *word margin*: the decided word against the best other word that is a frame.

The framed trellis forces start, parity and stop, so that a frame is right says nothing there.  The frame margin could
have failed: noise is as good without a frame as with one.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from beacon_comm.core.likelihood import CONTEXTS, MEMORY_BITS
from beacon_comm.core.trellis import UNLIKELY


@njit(cache=True, nogil=True)
def bit_ratios(likelihoods, before, after, length, ratios):  # type: ignore[no-untyped-def]
    """Write the log-likelihood ratio (nat, positive: 1) of each bit of a word.

    Args:
        likelihoods: log p of the bits of the word and the 2 bits after it, ``(length + 2, CONTEXTS)``.
        before: context of the bit before the word.
        after: the 2 bits after the word, the first one more significant.
        length: bits of the word.
        ratios: written, ``(length,)`` float64.
    """
    forward = np.full((length + 1, CONTEXTS), UNLIKELY)
    forward[0, before] = 0.0
    for n in range(length):
        for context in range(CONTEXTS):
            for bit in range(2):
                to = (context << 1 | bit) & (CONTEXTS - 1)
                value = forward[n, context] + likelihoods[n, to]
                if value > forward[n + 1, to]:
                    forward[n + 1, to] = value
    backward = np.zeros(CONTEXTS)
    for context in range(CONTEXTS):
        here = context
        for k in range(MEMORY_BITS - 1):
            here = (here << 1 | (after >> (MEMORY_BITS - 2 - k) & 1)) & (CONTEXTS - 1)
            backward[context] += likelihoods[length + k, here]
    fresh = np.empty(CONTEXTS)
    for n in range(length - 1, -1, -1):
        one, zero = UNLIKELY, UNLIKELY
        for context in range(CONTEXTS):
            value = forward[n + 1, context] + backward[context]
            if context & 1:
                one = max(one, value)
            else:
                zero = max(zero, value)
        ratios[n] = one - zero
        for context in range(CONTEXTS):
            low, high = (context << 1) & (CONTEXTS - 1), (context << 1 | 1) & (CONTEXTS - 1)
            fresh[context] = max(backward[low] + likelihoods[n, low], backward[high] + likelihoods[n, high])
        backward[:] = fresh


@njit(cache=True, nogil=True)
def margins(likelihoods, before, after, word, layout):  # type: ignore[no-untyped-def]
    """Return the frame margin and the word margin (nat) of a decided word that is a frame.

    Args:
        likelihoods, before, after: see :func:`bit_ratios`.
        word: the decided bits, first one most significant.
        layout: a record of ``LAYOUT``.
    """
    length = layout.length
    # best[v, p, c]: best path so far that is not the word's own, by violation, parity and context
    best = np.full((2, 2, CONTEXTS), UNLIKELY)
    fresh = np.empty((2, 2, CONTEXTS))
    own, own_context, own_parity = 0.0, before, 0
    for n in range(length):
        decided = word >> (length - 1 - n) & 1
        fresh[:] = UNLIKELY
        for bit in range(2):
            violates = 1 if layout.fixed[n] >= 0 and bit != layout.fixed[n] else 0
            flips = bit if layout.checked[n] else 0
            if bit != decided:  # leaves the word here
                to = (own_context << 1 | bit) & (CONTEXTS - 1)
                value = own + likelihoods[n, to]
                if value > fresh[violates, own_parity ^ flips, to]:
                    fresh[violates, own_parity ^ flips, to] = value
            for context in range(CONTEXTS):
                to = (context << 1 | bit) & (CONTEXTS - 1)
                gain = likelihoods[n, to]
                for violated in range(2):
                    for parity in range(2):
                        value = best[violated, parity, context] + gain
                        if value > fresh[violated | violates, parity ^ flips, to]:
                            fresh[violated | violates, parity ^ flips, to] = value
        own_context = (own_context << 1 | decided) & (CONTEXTS - 1)
        own += likelihoods[n, own_context]
        if layout.checked[n]:
            own_parity ^= decided
        best, fresh = fresh, best
    no_frame, other_word = UNLIKELY, UNLIKELY
    for context in range(CONTEXTS):
        tail, here = 0.0, context
        own_tail, own_here = 0.0, own_context
        for k in range(MEMORY_BITS - 1):
            bit = after >> (MEMORY_BITS - 2 - k) & 1
            here = (here << 1 | bit) & (CONTEXTS - 1)
            own_here = (own_here << 1 | bit) & (CONTEXTS - 1)
            tail += likelihoods[length + k, here]
            own_tail += likelihoods[length + k, own_here]
        for violated in range(2):
            for parity in range(2):
                value = best[violated, parity, context] + tail - own_tail
                if violated or (layout.parity >= 0 and parity != layout.parity):
                    no_frame = max(no_frame, value)
                else:
                    other_word = max(other_word, value)
    return own - no_frame, own - other_word


CONFIDENCE_CONSTANT, CONFIDENCE_SLOPE, CONFIDENCE_ROOT = -1.6, 0.15, 1.16
"""log odds of a word that beats its rivals by the margin m: constant + slope · m + root · √m.

Counts in neighbouring sub-slots are not independent, and histograms are estimates, so that margins promise too much.
Fitted to 256 000 characters from stressed waveforms (the even seeds of ``docs/reliability.py --full --dump``), checked on
as many others (``docs/reliability.md``).
"""

SLOPE_UP_TO, ROOT_UP_TO = 15.0, 30.0
"""Margins beyond (nat) count no more."""


def confidence_of(margin: float) -> float:
    """Return the calibrated probability (0 to 1) that a word is right that beats its rivals by a margin (nat, ≥ 0)."""
    margin = max(margin, 0.0)
    odds = CONFIDENCE_SLOPE * min(margin, SLOPE_UP_TO) + CONFIDENCE_ROOT * math.sqrt(min(margin, ROOT_UP_TO))
    return 1.0 / (1.0 + math.exp(-CONFIDENCE_CONSTANT - odds))
