"""Character framing: the one definition of a character on the line, for encoder and decoder (section III-A).

The line idles high (LED on, mark).  A character with the default framing, first sent bit on the left::

      idle │ 0 │ d6  d5  d4  d3  d2  d1  d0 │ p │ 1   1 │ idle, or the next character's start bit
      mark │ start bit │ data bits, most significant first │ parity │ stop bits (the paper's "end bits")

      'S'  │ 0 │ 1010011 │ 0 │ 11        (the paper's Figure 1)
      LF   │ 0 │ 0001010 │ 0 │ 11

The two high stop bits and the low start bit after them give the {1 1 0} pattern that synchronisation looks for.
A *frame* as an integer holds the first sent bit as its most significant bit.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from beacon_comm.core.character import Status
from beacon_comm.core.errors import FramingError
from beacon_comm.core.events import NS_PER_S
from beacon_comm.core.parameters import Parameters

PARITIES = ('even', 'odd', 'none')
BIT_ORDERS = ('msb_first', 'lsb_first')


@dataclass(frozen=True, slots=True)
class CharacterFrame:
    """Layout of one character on the line.

    Attributes:
        data_bits: number of data bits, 5 to 8.
        parity: 'even', 'odd' or 'none'.
        stop_bits: number of stop bits, 1 or 2.
        bit_order: order of the data bits on the line, 'msb_first' or 'lsb_first'.

    Raises:
        FramingError: a value outside its range.
    """

    data_bits: int = 7
    parity: str = 'even'
    stop_bits: int = 2
    bit_order: str = 'msb_first'

    def __post_init__(self) -> None:
        if not 5 <= self.data_bits <= 8:
            raise FramingError(f'data_bits = {self.data_bits}: must lie in [5, 8]')
        if self.parity not in PARITIES:
            raise FramingError(f'parity = {self.parity!r}: must be one of {", ".join(PARITIES)}')
        if not 1 <= self.stop_bits <= 2:
            raise FramingError(f'stop_bits = {self.stop_bits}: must lie in [1, 2]')
        if self.bit_order not in BIT_ORDERS:
            raise FramingError(f'bit_order = {self.bit_order!r}: must be one of {", ".join(BIT_ORDERS)}')

    @classmethod
    def from_parameters(cls, parameters: Parameters) -> CharacterFrame:
        """Return the layout that the parameters describe."""
        return cls(parameters.data_bits, parameters.parity, parameters.stop_bits, parameters.bit_order)

    @property
    def parity_bits(self) -> int:
        """Number of parity bits, 0 or 1."""
        return 0 if self.parity == 'none' else 1

    @property
    def length(self) -> int:
        """Bits of a whole character, start to last stop bit (11 by default)."""
        return 1 + self.data_bits + self.parity_bits + self.stop_bits

    @property
    def most_falls(self) -> int:
        """Most falling edges that one character can have, its start edge among them (5 by default)."""
        return 1 + (self.data_bits + self.parity_bits) // 2

    def duration_ns(self, bit_rate_bps: float) -> float:
        """Return how long a character takes (ns): the paper's T, ``length / f``."""
        return self.length * NS_PER_S / bit_rate_bps

    def frame_of(self, code: int) -> int:
        """Return the frame of ``code``, its first sent bit most significant.

        Raises:
            FramingError: the code does not fit into the data bits.
        """
        if not 0 <= code < 1 << self.data_bits:
            raise FramingError(f'code {code} does not fit into {self.data_bits} data bits')
        body = self._in_line_order(code)  # the start bit is the 0 in front
        if self.parity_bits:
            body = body << 1 | self._parity_of(code)
        return body << self.stop_bits | self._stop_mask

    def decode_frame(self, bits: int) -> tuple[int, Status]:
        """Return code and status of a frame as read; the parity is judged first (section III-B.5).

        Args:
            bits: all bits of the frame, first sent bit most significant.
        """
        start = bits >> (self.length - 1) & 1
        stop = bits & self._stop_mask
        code = self._in_line_order(bits >> (self.stop_bits + self.parity_bits) & ((1 << self.data_bits) - 1))
        if self.parity_bits and bits >> self.stop_bits & 1 != self._parity_of(code):
            return code, Status.PARITY_ERROR
        if start != 0 or stop != self._stop_mask:
            return code, Status.FRAMING_ERROR
        return code, Status.OK

    def decoding_table(self) -> tuple[tuple[int, Status], ...]:
        """Return what :meth:`decode_frame` returns, for every possible frame; computed once for equal layouts."""
        return _decoding_table(self)

    def encode_bits(self, text: str | bytes) -> NDArray[np.uint8]:
        """Return the bits of a text in the order they are sent, ``(len(text) * length,)`` uint8.

        Raises:
            FramingError: a character does not fit into the data bits; the text names it and its position.
        """
        symbols: Iterable[str | int] = text
        codes = np.array([self._code_of(symbol, position) for position, symbol in enumerate(symbols)], np.int64)
        frames = np.array([self.frame_of(code) for code in range(1 << self.data_bits)], np.int64)[codes]
        shifts = np.arange(self.length - 1, -1, -1)
        return (frames[:, None] >> shifts & 1).astype(np.uint8).ravel()

    @property
    def _stop_mask(self) -> int:
        return (1 << self.stop_bits) - 1

    def _parity_of(self, code: int) -> int:
        return (code.bit_count() + (self.parity == 'odd')) & 1

    def _in_line_order(self, code: int) -> int:
        """Swap between a code and its data bits as sent; its own inverse."""
        if self.bit_order == 'msb_first':
            return code
        return int(f'{code:0{self.data_bits}b}'[::-1], 2)

    def _code_of(self, symbol: str | int, position: int) -> int:
        code = ord(symbol) if isinstance(symbol, str) else symbol
        if code >= 1 << self.data_bits:
            name = f'{symbol!r} (U+{code:04X})' if isinstance(symbol, str) else f'byte 0x{code:02X}'
            raise FramingError(f'{name} at position {position} does not fit into {self.data_bits} data bits')
        return code


@lru_cache(maxsize=16)
def _decoding_table(frame: CharacterFrame) -> tuple[tuple[int, Status], ...]:
    return tuple(frame.decode_frame(bits) for bits in range(1 << frame.length))


def transitions(
    bits: NDArray[np.uint8], bit_rate_bps: float, t0_ns: int = 0, idle_high: bool = True
) -> tuple[NDArray[np.int64], NDArray[np.uint8]]:
    """Return the level changes of a line that sends ``bits`` and idles before and after them.

    Args:
        bits: 0 or 1, ``(n,)``; bit k lasts from ``t0_ns + k / f`` to ``t0_ns + (k + 1) / f``.
        bit_rate_bps: the bit rate f (bit/s).
        t0_ns: start of the first bit (ns).
        idle_high: level of the idle line.

    Returns:
        Times (ns) ``(k,)`` int64, and the level from that time on, ``(k,)`` uint8.
    """
    idle = np.uint8(idle_high)
    levels = np.concatenate(([idle], np.asarray(bits, np.uint8), [idle]))
    changes = np.flatnonzero(np.diff(levels.astype(np.int8)))
    t_ns = np.int64(t0_ns) + np.rint(changes * (NS_PER_S / bit_rate_bps)).astype(np.int64)
    return t_ns, levels[changes + 1]
