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

from beacon_comm.core.character import Character
from beacon_comm.core.events import NS_PER_S
from beacon_comm.core.framing import CharacterFrame
from beacon_comm.core.high_pass import Edges
from beacon_comm.core.synchronisation import Span

_FIRST_CAPACITY = 256


class EdgeRecord:
    """The edges since the start of the character that is being received, in arrays that grow when they must.

    Attributes:
        t_ns: times (ns), ``(capacity,)`` int64, of which the first ``count`` hold.
        rising: directions, ``(capacity,)`` bool (True: rising).
        count: number of edges.
        level_before: level of the line before the first edge (True: high).
    """

    def __init__(self) -> None:
        self.t_ns = np.empty(_FIRST_CAPACITY, np.int64)
        self.rising = np.empty(_FIRST_CAPACITY, np.bool_)
        self.count = 0
        self.level_before = True  # the line starts high

    def lacks_room(self, edges: Edges) -> bool:
        """Whether the arrays would have to grow to take these edges."""
        return self.count + len(edges.t_ns) > len(self.t_ns)

    def append(self, edges: Edges) -> None:
        """Take the next edges."""
        if self.lacks_room(edges):
            self._move(0, 2 * (self.count + len(edges.t_ns)))  # twice: copies stay rare
        count = self.count + len(edges.t_ns)
        self.t_ns[self.count : count] = edges.t_ns
        self.rising[self.count : count] = edges.rising
        self.count = count

    def forget(self, t_ns: int) -> None:
        """Drop the edges before ``t_ns`` (ns)."""
        first = int(np.searchsorted(self.t_ns[: self.count], t_ns, side='left'))
        if first:
            self.level_before = bool(self.rising[first - 1])
            self._move(first, max(_FIRST_CAPACITY, 2 * (self.count - first)))

    def _move(self, first: int, capacity: int) -> None:
        kept = slice(first, self.count)
        t_ns, rising = np.empty(capacity, np.int64), np.empty(capacity, np.bool_)
        self.count -= first
        t_ns[: self.count] = self.t_ns[kept]
        rising[: self.count] = self.rising[kept]
        self.t_ns, self.rising = t_ns, rising


class CharacterReader:
    """Reads the bits of a span off the edges and decodes them.

    Args:
        bit_rate_bps: the nominal bit rate f (bit/s).
        frame: the character frame.
    """

    def __init__(self, bit_rate_bps: float, frame: CharacterFrame) -> None:
        self._bit_rate_bps = bit_rate_bps
        self._bit_ns = NS_PER_S / bit_rate_bps
        self._length = frame.length
        self._decode = frame.decoding_table()

    def read(self, span: Span, record: EdgeRecord) -> Character:
        """Return the character of ``span``; ``record`` must hold the edges from its start on."""
        slot_ns = (span.stop_ns - span.start_ns) / self._length if span.stop_seen else self._bit_ns
        bits, confidence = _read_slots(
            record.t_ns, record.rising, record.count, record.level_before, span.start_ns, slot_ns, self._length
        )
        code, status = self._decode[bits]
        return Character(span.start_ns, code, status, confidence, bits, self._bit_rate_bps)


@njit(cache=True, nogil=True)
def _read_slots(edge_t, edge_rising, count, level_before, start, slot, length):  # type: ignore[no-untyped-def]
    """Return the levels in the middles of the slots, first one most significant, and the confidence."""
    bits = 0
    nearest = 0.5 * slot
    i = np.searchsorted(edge_t[:count], start)
    level = level_before if i == 0 else edge_rising[i - 1]
    first = i
    for k in range(length):
        middle = (k + 0.5) * slot
        while i < count and edge_t[i] - start <= middle:
            level = edge_rising[i]
            i += 1
        if i > first:
            nearest = min(nearest, middle - (edge_t[i - 1] - start))
        if i < count:
            nearest = min(nearest, (edge_t[i] - start) - middle)
        bits = bits << 1 | (1 if level else 0)
    return bits, nearest / (0.5 * slot)
