"""One received character and its status: the values that pass from a demodulator to everything behind it."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum


class Status(IntEnum):
    """What vouches for a character; the numbers are those of ``msg/Character.msg``."""

    OK = 0
    """Start, parity and stop bits were right by evidence that could have failed."""
    REPAIRED = 1
    """Only the frame structure rescued it, other codes are too near, or bits of it lie in a silence of the topic that nobody
    vouches for; the threshold receiver gives the last alone."""
    PARITY_ERROR = 2
    """The parity bit contradicts the data bits."""
    FRAMING_ERROR = 3
    """The parity is right, but the start bit is not 0 or a stop bit is not 1."""


@dataclass(frozen=True, slots=True)
class Character:
    """A decoded character frame.

    Attributes:
        t_ns: time of the leading edge of its start bit (ns, sensor clock).
        code: value of the data bits (0 to 127 with 7 data bits).
        status: see :class:`Status`.
        confidence: 0 to 1.  Sequence receiver: the probability that the code is right, calibrated; threshold receiver: how
            far the worst bit was from being decided otherwise.
        frame: all bits of the frame as received, first sent bit most significant (11 bits: 0 d6…d0 p 1 1).
        bit_rate_bps: rate at which it was decoded (bit/s).
        bit_llr: log-likelihood ratio of each bit of the frame without the frame's structure (nat, positive: 1), in the
            order they are sent; empty from the threshold receiver.
        edge_spread: standard deviation of the edges about where the bit clock has them (bit); 0 from the threshold receiver,
            whose confidence says as much.
    """

    t_ns: int
    code: int
    status: Status
    confidence: float
    frame: int
    bit_rate_bps: float
    bit_llr: tuple[float, ...] = ()
    edge_spread: float = 0.0

    @property
    def read_freely(self) -> bool:
        """Whether every bit of the frame is also what its events say without the frame's structure."""
        length = len(self.bit_llr)
        return length > 0 and all(
            (ratio > 0.0) == bool(self.frame >> (length - 1 - place) & 1) for place, ratio in enumerate(self.bit_llr)
        )
