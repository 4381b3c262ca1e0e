"""Which characters of a sending a recording holds: by the clock and by the signal, never by what was decoded.

::

    recording          ├───────────────────────────────────────────────┤   first event … end
    sending      0 ··· 52│53 54 ························ 616 617│            due(k) = start + k · T
    signal             ├──────────────────────────────────┤                where events follow the sent bits
    held                 ├────────────────────────────────┤                whole characters in all of them

A character is held if its first and its last level change lie inside the recording, before the next sending and
inside the signal.

*The signal* ends where the events no longer follow the sent bits: a beacon that was switched off, reset or hidden
before the recording ended.  Each bit's signed events ``s`` (ON minus OFF) are compared with the mean ``m`` of its
context (the last three sent bits) between the outermost characters that vouch for the sending; a bit adds

    m · (s - m / 2)        Gaussian log likelihood ratio of "sent" against "nothing sent", up to its variance

to a sum that runs outwards from there.  The signal ends at the sum's maximum: a gap that is followed by more signal
than it is long stays inside, and held bits without events (m ≈ 0) count neither way.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from beacon_comm.evaluation.alignment import Sending

# The fitted start is off by up to the latency of an edge (bits).
EDGE_LATENCY_BITS = 0.5
CONTEXT_BITS = 3


@dataclass(frozen=True, slots=True)
class Signal:
    """Aggregated events of one beacon.

    Attributes:
        t_ns: times (ns, sensor clock), non-decreasing, ``(n,)`` int64.
        polarity: +1 or -1, ``(n,)`` int8.
    """

    t_ns: NDArray[np.int64]
    polarity: NDArray[np.int8]


def held_characters(
    sending: Sending, bits: NDArray[np.uint8], limits_ns: tuple[float, float], signal: Signal | None
) -> tuple[int, int]:
    """Return the range ``first, stop`` of truth characters that are held.

    Args:
        sending: the line that the characters follow.
        bits: the sent bits, one row a character, ``(n, frame)`` uint8.
        limits_ns: beginning and end of what the sending can lie in (ns): recording, neighbouring sendings.
        signal: events of the beacon, None where they are not known.
    """
    n, frame_bits = bits.shape
    bit_ns = sending.period_ns / frame_bits
    slack_ns = EDGE_LATENCY_BITS * bit_ns
    k = np.arange(n)
    due_ns = sending.start_ns + k * sending.period_ns
    # The last change is the rise after the last low bit; from there to the frame's end nothing can be seen.
    last_change = frame_bits - np.argmin(bits[:, ::-1], axis=1)
    inside = due_ns >= limits_ns[0] - slack_ns
    inside &= due_ns + last_change * bit_ns <= limits_ns[1] + slack_ns
    if signal is not None and inside.any():
        first_bit, stop_bit = _followed_bits(sending, bits, inside, signal)
        # The events of the last change come in the bit after it.
        inside &= (k * frame_bits >= first_bit) & (k * frame_bits + last_change + 1 <= stop_bit)
    held = np.flatnonzero(inside)
    return (int(held[0]), int(held[-1]) + 1) if len(held) else (0, 0)


def _followed_bits(
    sending: Sending, bits: NDArray[np.uint8], inside: NDArray[np.bool_], signal: Signal
) -> tuple[int, int]:
    """Return the range ``first, stop`` of bits, counted through the whole truth, that the events follow."""
    frame_bits = bits.shape[1]
    lowest, highest = (int(k) for k in np.flatnonzero(inside)[[0, -1]])
    edges = sending.start_ns + np.arange(lowest * frame_bits, (highest + 1) * frame_bits + 1) * (
        sending.period_ns / frame_bits
    )
    sums = np.concatenate(([0], np.cumsum(signal.polarity, dtype=np.int64)))
    events = np.diff(sums[np.searchsorted(signal.t_ns, np.rint(edges).astype(np.int64))]).astype(np.float64)

    context = _contexts(bits)[lowest * frame_bits : (highest + 1) * frame_bits]
    core = np.zeros(len(events), bool)
    core_first = min(max(sending.first, lowest), highest)
    core_last = max(min(sending.last, highest), core_first)
    core[(core_first - lowest) * frame_bits : (core_last - lowest + 1) * frame_bits] = True
    count = np.bincount(context[core], minlength=1 << CONTEXT_BITS)
    total = np.bincount(context[core], events[core], minlength=1 << CONTEXT_BITS)
    mean = (total / np.maximum(count, 1))[context]
    ratio = mean * (events - mean / 2.0)
    # Half of what a bit tells on the average: a weak last bit is no end.
    tolerance = 0.5 * max(float(ratio[core].mean()), 0.0)

    after = int(np.flatnonzero(core)[-1]) + 1
    before = int(np.flatnonzero(core)[0])
    stop = after + _extent(ratio[after:], tolerance)
    first = before - _extent(ratio[:before][::-1], tolerance)
    return lowest * frame_bits + first, lowest * frame_bits + stop


def _extent(ratio: NDArray[np.float64], tolerance: float) -> int:
    """Return how many bits outwards the sum stays near its maximum, at the last time that it is there."""
    total = np.concatenate(([0.0], np.cumsum(ratio)))
    return int(np.flatnonzero(total >= total.max() - tolerance)[-1])


def _contexts(bits: NDArray[np.uint8]) -> NDArray[np.int64]:
    """Return the last three sent bits at each bit as a number; the line was high before the first."""
    line = np.concatenate((np.ones(CONTEXT_BITS - 1, np.int64), bits.ravel().astype(np.int64)))
    n = bits.size
    return sum((line[j : j + n] << (CONTEXT_BITS - 1 - j) for j in range(CONTEXT_BITS)), np.zeros(n, np.int64))


