"""Likelihood of the event counts of a bit, given the last bits: tables learnt from the signal itself.

A bit is cut into 4 *sub-slots*; the ON and the OFF events in each are counted, which makes 8 counts a bit::

    bit         ├──── b₍ₙ₋₁₎ ───┼───── bₙ ─────┤
    sub-slot    │ 0 │ 1 │ 2 │ 3 │ 0 │ 1 │ 2 │ 3 │
    ON events   │ 12  9   4   2 │ 0   1   0   0 │      a slow LED, and pixels that recover, smear an edge over
    OFF events  │  0  0   0   1 │ 3  17  14   8 │      1.5 to 2 bits: the counts depend on the bits before, too

The *context* of a bit is the last 3 bits, its own included.  log p(counts | context) is the sum over the 8 counts of
log p(count | context), each from a histogram of compressed counts (``COMPRESSION``) with *back-off*: where a context
was seen rarely its histogram leans on that of the last 2 bits, this on that of the last bit, this on all bits'.

The histograms are learnt blind: nobody tells the bits, they are the receiver's own earlier decisions.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

MEMORY_BITS = 3
"""Bits in a context: the signal's memory is 1.5 to 2 bits at 3125 bps."""

CONTEXTS = 1 << MEMORY_BITS
SUB_SLOTS = 4
COUNTS = 2 * SUB_SLOTS
"""Counts of a bit: ON in each sub-slot, then OFF in each."""

LEVELS = 32
"""Compressed counts are 0 to LEVELS - 1."""

BACK_OFF = 4.0
"""A shorter context's histogram weighs as much as so many bits of the longer one."""

FLOOR = 2e-3
"""Share of an even spread over all counts in every histogram: no count is impossible."""


def _compression_table(most: int = 1024) -> NDArray[np.uint8]:
    n = np.arange(most)
    return np.minimum(np.where(n < 4, n, np.floor(2.0 * np.sqrt(n))), LEVELS - 1).astype(np.uint8)


COMPRESSION = _compression_table()
"""The compressed value of a count; greater counts are taken for the last one."""


@njit(cache=True, nogil=True)
def learn(histograms, counts, context, weight):  # type: ignore[no-untyped-def]
    """Add the compressed counts of one bit to its context's histograms, a little of each to both neighbours."""
    for c in range(COUNTS):
        level = counts[c]
        below = level - 1 if level > 0 else 0
        above = level + 1 if level < LEVELS - 1 else level
        histograms[context, c, level] += 0.5 * weight
        histograms[context, c, below] += 0.25 * weight
        histograms[context, c, above] += 0.25 * weight


@njit(cache=True, nogil=True)
def logarithms(histograms, tables):  # type: ignore[no-untyped-def]
    """Write log p(compressed count | context) of all histograms, backed off, to ``tables``; same shape, float64."""
    smooth, shared, own = np.empty((CONTEXTS, LEVELS)), np.empty(LEVELS), np.empty(LEVELS)
    for c in range(COUNTS):
        shared[:] = 0.0
        for context in range(CONTEXTS):
            for level in range(LEVELS):
                shared[level] += histograms[context, c, level]
        all_bits = shared.sum() + 1e-9
        for level in range(LEVELS):
            shared[level] = (1.0 - FLOOR) * shared[level] / all_bits + FLOOR / LEVELS
        for bits in range(1, MEMORY_BITS + 1):
            members = CONTEXTS >> bits  # contexts that end in the same last bits
            for last in range((1 << bits) - 1, -1, -1):
                lent = smooth[last & ((1 << (bits - 1)) - 1)] if bits > 1 else shared
                total = BACK_OFF
                own[:] = 0.0
                for m in range(members):
                    context = m << bits | last
                    for level in range(LEVELS):
                        own[level] += histograms[context, c, level]
                        total += histograms[context, c, level]
                for level in range(LEVELS):
                    own[level] = (own[level] + BACK_OFF * lent[level]) / total
                smooth[last] = own
        for context in range(CONTEXTS):
            for level in range(LEVELS):
                tables[context, c, level] = np.log((1.0 - FLOOR) * smooth[context, level] + FLOOR / LEVELS)


@njit(cache=True, nogil=True)
def weigh(tables, counts, likelihoods):  # type: ignore[no-untyped-def]
    """Write log p(counts of one bit | context) of all contexts to ``likelihoods``, ``(CONTEXTS,)``."""
    for context in range(CONTEXTS):
        total = 0.0
        for c in range(COUNTS):
            total += tables[context, c, counts[c]]
        likelihoods[context] = total
