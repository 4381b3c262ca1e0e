"""The bit clock: where bits begin, followed on the edges, and the events of each bit counted in its sub-slots.

An *edge* is the first of 4 consecutive events of the opposite polarity; each polarity has its own mean latency behind
the border of the bit.  What an edge lies off the nearest border is the measurement of a Kalman filter with two states,
the phase and the period of the clock::

    border        │              │              │                residual = edge − latency − nearest border
    events   + + +│+ + + − −│− − − − − − − −│+ + + + + + +       gain: large after lock, then gentle
                  │         ▲    │          ▲   │
                  ├─latency─┘    │     edge of + with its own latency

While frames are not confirmed the filter only predicts: noise must not walk the clock away.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from beacon_comm.core.likelihood import COUNTS, SUB_SLOTS

EDGE_RUN = 4
"""So many consecutive events of the opposite polarity are an edge."""

PHASE_NOISE = 1e-3
"""Standard deviation of the clock's phase jitter over one bit (bit)."""

PERIOD_NOISE = 2e-5
"""Standard deviation of the change of the clock's period from bit to bit (share of the period)."""

LATENCY_GAIN = 0.01
"""Share of a residual that goes into the difference between the two latencies."""

LEAST_RESIDUAL = 0.02
"""The residuals' standard deviation is never taken for smaller (bit)."""

GATE = 0.4
"""Residuals beyond this are no edges of this clock (bit)."""

PULL = 0.05
"""The period stays within so much of the one at lock (share)."""

MOST_PERIOD_ERROR = 0.003
MOST_PHASE_ERROR = 0.3
"""What is known of period (share) and phase (bit) is never taken for worse."""

# Values of the clock: times in ns from the demodulator's origin; SHIFT and STRETCH are what the edges of the present
# bit say, applied at its end.
BORDER, PERIOD, LATENCY_ON, LATENCY_OFF, VARIANCE, P_PHASE = range(6)
P_CROSS, P_PERIOD, RUN_SINCE, FIRST_PERIOD, SHIFT, STRETCH = range(6, 12)
# Whole numbers of the clock: polarity of the line's last edge, polarity and length of the present run of events.
LEVEL, RUN_POLARITY, RUN_LENGTH, FROZEN = range(4)


class BitClock(NamedTuple):
    """State of the clock and of the bit that is being counted.

    Attributes:
        values: see the constants above, ``(12,)`` float64.
        numbers: likewise, ``(4,)`` int64.
        counts: events of the present bit, ``(COUNTS,)`` int64.
    """

    values: NDArray[np.float64]
    numbers: NDArray[np.int64]
    counts: NDArray[np.int64]


def make_clock(border: float, period: float, latency: tuple[float, float], spread: float, period_error: float) -> BitClock:
    """Return a clock.

    Args:
        border: where a bit begins (ns from the origin).
        period: of a bit (ns).
        latency: of the edges to ON and to OFF behind the border (ns).
        spread: standard deviation of an edge's residual (bit).
        period_error: standard deviation of the period (share of it).
    """
    values = np.zeros(12)
    values[[BORDER, PERIOD, LATENCY_ON, LATENCY_OFF, FIRST_PERIOD]] = border, period, *latency, period
    values[VARIANCE] = max(spread, LEAST_RESIDUAL) ** 2
    values[P_PHASE] = 0.05**2
    values[P_PERIOD] = period_error**2
    return BitClock(values, np.zeros(4, np.int64), np.zeros(COUNTS, np.int64))


@njit(cache=True, nogil=True)
def take_events(values, numbers, counts, t, polarity, first, sign):  # type: ignore[no-untyped-def]
    """Count the events of the present bit and let the clock see the edges in it.

    Args:
        values, numbers, counts: a :class:`BitClock`'s.
        t, polarity: events, ns (float64) and ±1 (int8), from ``first`` on.
        sign: -1 if ON and OFF change places, else 1.

    Returns:
        index of the first event behind the bit.
    """
    border, per_slot = values[BORDER], SUB_SLOTS / values[PERIOD]
    stop = border + values[PERIOD]
    run_polarity, run_length, level = numbers[RUN_POLARITY], numbers[RUN_LENGTH], numbers[LEVEL]
    i = first
    while i < len(t):
        at = t[i]
        if at >= stop:
            break
        here = sign * polarity[i]
        slot = min(max(int((at - border) * per_slot), 0), SUB_SLOTS - 1)
        counts[slot if here > 0 else SUB_SLOTS + slot] += 1
        if here == run_polarity:
            run_length += 1
        else:
            run_polarity, run_length = here, 1
            values[RUN_SINCE] = at
        if run_length == EDGE_RUN and level != here:
            if level != 0 and not numbers[FROZEN]:
                _follow(values, values[RUN_SINCE], here)
            level = here
        i += 1
    numbers[RUN_POLARITY], numbers[RUN_LENGTH], numbers[LEVEL] = run_polarity, run_length, level
    return i


@njit(cache=True, nogil=True)
def _follow(values, edge, polarity):  # type: ignore[no-untyped-def]
    """Correct phase and period by one edge."""
    latency = LATENCY_ON if polarity > 0 else LATENCY_OFF
    off = (edge - values[latency] - values[BORDER] - values[SHIFT]) / values[PERIOD]
    residual = off - math.floor(off + 0.5)
    if abs(residual) > GATE:
        return
    variance = values[VARIANCE]
    innovation = values[P_PHASE] + variance
    gain, gain_period = values[P_PHASE] / innovation, values[P_CROSS] / innovation
    values[SHIFT] += gain * residual * values[PERIOD]
    values[STRETCH] += gain_period * residual
    values[P_PERIOD] -= gain_period * values[P_CROSS]
    values[P_CROSS] *= 1.0 - gain
    values[P_PHASE] *= 1.0 - gain
    values[VARIANCE] = max(variance + 0.02 * (residual * residual - variance), LEAST_RESIDUAL * LEAST_RESIDUAL)
    share = 0.5 * LATENCY_GAIN * residual * values[PERIOD]
    values[latency] += share
    values[LATENCY_ON + LATENCY_OFF - latency] -= share


@njit(cache=True, nogil=True)
def go_on(values, counts, bits):  # type: ignore[no-untyped-def]
    """Go on by some bits: predict, and clear the counts; the arrays are a :class:`BitClock`'s."""
    values[BORDER] += values[SHIFT] + bits * values[PERIOD]
    period = values[PERIOD] * (1.0 + values[STRETCH])
    values[PERIOD] = min(max(period, values[FIRST_PERIOD] * (1.0 - PULL)), values[FIRST_PERIOD] * (1.0 + PULL))
    values[SHIFT], values[STRETCH] = 0.0, 0.0
    values[P_PHASE] += bits * (2.0 * values[P_CROSS] + bits * values[P_PERIOD] + PHASE_NOISE * PHASE_NOISE)
    values[P_CROSS] += bits * values[P_PERIOD]
    values[P_PERIOD] += bits * PERIOD_NOISE * PERIOD_NOISE
    if values[P_PERIOD] > MOST_PERIOD_ERROR * MOST_PERIOD_ERROR:
        values[P_CROSS] *= MOST_PERIOD_ERROR / math.sqrt(values[P_PERIOD])
        values[P_PERIOD] = MOST_PERIOD_ERROR * MOST_PERIOD_ERROR
    if values[P_PHASE] > MOST_PHASE_ERROR * MOST_PHASE_ERROR:
        values[P_CROSS] *= MOST_PHASE_ERROR / math.sqrt(values[P_PHASE])
        values[P_PHASE] = MOST_PHASE_ERROR * MOST_PHASE_ERROR
    counts[:] = 0
