"""The bit clock: where bits begin, followed on the edges, and the events of each bit counted in its sub-slots.

Where the decided bits change, an *edge* is located: the events after it are of one polarity, those before of the other or
of both, so that the sum of the signed events, less the burst's own spread evenly over a bit, is least (to OFF: greatest)
at the edge.  Background events, as many of either polarity, hardly move that.

Each polarity has its own mean latency behind the border of the bit.  What an edge lies off border and latency is the
measurement of a Kalman filter with two states, phase and period of the clock::

    border        │              │              │                residual = edge − latency − border
    events   + + +│+ + + − −│− − − − − − − −│+ + + + + + +       gain: large after lock, then gentle
    sum     ╱    ╱ ╲                        ╱
                  ├─latency─┘    ├─latency──┘ its own

While frames are not confirmed the filter only predicts: noise must not walk the clock away.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from beacon_comm.core.likelihood import COUNTS, SUB_SLOTS

EDGE_LAG = 2
"""An edge is located when so many bits after it are there: by then the bits beside it are decided."""

FINE = 32
"""Bins of a bit in which an edge is located."""

UNSURE_PHASE, EDGE_RUN, SUDDEN = 0.08, 4, 0.3
"""A phase less sure than this (bit), as after a long idle line, is set by the next fall, before the bits behind it are counted:
the first of so many OFF events in a row, in a time in which so many OFF events at most were to be expected."""

RISE_DEVIATIONS = 2.0
"""The signed events that follow an edge sum up to so many standard deviations of noise, which takes 4 at least."""

PHASE_NOISE = 1e-3
"""Standard deviation of the clock's phase jitter over one bit (bit)."""

PERIOD_NOISE = 1e-5
"""Standard deviation of the change of the clock's period from bit to bit (share of the period)."""

BIAS_GAIN, MOST_BIAS, AGILE_NOISE = 0.1, 0.5, 1e-3
"""Where the residuals' running mean (standard deviations) leaves the second, the period changes faster: so much more for each
standard deviation beyond (share of the period)."""

LATENCY_GAIN = 0.01
"""Share of a residual that goes into the difference between the latencies."""

LEAST_RESIDUAL = 0.02
"""The residuals' standard deviation is never taken for smaller (bit)."""

GATE = 0.4
"""Edges are looked for within so much of where they are expected (bit)."""

PULL = 0.05
"""The period stays within so much of the one at lock (share)."""

OUTLIER_DEVIATIONS = 4.0
"""Edges farther off than so many standard deviations are none: a bit was decided wrongly."""

MOST_PERIOD_ERROR = 0.003
MOST_PHASE_ERROR = 0.3
"""What is known of period (share) and phase (bit) is never taken for worse."""

OFF, ON = range(2)
"""Kinds of edges, places in the latencies."""

CLOCK = np.dtype(
    [
        ('border', np.float64),
        ('period', np.float64),
        ('variance', np.float64),
        ('p_phase', np.float64),
        ('p_cross', np.float64),
        ('p_period', np.float64),
        ('first_period', np.float64),
        ('shift', np.float64),
        ('stretch', np.float64),
        ('bias', np.float64),
        ('run_since', np.float64),
        ('run', np.int64),
        ('frozen', np.bool_),
        ('latencies', np.float64, (2,)),
        ('counts', np.int64, (COUNTS,)),
        ('signed', np.int64, (EDGE_LAG + 2, FINE)),
        ('events', np.int64, (EDGE_LAG + 2,)),
        ('shifts', np.float64, (EDGE_LAG + 2,)),
    ],
    align=True,
)
"""State of the clock and of the bit that is being counted; times in ns from the demodulator's origin.

Fields:
    border, period: where the present bit begins, and its length (ns).
    variance: of the edges' residuals (bit²).
    p_phase, p_cross, p_period: covariance of phase (bit) and period (share).
    first_period: at lock (ns).
    shift, stretch: what the edge located at the end of the present bit says about border (ns) and period (share).
    bias: running mean of the residuals (standard deviations).
    run, run_since: OFF events in a row, counted while the phase is unsure, and the time of the first (ns).
    frozen: whether the clock only predicts.
    latencies: of the edges to OFF and to ON behind the borders (ns).
    counts: events of the present bit.
    signed: signed events of the present bit (the last row) and of those before it in their bins.
    events: all events of these bits.
    shifts: by how much the border of each of these bits was corrected (ns).
"""


def make_clock(
    border: float, period: float, latencies: NDArray[np.float64], spread: float, period_error: float
) -> NDArray[np.void]:
    """Return a clock, one record ``(1,)`` of ``CLOCK``.

    Args:
        border: where a bit begins (ns from the origin).
        period: of a bit (ns).
        latencies: of the edges to OFF and to ON behind the border (ns), ``(2,)`` float64.
        spread: standard deviation of an edge's residual (bit).
        period_error: standard deviation of the period (share of it).
    """
    clock = np.zeros(1, CLOCK)
    clock['border'], clock['period'], clock['first_period'] = border, period, period
    clock['variance'] = max(spread, LEAST_RESIDUAL) ** 2
    clock['p_phase'] = 0.05**2
    clock['p_period'] = period_error**2
    clock['latencies'] = latencies
    return clock


@njit(cache=True, nogil=True)
def take_events(clock, t, polarity, first, sign, settled):  # type: ignore[no-untyped-def]
    """Count the events of the present bit.

    Args:
        clock: changed in place.
        t, polarity: events, ns (float64) and ±1 (int8), from ``first`` on.
        sign: -1 if ON and OFF change places, else 1.
        settled: whether a fall may set an unsure phase: no gap is near, whose end would look like one.

    Returns:
        index of the first event behind the bit.
    """
    counts, signed = clock.counts, clock.signed[-1]
    border, per_bin = clock.border, FINE / clock.period
    stop = border + clock.period
    unsure = settled and _unsure(clock)
    if not unsure:
        clock.run = 0
    i = first
    while i < len(t):
        at = t[i]
        if at >= stop:
            break
        here = sign * polarity[i]
        if unsure and _falls(clock, at, here):
            unsure = _unsure(clock)
            border = clock.border
            stop = border + clock.period
        place = min(max(int((at - border) * per_bin), 0), FINE - 1)
        slot = place // (FINE // SUB_SLOTS)
        counts[slot if here > 0 else SUB_SLOTS + slot] += 1
        signed[place] += here
        i += 1
    clock.events[-1] += i - first
    return i


@njit(cache=True, nogil=True)
def _unsure(clock):  # type: ignore[no-untyped-def]
    return clock.p_phase > UNSURE_PHASE * UNSURE_PHASE and not clock.frozen


@njit(cache=True, nogil=True)
def _falls(clock, at, polarity):  # type: ignore[no-untyped-def]
    """Take an event after a long idle line; return whether it is the ``EDGE_RUN``th of a fall, which sets the phase."""
    if polarity > 0:
        clock.run = 0
        return False
    if clock.run == 0:
        clock.run_since = at
    clock.run += 1
    if clock.run < EDGE_RUN:
        return False
    clock.run = 0
    usual = 0.5 * (clock.events[:-1].sum() - clock.signed[:-1].sum()) + 1.0
    if (at - clock.run_since) * usual > SUDDEN * (EDGE_LAG + 1) * clock.period:
        return False
    off = (clock.run_since - clock.latencies[OFF] - clock.border) / clock.period
    _follow(clock, OFF, off - math.floor(off + 0.5))
    clock.border += clock.shift
    clock.shift = 0.0
    clock.signed[-1] = 0  # on the old grid: this edge has been seen
    return True


@njit(cache=True, nogil=True)
def see_edge(clock, to):  # type: ignore[no-untyped-def]
    """Correct phase and period by the edge before the bit ``EDGE_LAG`` back, where the decided bits change.

    Args:
        clock: with all events of the present bit; changed in place.
        to: ``ON`` where the bits change to 1, else ``OFF``.
    """
    if clock.frozen:
        return
    late = clock.latencies[to] / clock.period
    begin = max(FINE + int(round((late - GATE) * FINE)), 0)
    stop = min(FINE + int(round((late + GATE) * FINE)), (EDGE_LAG + 2) * FINE)
    up = 1 if to == ON else -1
    total, least, rise, events = 0, 0, 0, 0
    for k in range(begin, stop):
        total += up * clock.signed[k // FINE, k % FINE]
        least = min(least, total)
        rise = max(rise, total - least)
    for row in range(begin // FINE, (stop - 1) // FINE + 1):
        events += clock.events[row]
    if rise == 0 or rise * rise < RISE_DEVIATIONS * RISE_DEVIATIONS * events:
        return
    level, lowest, at = 0.0, 0.0, begin
    for k in range(begin, stop):
        if level <= lowest:
            lowest, at = level, k
        level += up * clock.signed[k // FINE, k % FINE] - rise / FINE
    if at == begin:
        return
    since = 0.0  # how much the borders behind the edge have been corrected
    for row in range(max(at // FINE, 1) + 1, EDGE_LAG + 2):
        since += clock.shifts[row]
    residual = (at + 0.5) / FINE - 1.0 - late - since / clock.period
    deviations = residual / math.sqrt(clock.p_phase + clock.variance)
    bounded = min(max(deviations, -OUTLIER_DEVIATIONS), OUTLIER_DEVIATIONS)
    clock.bias += BIAS_GAIN * (bounded - clock.bias)
    if bounded == deviations:
        _follow(clock, to, residual)


@njit(cache=True, nogil=True)
def _follow(clock, to, residual):  # type: ignore[no-untyped-def]
    """Correct phase and period by what an edge to OFF or to ON lies off (bit)."""
    variance = clock.variance
    innovation = clock.p_phase + variance
    gain, gain_period = clock.p_phase / innovation, clock.p_cross / innovation
    clock.shift += gain * residual * clock.period
    clock.stretch += gain_period * residual
    clock.p_period -= gain_period * clock.p_cross
    clock.p_cross *= 1.0 - gain
    clock.p_phase *= 1.0 - gain
    clock.variance = max(variance + 0.02 * (residual * residual - variance), LEAST_RESIDUAL * LEAST_RESIDUAL)
    share = 0.5 * LATENCY_GAIN * residual * clock.period
    clock.latencies[to] += share
    clock.latencies[1 - to] -= share  # their mean is the phase


@njit(cache=True, nogil=True)
def go_on(clock, bits):  # type: ignore[no-untyped-def]
    """Go on by some bits: predict, and begin to count anew; ``clock`` is changed in place."""
    agile = AGILE_NOISE * max(abs(clock.bias) - MOST_BIAS, 0.0) if clock.events[-1] else 0.0
    for row in range(EDGE_LAG + 1):
        clock.signed[row] = clock.signed[row + 1]
        clock.events[row] = clock.events[row + 1]
        clock.shifts[row] = clock.shifts[row + 1]
    clock.counts[:] = 0
    clock.signed[-1] = 0
    clock.events[-1] = 0
    clock.shifts[-1] = clock.shift
    clock.border += clock.shift + bits * clock.period
    period = clock.period * (1.0 + clock.stretch)
    clock.period = min(max(period, clock.first_period * (1.0 - PULL)), clock.first_period * (1.0 + PULL))
    clock.shift, clock.stretch = 0.0, 0.0
    clock.p_phase += bits * (2.0 * clock.p_cross + bits * clock.p_period + PHASE_NOISE * PHASE_NOISE)
    clock.p_cross += bits * clock.p_period
    clock.p_period += bits * (PERIOD_NOISE * PERIOD_NOISE + agile * agile)
    if clock.p_period > MOST_PERIOD_ERROR * MOST_PERIOD_ERROR:
        clock.p_cross *= MOST_PERIOD_ERROR / math.sqrt(clock.p_period)
        clock.p_period = MOST_PERIOD_ERROR * MOST_PERIOD_ERROR
    if clock.p_phase > MOST_PHASE_ERROR * MOST_PHASE_ERROR:
        clock.p_cross *= MOST_PHASE_ERROR / math.sqrt(clock.p_phase)
        clock.p_phase = MOST_PHASE_ERROR * MOST_PHASE_ERROR
