"""What every decoder of a payload is given and gives back, and the counters its compiled loop adds to."""

from __future__ import annotations

from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from beacon_comm.core.events import EventBatch
from beacon_comm.wire.cdr import Packet

RESTART_STEP_NS = 1_000_000_000
"""A sensor whose event time steps back by more than this was restarted; by less, the events are clamped."""
NO_TIME = -(1 << 62)
"""Stands for a time not known yet, below every real one; small enough that differences do not overflow."""

# Places in a tally, the counters of the compiled loops.
OUTSIDE, UNDECODED, CLAMPED, SKIPPED, TRIGGER_0, TRIGGER_1 = range(6)
TALLY_KINDS = (
    'outside_events',
    'undecoded_events',
    'clamped_times',
    'skipped_words',
    'triggers_0',
    'triggers_1',
)
Tally = NDArray[np.int64]


class Continuity(NamedTuple):
    """How a packet follows the one before it.

    Attributes:
        elapsed_ns: host time since the packet before (ns); 0 where it is not known.
        packets_missing: ``seq`` jumped; what the words before the gap had set up is not valid.
        seq_fell: ``seq`` went back: the driver was started again, or a recording from its start.
    """

    elapsed_ns: int = 0
    packets_missing: bool = False
    seq_fell: bool = False


class Reading(NamedTuple):
    """A packet decoded.

    Attributes:
        batch: its events, or None while the stream's time is not known.
        restarted: event time stepped back as only a restart of the sensor does.
        odd_bytes: bytes at the payload's end that are no whole word.
    """

    batch: EventBatch | None
    restarted: bool = False
    odd_bytes: int = 0


class PayloadDecoder(Protocol):
    """A decoder of one encoding, with its state from packet to packet."""

    def decode(self, packet: Packet, continuity: Continuity, tally: Tally) -> Reading:
        """Decode a packet whose ``seq`` and sensor size were looked at; adds to ``tally``."""
        ...


class EventColumns:
    """Arrays for up to ``capacity`` events, filled by a compiled loop and then cut to the events it found."""

    __slots__ = ('x', 'y', 'polarity', 't_ns')

    def __init__(self, capacity: int) -> None:
        self.x = np.empty(capacity, np.uint16)
        self.y = np.empty(capacity, np.uint16)
        self.polarity = np.empty(capacity, np.int8)
        self.t_ns = np.empty(capacity, np.int64)

    def batch(self, n: int, t_end_ns: int) -> EventBatch:
        """Return the first ``n`` events; a copy where the arrays are mostly empty, so that it does not hold them."""
        columns = (self.x[:n], self.y[:n], self.polarity[:n], self.t_ns[:n])
        if 4 * n < len(self.x):
            columns = (columns[0].copy(), columns[1].copy(), columns[2].copy(), columns[3].copy())
        return EventBatch(*columns, t_end_ns)


def words_of(payload: NDArray[np.uint8], dtype: str, word_bytes: int) -> NDArray:
    """Return whole words of ``word_bytes`` as little-endian numbers, ``(n,)``, aligned and read-only."""
    words = payload[: len(payload) // word_bytes * word_bytes].view(dtype)
    if not words.flags.aligned:
        words = words.copy()
    # Of one type whatever the message's bytes are, or each kind of buffer would be compiled for anew.
    words.flags.writeable = False
    return words


class OffsetClock:
    """The time of formats whose packets carry their own time base: no unwrapping, only order.

    Keeps the latest time given out; a packet's first event decides whether the sensor was restarted.
    """

    def __init__(self) -> None:
        self.latest_ns = NO_TIME

    def follow(self, first_event_ns: int, seq_fell: bool) -> bool:
        """Return True, and forget the time so far, if a packet's first event tells of a restart."""
        back_ns = self.latest_ns - first_event_ns
        restarted = back_ns > RESTART_STEP_NS or (seq_fell and back_ns > 0)
        if restarted:
            self.latest_ns = NO_TIME
        return restarted

    def read(self, columns: EventColumns, n: int, at_least_ns: int, restarted: bool, odd_bytes: int) -> Reading:
        """Move on to the last event, or to ``at_least_ns`` if that is later, and return the packet's reading."""
        last_ns = int(columns.t_ns[n - 1]) if n else NO_TIME
        self.latest_ns = max(self.latest_ns, last_ns, at_least_ns)
        if self.latest_ns == NO_TIME:
            return Reading(None, restarted, odd_bytes)
        return Reading(columns.batch(n, self.latest_ns), restarted, odd_bytes)

