"""The stream's time: goes on with the clock where the topic is silent, and never breaks its word.

The core is told "every event still to come has t >= t_end" (:mod:`beacon_comm.core.events`).  Packets say so by
themselves; a silent topic says nothing, so its time is carried on by the clock, lagging behind it::

    clock   ──packet──┬──── lag ────┬─────────────────────► idle
    stream  ──────────┴·· stands ···┴─────────────────────► t_end + idle - lag

The lag is what a packet may be late without harm (a busy machine, a stalled driver); once the publisher has gone
nothing can be late any more, and it is ``silent_after``.

A packet may be later than that (a paused bag) and hold events older than the time that was
announced.  They are not squeezed into one instant, nor dropped: the sensor's clock is taken to have stood still for
the difference, and everything from there on is *shifted* by it.  What was announced in between was no silence: the stream
is torn there, and said to be missing.  :meth:`StreamTime.sensor_ns` takes the shift out again, so outputs carry true sensor
time.  After a late packet the lag is lengthened, so that a topic whose packets come
at 0.6 s is late once, not always.
"""

from __future__ import annotations

from dataclasses import replace

from beacon_comm.core.events import EventBatch

LONGEST_LEARNT_LAG_NS = 2_000_000_000
KEPT_SHIFTS = 64


class StreamTime:
    """Admits batches to the stream and carries its time on through silence.

    Args:
        silent_after_ns: a topic without packets for this long (ns) is silent.
        lag_ns: how far the time then stays behind the clock (ns) while the topic has a publisher.
    """

    def __init__(self, silent_after_ns: int, lag_ns: int) -> None:
        self._silent_after_ns = silent_after_ns
        self._given_lag_ns = max(silent_after_ns, lag_ns)
        self.late_packets = 0
        self.reset()

    def reset(self) -> None:
        """Start anew: another publisher, or the sensor's clock was restarted."""
        self._lag_ns = self._given_lag_ns
        self._publisher_gone = False
        self._shifts: list[tuple[int, int]] = [(-(2**63), 0)]
        self._packet_end_ns: int | None = None
        self._end_ns = -(2**63)
        self._arrival_ns = 0
        self._idle_ns = 0

    def admit(self, batch: EventBatch, now_ns: int) -> EventBatch:
        """Return a packet's batch in stream time; ``now_ns`` is the node's clock at its arrival (ns)."""
        shift_ns = self._shifts[-1][1]
        missing_ns = batch.missing_until_ns
        if len(batch) and int(batch.t_ns[0]) + shift_ns < self._end_ns:
            missing_ns = int(batch.t_ns[0])
            shift_ns = self._end_ns - int(batch.t_ns[0])
            self._shifts = [*self._shifts[-KEPT_SHIFTS:], (self._end_ns, shift_ns)]
            learnt_ns = min(2 * (now_ns - self._arrival_ns), LONGEST_LEARNT_LAG_NS)
            self._lag_ns = max(self._lag_ns, learnt_ns)
            self.late_packets += 1
        self._packet_end_ns = self._end_ns = max(self._end_ns, batch.t_end_ns + shift_ns)
        self._arrival_ns = now_ns
        self._idle_ns = 0
        self._publisher_gone = False
        if shift_ns or batch.t_end_ns != self._end_ns:
            batch = replace(
                batch,
                t_ns=batch.t_ns + shift_ns,
                t_end_ns=self._end_ns,
                missing_until_ns=None if missing_ns is None else missing_ns + shift_ns,
            )
        return batch

    def hear(self, now_ns: int) -> None:
        """Take notice of a packet that is not admitted: the topic is not silent, but unread."""
        if self._packet_end_ns is not None:
            self._arrival_ns = now_ns
            self._idle_ns = 0

    def tick(self, now_ns: int, period_ns: int) -> EventBatch | None:
        """Return an empty batch that moves a silent stream's time on, or None; to be called every ``period_ns``.

        The silence is the shorter of what the node's clock ``now_ns`` says and what the calls add up to: a simulated
        clock may stand, and a node that was busy has packets waiting, which come between two calls.
        """
        if self._packet_end_ns is None:
            return None
        if now_ns < self._arrival_ns:  # the node's clock was set
            self._arrival_ns = now_ns
        self._idle_ns = min(self._idle_ns + period_ns, now_ns - self._arrival_ns)
        return self._carry_on(self._silent_after_ns if self._publisher_gone else self._lag_ns)

    def publisher_gone(self) -> None:
        """Nothing more can come, and nothing can be late, until a publisher comes again."""
        self._publisher_gone = True

    def finish(self) -> EventBatch | None:
        """Return an empty batch up to the clock, or None: the stream ends here."""
        return self._carry_on(0)

    def _carry_on(self, lag_ns: int) -> EventBatch | None:
        if self._packet_end_ns is None:
            return None
        end_ns = self._packet_end_ns + self._idle_ns - lag_ns
        if end_ns <= self._end_ns:
            return None
        self._end_ns = end_ns
        return replace(EventBatch.empty(end_ns), carried_on=True)

    def sensor_ns(self, stream_ns: int) -> int:
        """Return the sensor time (ns) of a time of the stream (ns)."""
        for from_ns, shift_ns in reversed(self._shifts):
            if stream_ns >= from_ns:
                return stream_ns - shift_ns
        return stream_ns - self._shifts[0][1]
