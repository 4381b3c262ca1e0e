"""Discretisation and decoding: the span of a character and the edges inside become a character (section III-B.5).

The span is divided into 11 equal slots; a bit is the level of the line in the middle of its slot::

    t₍ₖ₋₁₎                                                tₖ
      │ 0 │ d6│ d5│ d4│ d3│ d2│ d1│ d0│ p │ 1 │ 1 │        slot = (tₖ − t₍ₖ₋₁₎) / 11 where the end edge was seen,
        •   •   •   •   •   •   •   •   •   •   •                 1 / f where it was not

The *confidence* of a character is the distance between the middle of a slot and the nearest edge, in half slots, of
the slot where it is smallest: 1 when every edge lies on the border of two slots, 0 when one lies on a middle, where a
little more or less delay would have read the other bit.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from beacon_comm.core.character import Character
from beacon_comm.core.events import NS_PER_S
from beacon_comm.core.framing import CharacterFrame
from beacon_comm.core.high_pass import Edges
from beacon_comm.core.synchronisation import Span

_FIRST_CAPACITY = 256


class EdgeRecord:
    """The edges since the start of the character that is being received, in arrays that grow when they must."""

    def __init__(self) -> None:
        self._t_ns = np.empty(_FIRST_CAPACITY, np.int64)
        self._rising = np.empty(_FIRST_CAPACITY, np.bool_)
        self._start = 0
        self._stop = 0
        self._level_before = True  # the line starts high

    def append(self, edges: Edges) -> None:
        """Take the next edges."""
        count = len(edges.t_ns)
        if self._stop + count > len(self._t_ns):
            self._make_room(count)
        self._t_ns[self._stop : self._stop + count] = edges.t_ns
        self._rising[self._stop : self._stop + count] = edges.rising
        self._stop += count

    def forget(self, t_ns: int) -> None:
        """Drop the edges before ``t_ns`` (ns); the level there stays known."""
        dropped = int(np.searchsorted(self._t_ns[self._start : self._stop], t_ns, side='left'))
        if dropped:
            self._start += dropped
            self._level_before = bool(self._rising[self._start - 1])

    def since(self, t_ns: int) -> tuple[NDArray[np.int64], NDArray[np.bool_], bool]:
        """Return the edges from ``t_ns`` (ns) on, and the level before them.

        Returns:
            Times (ns) ``(n,)`` int64, directions ``(n,)`` bool (True: rising), level (True: high).
        """
        first = self._start + int(np.searchsorted(self._t_ns[self._start : self._stop], t_ns, side='left'))
        level_before = self._level_before if first == self._start else bool(self._rising[first - 1])
        return self._t_ns[first : self._stop], self._rising[first : self._stop], level_before

    def _make_room(self, count: int) -> None:
        held = slice(self._start, self._stop)
        capacity = max(len(self._t_ns), 2 * (self._stop - self._start + count))
        t_ns, rising = np.empty(capacity, np.int64), np.empty(capacity, np.bool_)
        self._stop -= self._start
        t_ns[: self._stop] = self._t_ns[held]
        rising[: self._stop] = self._rising[held]
        self._t_ns, self._rising, self._start = t_ns, rising, 0


class CharacterReader:
    """Reads the bits of a span off the edges and decodes them.

    Args:
        bit_rate_bps: the nominal bit rate f (bit/s).
        frame: the character frame.
    """

    def __init__(self, bit_rate_bps: float, frame: CharacterFrame) -> None:
        self._bit_rate_bps = bit_rate_bps
        self._bit_ns = NS_PER_S / bit_rate_bps
        self._frame = frame

    def read(self, span: Span, record: EdgeRecord) -> Character:
        """Return the character of ``span``; ``record`` must hold the edges from its start on."""
        length = self._frame.length
        slot_ns = (span.stop_ns - span.start_ns) / length if span.stop_seen else self._bit_ns
        t_ns, rising, level_before = record.since(span.start_ns)
        bits, confidence = _read_slots(t_ns, rising, level_before, span.start_ns, slot_ns, length)
        code, status = self._frame.decode_frame(bits)
        return Character(span.start_ns, code, status, confidence, bits, self._bit_rate_bps)


@njit(cache=True, nogil=True)
def _read_slots(edge_t, edge_rising, level_before, start, slot, length):  # type: ignore[no-untyped-def]
    """Return the levels in the middles of the slots, first one most significant, and the confidence."""
    bits = 0
    nearest = 0.5 * slot
    level = 1 if level_before else 0
    i = 0
    for k in range(length):
        middle = (k + 0.5) * slot
        while i < len(edge_t) and edge_t[i] - start <= middle:
            level = 1 if edge_rising[i] else 0
            i += 1
        if i > 0:
            nearest = min(nearest, middle - (edge_t[i - 1] - start))
        if i < len(edge_t):
            nearest = min(nearest, (edge_t[i] - start) - middle)
        bits = bits << 1 | level
    return bits, nearest / (0.5 * slot)
