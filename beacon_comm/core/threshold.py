"""The threshold demodulator: the paper's sections III-B.3 to III-B.5 at one bit rate.

::

    events ─► high-pass filter, levels ─► edges ─► synchronisation ─► spans ─► discretisation ─► characters

The synchroniser runs several trials (see :mod:`beacon_comm.core.synchronisation`).  One of them *leads*: its
characters go out as soon as they are decided.  Another one takes the lead once its last five characters are all ok
while the leader's ok characters cover less than half of the same time.

Where events are missing the frames run on by the nominal clock, for as long as it is good for; behind a longer gap nobody
leads until one has earned it.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable
from dataclasses import dataclass, replace
from itertools import groupby

import numpy as np
from numpy.typing import NDArray

from beacon_comm.core.character import Character, Status
from beacon_comm.core.discretisation import CharacterReader, EdgeRecord
from beacon_comm.core.framing import CharacterFrame
from beacon_comm.core.high_pass import HighPassFilter
from beacon_comm.core.parameters import Parameters
from beacon_comm.core.synchronisation import EndBitSynchroniser, Span

LEAD_CHARACTERS = 5
"""So many ok characters in a row give a trial the lead."""

COASTED_CHARACTERS = 4
"""The clock is carried through a gap of so many characters: 44 bits at 1 % are the half bit that the window has."""

REGAINED_CHARACTERS = 8
"""So many ok characters in a row give the lead where nobody has it: there is no leader to compare with."""

NOBODY = -1
"""The leader after a longer gap."""

REMEMBERED_CHARACTERS = 30
"""Characters that are remembered of each trial."""


@dataclass(frozen=True, slots=True)
class Reading:
    """A character together with its place in the stream.

    Attributes:
        character: the character.
        span: where it lay.
        decided_ns: the stream's time from which on it is known (ns).
    """

    character: Character
    span: Span
    decided_ns: int


def covered_ns(readings: Iterable[Reading], start_ns: int, stop_ns: int) -> int:
    """Return the time between two times that characters cover (ns)."""
    return sum(max(0, min(r.span.stop_ns, stop_ns) - max(r.span.start_ns, start_ns)) for r in readings)


def explained_ns(readings: Iterable[Reading], start_ns: int, stop_ns: int) -> int:
    """Return the time between two times that ok characters cover (ns)."""
    return covered_ns((r for r in readings if r.character.status == Status.OK), start_ns, stop_ns)


class GivenOnce:
    """Passes readings on, but not those of a time that was given out before."""

    def __init__(self) -> None:
        self._until_ns: int | None = None

    def take(self, readings: Iterable[Reading]) -> list[Character]:
        """Return the characters of the readings that do not begin before the last one given ended."""
        characters = []
        for reading in readings:
            if self._until_ns is None or reading.span.start_ns >= self._until_ns:
                characters.append(reading.character)
                self._until_ns = reading.span.stop_ns
        return characters


class GivenRate:
    """What the demodulators have in common that are told the bit rate, and leave it to the parity record to judge."""

    @property
    def bit_rate_std_bps(self) -> float | None:
        """None: the rate is given, not estimated."""
        return None

    @property
    def given_up(self) -> bool:
        """False: it decides nothing, the parity record does."""
        return False


class ThresholdDemodulator(GivenRate):
    """The paper's demodulator at one bit rate; characters go out as soon as they are decided.

    Args:
        bit_rate_bps: the nominal bit rate f (bit/s), 20 to 10 000.
        parameters: cut-off, levels, ``idle_start``, ``start_trials`` and the character frame.
    """

    def __init__(self, bit_rate_bps: float, parameters: Parameters) -> None:
        frame = CharacterFrame.from_parameters(parameters)
        trials = frame.most_falls if parameters.start_trials else 1
        self._bit_rate_bps = bit_rate_bps
        self._filter = HighPassFilter(bit_rate_bps, parameters)
        self._synchroniser = EndBitSynchroniser(bit_rate_bps, frame, parameters.idle_start, trials)
        self._coasted_ns = round(COASTED_CHARACTERS * frame.duration_ns(bit_rate_bps))
        self._reader = CharacterReader(bit_rate_bps, frame)
        self._record = EdgeRecord()
        self._recent: list[deque[Reading]] = [deque(maxlen=REMEMBERED_CHARACTERS) for _ in range(trials)]
        self._leader = 0
        self._given = GivenOnce()

    @property
    def bit_rate_bps(self) -> float:
        """The one bit rate (bit/s)."""
        return self._bit_rate_bps

    def push(self, t_ns: NDArray[np.int64], polarity: NDArray[np.int8], t_end_ns: int) -> list[Character]:
        """Take the next events; see :class:`beacon_comm.core.demodulator.Demodulator`."""
        return self._given.take(self.push_readings(t_ns, polarity, t_end_ns))

    def flush(self) -> list[Character]:
        """End the stream; see :class:`beacon_comm.core.demodulator.Demodulator`."""
        return self._given.take(self.flush_readings())

    def miss(self, start_ns: int, stop_ns: int) -> None:
        """Hear of missing events; see :class:`beacon_comm.core.demodulator.GapAware`."""
        self._synchroniser.miss(stop_ns)
        if stop_ns - start_ns > self._coasted_ns:
            self._synchroniser.lose()
            if len(self._recent) > 1:
                self._leader = NOBODY
                for recent in self._recent:
                    recent.clear()

    def push_readings(self, t_ns: NDArray[np.int64], polarity: NDArray[np.int8], t_end_ns: int) -> list[Reading]:
        """Take the next events; return readings in order of decision.

        When another trial takes the lead, its remembered readings are returned: a reading that begins before the one
        before it ended takes that one's place.
        """
        edges = self._filter.push(t_ns, polarity)
        if self._record.lacks_room(edges):
            self._record.forget(self._synchroniser.needed_from_ns)
        self._record.append(edges)
        return self._read(self._synchroniser.push(edges, t_end_ns))

    def flush_readings(self) -> list[Reading]:
        """End the stream; return readings as :meth:`push_readings` does."""
        return self._read(self._synchroniser.flush())

    def _read(self, spans: list[Span]) -> list[Reading]:
        readings: list[Reading] = []
        for _, group in groupby(spans, key=lambda span: (span.decided_ns, span.by_edge)):
            together = {span.trial: span for span in group}
            leading = together.pop(self._leader, None)  # None for nobody
            if leading is not None:
                readings.append(self._take(leading))
            for span in together.values():
                if leading is not None and span.start_ns == leading.start_ns and span.stop_ns == leading.stop_ns:
                    self._recent[span.trial].clear()  # it has joined the leader
                else:
                    self._take(span)
            for trial in together:
                if self._deserves_lead(trial):
                    self._leader = trial
                    decided_ns = self._recent[trial][-1].decided_ns
                    readings += [replace(reading, decided_ns=decided_ns) for reading in self._recent[trial]]
        return readings

    def _take(self, span: Span) -> Reading:
        reading = Reading(self._reader.read(span, self._record), span, span.decided_ns)
        self._recent[span.trial].append(reading)
        return reading

    def _deserves_lead(self, trial: int) -> bool:
        recent = self._recent[trial]
        needed = REGAINED_CHARACTERS if self._leader == NOBODY else LEAD_CHARACTERS
        if len(recent) < needed:
            return False
        last = [recent[i] for i in range(-needed, 0)]
        if any(reading.character.status != Status.OK for reading in last):
            return False
        if self._leader == NOBODY:
            return True
        start_ns, stop_ns = last[0].span.start_ns, last[-1].span.stop_ns
        return 2 * explained_ns(self._recent[self._leader], start_ns, stop_ns) < stop_ns - start_ns
