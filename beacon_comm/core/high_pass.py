"""Asynchronous high-pass filter and threshold: events in, edges of the binarised signal out (section III-B.3).

The filter solves  dL/dt = e(t) − α L  (eq. 1) exactly between two events, and only when one comes::

    L ← L · exp(−α (t − t_last))        decay over the gap
    L ← L ± 1                           add the event
    compare with the levels             hysteresis: a low output goes high above the high level, and vice versa

      L │    ╭╮                 ╭─╮
        │┄┄┄┄││┄┄┄┄┄┄┄┄┄┄┄┄┄┄┄┄┄│┄╰╮┄┄┄┄┄┄  high level
       0│────╯╰──╮     ╭────────╯  ╰────
        │┄┄┄┄┄┄┄┄│┄┄┄┄╭╯┄┄┄┄┄┄┄┄┄┄┄┄┄┄┄┄┄┄  low level
        │        ╰────╯
    output ──────┐              ┌──────────  starts high: the line idles high

Adaptive levels (the default) are shares of the signal's amplitude a = (a⁺ + a⁻) / 2, where a⁺ and a⁻ follow the peaks
and the troughs of L: they take every greater |L| at once and fade with a time constant of ``amplitude_memory_bits``.
The levels depend on past events only and change only when an event comes, so batching does not matter.  They never
come nearer to zero than ``least_level`` events, or single noise events would be edges once a silent line has faded.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from beacon_comm.core.events import NS_PER_S
from beacon_comm.core.parameters import Parameters

# The state of the filter: times and output in an int64 array, filtered values in a float64 array.
_T_LAST, _T_FADED, _OUTPUT = range(3)
_FILTERED, _PEAK, _TROUGH = range(3)

_LONG_AGO_NS = -(1 << 61)


@dataclass(frozen=True, slots=True)
class Edges:
    """Edges of the binarised signal, rising and falling in turn.

    Attributes:
        t_ns: times (ns), ``(n,)`` int64.
        rising: direction, ``(n,)`` bool.
    """

    t_ns: NDArray[np.int64]
    rising: NDArray[np.bool_]


class HighPassFilter:
    """Turns the events of one blob into the edges of one line.

    Args:
        bit_rate_bps: the bit rate f (bit/s) that cut-off and memory scale with.
        parameters: ``cutoff_per_bit`` (α / f), ``levels`` and the shares or levels that belong to it.
    """

    def __init__(self, bit_rate_bps: float, parameters: Parameters) -> None:
        self._decay_per_ns = parameters.cutoff_per_bit * bit_rate_bps / NS_PER_S
        self._fade_per_ns = bit_rate_bps / parameters.amplitude_memory_bits / NS_PER_S
        self._bit_ns = round(NS_PER_S / bit_rate_bps)
        if parameters.levels == 'fixed':
            self._shares = np.zeros(2)
            self._least = np.array([parameters.high_level, -parameters.low_level])
        else:
            self._shares = np.array([parameters.high_share, parameters.low_share])
            self._least = np.full(2, parameters.least_level)
        self._times = np.array([_LONG_AGO_NS, _LONG_AGO_NS, 1], np.int64)
        self._values = np.zeros(3)

    @property
    def filtered(self) -> float:
        """The filtered signal L (events) just after the newest event."""
        return float(self._values[_FILTERED])

    @property
    def levels(self) -> tuple[float, float]:
        """The low and the high level (events) that L is compared with now."""
        amplitude = 0.5 * (self._values[_PEAK] + self._values[_TROUGH])
        high, low = np.maximum(self._shares * amplitude, self._least)
        return -float(low), float(high)

    def push(self, t_ns: NDArray[np.int64], polarity: NDArray[np.int8]) -> Edges:
        """Take the next events and return the edges they cause.

        Args:
            t_ns: event times (ns), non-decreasing, ``(n,)`` int64.
            polarity: +1 or -1, ``(n,)`` int8.
        """
        edge_t = np.empty(len(t_ns), np.int64)
        edge_rising = np.empty(len(t_ns), np.bool_)
        count = _filter(
            self._times,
            self._values,
            t_ns,
            polarity,
            self._decay_per_ns,
            self._fade_per_ns,
            self._bit_ns,
            self._shares,
            self._least,
            edge_t,
            edge_rising,
        )
        return Edges(edge_t[:count], edge_rising[:count])


@njit(cache=True, nogil=True)
def _filter(  # type: ignore[no-untyped-def]
    times, values, t_ns, polarity, decay_per_ns, fade_per_ns, bit_ns, shares, least, edge_t, edge_rising
):
    """Run the filter over the events, write the edges, return their number."""
    t_last, t_faded, output = times
    filtered, peak, trough = values
    count = 0
    for i in range(len(t_ns)):
        t = t_ns[i]
        if t > t_last:
            filtered *= math.exp(-decay_per_ns * (t - t_last))
            t_last = t
            if t - t_faded >= bit_ns:  # at most once a bit: fading is slow and the exponential is not
                fading = math.exp(-fade_per_ns * (t - t_faded))
                peak *= fading
                trough *= fading
                t_faded = t
        filtered += polarity[i]
        peak = max(peak, filtered)
        trough = max(trough, -filtered)
        amplitude = 0.5 * (peak + trough)
        if output:
            if -filtered > max(shares[1] * amplitude, least[1]):
                output = 0
                edge_t[count] = t
                edge_rising[count] = False
                count += 1
        elif filtered > max(shares[0] * amplitude, least[0]):
            output = 1
            edge_t[count] = t
            edge_rising[count] = True
            count += 1
    times[_T_LAST] = t_last
    times[_T_FADED] = t_faded
    times[_OUTPUT] = output
    values[_FILTERED] = filtered
    values[_PEAK] = peak
    values[_TROUGH] = trough
    return count
