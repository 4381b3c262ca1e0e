"""Bit rates tried side by side: every listed rate reads the signal, the one that explains most of it is kept.

Until a rate is settled its characters are held back.  A rate *explains* the time that its ok characters cover; the
number of characters would not do, since a fast rate reads several short frames in one character of a slow signal::

    time       ─────────────────────────────────────────────►
    504 bps    │    ok     │    ok     │    ok     │    ok        4 characters, all of the time
    3125 bps   │ok│   │ok│  │x│  │ok│  │ok│   │x│    │ok│         5 characters, less than half of the time

A rate is settled when 8 of its last 10 characters are ok and over their span no other rate has more for it: the time
it explains, less twice the time of its characters that are not ok.  Where its ok characters cover three quarters of
that span there is no room for another rate, and it is settled at once.  Otherwise (a beacon with pauses between its
characters, or a slow signal read too fast) it waits until every slower rate has had as many characters, or the time
for 15.  Of two rates so close that both read the signal, the one whose clock agrees better is kept.

If nothing is settled after 15 characters of the slowest rate, those of the rate that explains most are given out all
the same, so that the parity record can judge them, and the trial goes on.

Readings of all rates are weighed in the order of the stream's time at which they were decided, and only once that
time has passed, so that any batching settles at the same one.
"""

from __future__ import annotations

import statistics

import numpy as np
from numpy.typing import NDArray

from beacon_comm.core.character import Character, Status
from beacon_comm.core.framing import CharacterFrame
from beacon_comm.core.parameters import Parameters
from beacon_comm.core.threshold import (
    GivenOnce,
    GivenRate,
    Reading,
    ThresholdDemodulator,
    covered_ns,
    explained_ns,
)

SETTLING_CHARACTERS = 10
"""A rate is judged by so many last characters …"""

SETTLING_OK = 8
"""… of which so many must be ok."""

FULL_SHARE = 0.75
"""Ok characters over so much of the time leave no room for another rate."""

CONTRADICTION_WEIGHT = 2
"""Time covered by characters that are not ok counts so many times against a rate."""

ALIKE = 0.05
"""Rates that differ by less than half a bit in a character can both read a signal; the better clock is kept."""

HELD_CHARACTERS = 15
"""Nothing is held for longer than so many characters of the slowest rate."""


class _Rate:
    """One listed rate: its demodulator, and the readings held until a rate is settled."""

    def __init__(self, bit_rate_bps: float, parameters: Parameters) -> None:
        self.demodulator = ThresholdDemodulator(bit_rate_bps, parameters)
        self.duration_ns = CharacterFrame.from_parameters(parameters).duration_ns(bit_rate_bps)
        self.patience_ns = round(HELD_CHARACTERS * self.duration_ns)
        self.held: list[Reading] = []

    def hold(self, reading: Reading) -> None:
        """Hold a reading, in the place of those it overlaps."""
        while self.held and self.held[-1].span.stop_ns > reading.span.start_ns:
            self.held.pop()
        self.held.append(reading)

    @property
    def last(self) -> list[Reading]:
        """The readings it is judged by."""
        return self.held[-SETTLING_CHARACTERS:]

    @property
    def passes(self) -> bool:
        """Whether enough of the last characters are ok."""
        ok = sum(reading.character.status == Status.OK for reading in self.last)
        return len(self.last) == SETTLING_CHARACTERS and ok >= SETTLING_OK

    @property
    def is_full(self) -> bool:
        """Whether its last ok characters leave no room for another rate."""
        start_ns, stop_ns = self.last_span_ns
        return explained_ns(self.last, start_ns, stop_ns) >= FULL_SHARE * (stop_ns - start_ns)

    @property
    def last_span_ns(self) -> tuple[int, int]:
        """Start and end of the readings it is judged by (ns)."""
        return self.last[0].span.start_ns, self.last[-1].span.stop_ns

    @property
    def clock_error(self) -> float:
        """How far the typical character is off its nominal duration, as a share of it; 1 without characters."""
        spans_ns = [reading.span.stop_ns - reading.span.start_ns for reading in self.last]
        return abs(statistics.median(spans_ns) / self.duration_ns - 1.0) if spans_ns else 1.0

    def merit_ns(self, start_ns: int, stop_ns: int) -> int:
        """Return how much more time between two times (ns) speaks for the rate than against it.

        A character that is not ok speaks against it twice as much as an ok one for it: a slow rate reads a few frames
        out of a fast signal with pauses by chance, and each of them is long.
        """
        first = len(self.held)
        while first and self.held[first - 1].span.stop_ns > start_ns:
            first -= 1
        overlapping = self.held[first:]
        explained = explained_ns(overlapping, start_ns, stop_ns)
        contradicting = covered_ns(overlapping, start_ns, stop_ns) - explained
        return explained - CONTRADICTION_WEIGHT * contradicting

    def merit_since(self, start_ns: int) -> tuple[float, int]:
        """Return the time explained from ``start_ns`` on (ns); for rates alike in that, the number of characters.

        Each ok character explains as much of its time as it is confident: long frames that a slow rate reads out of
        a fast signal by chance have edges in the middles of their bits.
        """
        fresh = [reading for reading in self.held if reading.span.start_ns >= start_ns]
        explained = sum(
            (reading.span.stop_ns - reading.span.start_ns) * reading.character.confidence
            for reading in fresh
            if reading.character.status == Status.OK
        )
        return explained, len(fresh)


class RateBank(GivenRate):
    """Demodulates at all listed rates until one is settled, then at that one.

    Args:
        parameters: ``bit_rates`` and those of :class:`ThresholdDemodulator`.  With one rate it is settled from the
            start and its characters go out at once.
    """

    def __init__(self, parameters: Parameters) -> None:
        self._rates = [_Rate(bit_rate_bps, parameters) for bit_rate_bps in dict.fromkeys(parameters.bit_rates)]
        self._settled = self._rates[0].demodulator if len(self._rates) == 1 else None
        self._longest_ns = max(rate.patience_ns for rate in self._rates)
        self._decided: list[tuple[_Rate, Reading]] = []
        self._held_since_ns: int | None = None
        self._given = GivenOnce()

    @property
    def bit_rate_bps(self) -> float | None:
        """The settled bit rate (bit/s), None before."""
        return None if self._settled is None else self._settled.bit_rate_bps

    def push(self, t_ns: NDArray[np.int64], polarity: NDArray[np.int8], t_end_ns: int) -> list[Character]:
        """Take the next events; see :class:`beacon_comm.core.demodulator.Demodulator`."""
        if self._settled is not None:
            return self._given.take(self._settled.push_readings(t_ns, polarity, t_end_ns))
        for rate in self._rates:
            self._decided += [(rate, reading) for reading in rate.demodulator.push_readings(t_ns, polarity, t_end_ns)]
        return self._weigh(t_end_ns)

    def miss(self, start_ns: int, stop_ns: int) -> None:
        """Hear of missing events; see :class:`beacon_comm.core.demodulator.GapAware`."""
        demodulators = [rate.demodulator for rate in self._rates] if self._settled is None else [self._settled]
        for demodulator in demodulators:
            demodulator.miss(start_ns, stop_ns)

    def flush(self) -> list[Character]:
        """End the stream; if no rate is settled, give the characters of the one that explains most out."""
        if self._settled is not None:
            return self._given.take(self._settled.flush_readings())
        for rate in self._rates:
            self._decided += [(rate, reading) for reading in rate.demodulator.flush_readings()]
        return self._weigh(None)

    def _weigh(self, t_end_ns: int | None) -> list[Character]:
        """Weigh the readings that were decided before ``t_end_ns`` (ns), None: all; return what is to be given out."""
        self._decided.sort(key=lambda item: item[1].decided_ns)  # stable: rates in the order of the list
        characters: list[Character] = []
        while self._decided and (t_end_ns is None or self._decided[0][1].decided_ns < t_end_ns):
            now_ns = self._decided[0][1].decided_ns
            if self._is_overdue(now_ns):
                characters += self._give_best()
                continue
            rate, reading = self._decided.pop(0)
            rate.hold(reading)
            if self._held_since_ns is None:
                self._held_since_ns = reading.span.start_ns
            if rate.passes and self._is_best(rate) and (rate.is_full or self._slower_had_their_chance(rate, now_ns)):
                return characters + self._settle(rate)
        if self._held_since_ns is not None and (t_end_ns is None or self._is_overdue(t_end_ns)):
            characters += self._give_best()
        return characters

    def _is_overdue(self, now_ns: int) -> bool:
        return self._held_since_ns is not None and now_ns > self._held_since_ns + self._longest_ns

    def _is_best(self, rate: _Rate) -> bool:
        """Tell whether no other rate has more for it over the span that ``rate`` is judged by."""
        start_ns, stop_ns = rate.last_span_ns
        merit_ns = rate.merit_ns(start_ns, stop_ns)
        for other in self._rates:
            ahead_ns = other.merit_ns(start_ns, stop_ns) - merit_ns
            if other is rate:
                continue
            if abs(other.duration_ns / rate.duration_ns - 1.0) < ALIKE:
                # Both read the same signal, one of them a moment later.
                if ahead_ns >= -other.duration_ns and other.clock_error < rate.clock_error:
                    return False
            elif ahead_ns > 0:
                return False
        return True

    def _slower_had_their_chance(self, rate: _Rate, now_ns: int) -> bool:
        since_ns = now_ns if self._held_since_ns is None else self._held_since_ns
        return all(
            len(other.held) >= SETTLING_CHARACTERS or now_ns >= since_ns + other.patience_ns
            for other in self._rates
            if other.duration_ns > rate.duration_ns
        )

    def _settle(self, rate: _Rate) -> list[Character]:
        """Keep ``rate``; return all its characters that are decided and were not given out before."""
        self._settled = rate.demodulator
        readings = rate.held + [reading for other, reading in self._decided if other is rate]
        self._rates, self._decided, self._held_since_ns = [], [], None
        return self._given.take(readings)

    def _give_best(self) -> list[Character]:
        """Stop holding; return the characters of the rate that explains most, and keep it if it passes."""
        since_ns = 0 if self._held_since_ns is None else self._held_since_ns
        best = max(self._rates, key=lambda rate: rate.merit_since(since_ns))
        if best.passes:
            return self._settle(best)
        characters = self._given.take(best.held)
        for rate in self._rates:
            rate.held = rate.last  # what it is judged by; given out before
        self._held_since_ns = None
        return characters
