"""Character latency: how long after it could be known a character was out.

A receiver decides a character a stated delay after its end (:func:`beacon_comm.core.demodulator.decision_delay_bits`), in
the stream's time.  The first packet whose events reach that time, the *due* time, is the one that lets it be decided; from
its arrival, as the middleware stamped it, to the character's having been published is the latency, both on the host's clock::

    stream    │ character │◄── delay ──►│ due
    packets   ├─────┼─────┼─────┼─────┼─────┤                  in event time
                                          └► arrives ·· waits, is read ·· published
                                             │◄────────── latency ──────────────►│

Only characters that fell due while their track was being read count.  What is read back when a lock is found or a slot is given
was due before; what a silence or the stream's end decides was held by no packet.  Where the packet itself was shed or lost, the
next one that was read stands in for it; where a character is decided a moment before it is due, since the bit clock
moved in between, the packet it was decided with.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Sequence
from math import ceil

LOOKS = 5
"""The window: the time between so many looks, which the node takes once a second."""
MOST_CHARACTERS = 4000
"""So many characters are kept of the time between two looks, the last ones."""
MOST_PACKETS = 4096
"""So many arrivals are kept."""
NS_PER_MS = 1e6


def percentile_ms(latencies_ns: Sequence[int], share: float) -> str:
    """Return the smallest latency (ms) that a share of them (ns, ascending) does not exceed; ``nan`` without any."""
    if not latencies_ns:
        return 'nan'
    return f'{latencies_ns[max(ceil(share * len(latencies_ns)), 1) - 1] / NS_PER_MS:.3f}'


class CharacterLatency:
    """The latencies of the last few seconds' characters."""

    def __init__(self) -> None:
        self._arrivals: deque[tuple[int, int]] = deque(maxlen=MOST_PACKETS)
        self._past: deque[deque[int]] = deque(maxlen=LOOKS - 1)
        self._latencies_ns: deque[int] = deque(maxlen=MOST_CHARACTERS)

    def arrived(self, end_ns: int, arrival_ns: int) -> None:
        """Take notice of a packet that was read: the stream's time after it, and the host's when it arrived (ns).

        What it gave may be published in parts: it is noticed once.
        """
        if self._arrivals and (end_ns, arrival_ns) == self._arrivals[-1]:
            return
        if self._arrivals and end_ns < self._arrivals[-1][0]:
            self._arrivals.clear()  # the sensor's clock was restarted
        self._arrivals.append((end_ns, arrival_ns))

    def published(self, due_ns: Iterable[int], now_ns: int) -> None:
        """Take notice of characters that are out, by the times of the stream at which they were due; now: the host's (ns)."""
        for due in due_ns:
            since_ns = now_ns
            for place, (end_ns, arrival_ns) in enumerate(reversed(self._arrivals)):
                if place and end_ns < due:
                    break
                since_ns = arrival_ns
            self._latencies_ns.append(max(now_ns - since_ns, 0))

    def look(self) -> dict[str, object]:
        """Return the window's values for ``/diagnostics``, and move it on."""
        latencies_ns = sorted(one for part in (*self._past, self._latencies_ns) for one in part)
        self._past.append(self._latencies_ns)
        self._latencies_ns = deque(maxlen=MOST_CHARACTERS)
        return {
            'character_latency_p50_ms': percentile_ms(latencies_ns, 0.5),
            'character_latency_p99_ms': percentile_ms(latencies_ns, 0.99),
            'character_latency_characters': len(latencies_ns),
        }
