"""Demodulators: what a candidate slot runs; events of one blob in, characters out (section III-B.3 to III-B.5)."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from beacon_comm.core.character import Character
from beacon_comm.core.framing import CharacterFrame
from beacon_comm.core.parameters import Parameters
from beacon_comm.core.rate_bank import RateBank
from beacon_comm.core.sequence import SequenceDemodulator
from beacon_comm.core.sequence_detection import DELAY_FRAMES
from beacon_comm.core.signature import Signature
from beacon_comm.core.synchronisation import BITS_AFTER_DUE
from beacon_comm.core.threshold import ThresholdDemodulator

__all__ = [
    'Demodulator',
    'GapAware',
    'RateBank',
    'Recognising',
    'Searching',
    'SequenceDemodulator',
    'ThresholdDemodulator',
    'decision_delay_bits',
    'make_demodulator',
]


class Demodulator(Protocol):
    """Events of one blob in, characters out."""

    def push(self, t_ns: NDArray[np.int64], polarity: NDArray[np.int8], t_end_ns: int) -> list[Character]:
        """Take the next events and return the characters that are decided by now, in order.

        Args:
            t_ns: event times (ns), non-decreasing, ``(n,)`` int64; ``n`` may be 0.
            polarity: +1 or -1, ``(n,)`` int8.
            t_end_ns: the stream's time (ns): every event still to come has ``t >= t_end_ns``.
        """
        ...

    def flush(self) -> list[Character]:
        """End the stream: return the characters that are complete but still held."""
        ...

    @property
    def bit_rate_bps(self) -> float | None:
        """The settled bit rate (bit/s), None before."""
        ...

    @property
    def bit_rate_std_bps(self) -> float | None:
        """Standard deviation of the settled bit rate (bit/s), None before, or where the rate is not estimated."""
        ...

    @property
    def given_up(self) -> bool:
        """Whether it has looked long enough to say that there is no beacon; it goes on looking all the same."""
        ...


@runtime_checkable
class GapAware(Protocol):
    """A demodulator that can be told of missing events; another one takes a gap for a silence."""

    def miss(self, start_ns: int, stop_ns: int) -> None:
        """Know nothing of the stream from ``start_ns``, up to which it has been pushed, to ``stop_ns`` (ns).

        Characters that overlap it need not be held back: the slot erases them.
        """
        ...


@runtime_checkable
class Searching(Protocol):
    """A demodulator that looks for the bit rate again and again, at a cost."""

    def share(self, load: float, t_ns: int) -> None:
        """Spend from ``t_ns`` (ns) on no more computing time per event time on it (1: one core)."""
        ...

    def searched(self, to_ns: int) -> None:
        """Hear, before the first events, that those before ``to_ns`` (ns) have been searched: read them, if need be."""
        ...

    def ending(self) -> Iterator[list[Character] | float]:
        """Flush in parts: characters as soon as they are there, and of each piece of a look what it has cost, nominally (s)."""
        ...


@runtime_checkable
class Recognising(Protocol):
    """A demodulator that can say how the beacon it reads can be known again."""

    def signature(self) -> Signature | None:
        """Return the beacon's signature now, None while it is not read."""
        ...


def make_demodulator(parameters: Parameters) -> Demodulator:
    """Return a new demodulator for a candidate slot: the sequence receiver, or the paper's: a bank for several rates."""
    if parameters.receiver == 'sequence':
        return SequenceDemodulator(parameters)
    if len(parameters.bit_rates) == 1:
        return ThresholdDemodulator(parameters.bit_rates[0], parameters)
    return RateBank(parameters)


def decision_delay_bits(parameters: Parameters) -> float:
    """Return how many bits after a character's end the receiver has decided it, once it reads: what its documents state."""
    if parameters.receiver == 'sequence':
        return float(DELAY_FRAMES * CharacterFrame.from_parameters(parameters).length)
    return BITS_AFTER_DUE
