"""Candidate slots: which tracks are demodulated (the paper's section III, "Detection algorithm").

::

    tracks ──> queue ────────────────> slots: demodulator + parity record ──> characters
               1. never tried,         │  confirmed: keeps its slot
                  highest index first  │  rejected, starved, demoted: gives it up at the next hop
               2. tried before,        │  turn over (not confirmed by turn_characters, others wait): likewise
                  longest out first <──┘

Confirmed beacons hold at most ``candidate_slots - reserved_candidate_slots`` of the slots.  A candidate that is
confirmed beyond that goes on in an extra place of its own, so that no beacon is cut off and its slot is free for the
next candidate: there are always ``max(candidate_slots - confirmed, reserved_candidate_slots)`` slots for candidates.

Slots change hands only in :meth:`CandidateSlots.assign`, on the hop grid of event time, and everything that decides
about it is a function of the events before that hop: however the stream is cut into batches, the result is the same.

Where events are missing, characters are *erased*: those that overlap the gap or begin within ``UNSETTLED_BITS`` behind it
are neither given out nor counted, whatever a demodulator made of the hole.  Where the stream's time was carried on by a clock,
nobody has vouched for the silence: a character with data or parity in it may be half a one, and is *repaired* at best.
"""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import dataclass, field, replace
from enum import IntEnum
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from beacon_comm.core.character import Character, Status
from beacon_comm.core.confirmation import ParityRecord
from beacon_comm.core.demodulator import Demodulator, GapAware, Recognising, Searching
from beacon_comm.core.event_buffer import buffer_length_ns
from beacon_comm.core.events import NS_PER_S
from beacon_comm.core.last_looks import WEIGHT, LastLooks
from beacon_comm.core.parameters import Parameters
from beacon_comm.core.routing import Routed, RoutedEvents
from beacon_comm.core.signature import Signature
from beacon_comm.core.tracks import Track

UNSETTLED_BITS = 1.0
"""An edge so close behind a gap (bit) may be the gap's end, and not the line's."""

UNHEARD_CONFIDENCE = 0.5
"""No character is surer that has data or parity where time was carried on."""

_GAPS_KEPT_NS = 60 * NS_PER_S
"""Gaps are remembered for so long, or for ten buffers: a beacon that is found late is read from far back on."""

Times = NDArray[np.int64]
Polarities = NDArray[np.int8]
Backlog = Callable[[int], tuple[Times, Polarities]]


class BeaconState(IntEnum):
    """State of a track; the numbers are those of ``msg/Beacon.msg``."""

    WAITING = 0
    """Candidate without a demodulator: it has not had its turn, or that ended undecided."""
    DEMODULATING = 1
    """Candidate with a demodulator."""
    CONFIRMED = 2
    """Parity has vouched for it."""
    DEMOTED = 3
    """Parity has failed it, or there were too few characters; at the back of the queue."""
    LOST = 4
    """Unseen past lost_after_s, merged, or ended in favour of others where max_tracks are kept."""


class ReceivedCharacter(NamedTuple):
    """A character and the label of the track it came from."""

    track_id: int
    character: Character


class Gaps:
    """Stretches of the stream whose events are missing, or not vouched for.

    Args:
        kept_ns: those that ended longer ago than this (ns) are forgotten.
    """

    def __init__(self, kept_ns: int) -> None:
        self._kept_ns = kept_ns
        self._starts: list[int] = []
        self._stops: list[int] = []

    def add(self, start_ns: int, stop_ns: int) -> None:
        """Take a gap (ns) behind those before."""
        old = bisect_right(self._stops, start_ns - self._kept_ns)
        del self._starts[:old], self._stops[:old]
        if self._stops and self._stops[-1] == start_ns:
            self._stops[-1] = stop_ns
            return
        self._starts.append(start_ns)
        self._stops.append(stop_ns)

    def clear(self) -> None:
        """Forget all."""
        self._starts.clear()
        self._stops.clear()

    def since(self, t_ns: int) -> list[tuple[int, int]]:
        """Return the gaps that end after a time (ns), each with its start."""
        first = bisect_right(self._stops, t_ns)
        return list(zip(self._starts[first:], self._stops[first:], strict=True))

    def overlap(self, start_ns: int, stop_ns: int) -> bool:
        """Tell whether one of them has a part of the time from ``start_ns`` to ``stop_ns`` (ns)."""
        first = bisect_right(self._stops, start_ns)
        return first < len(self._starts) and self._starts[first] < stop_ns


@dataclass(slots=True)
class _Slot:
    demodulator: Demodulator
    record: ParityRecord
    gaps: Gaps
    carried_on: Gaps
    read_to_ns: int | None
    """End of the last character that was given out or erased, in this turn or the ones before it."""
    searching: Searching | None = field(init=False)
    """The demodulator, if it is one that searches: asked once, for asking a protocol takes long."""

    def __post_init__(self) -> None:
        self.searching = self.demodulator if isinstance(self.demodulator, Searching) else None

    def judge(self, track_id: int, characters: list[Character]) -> list[ReceivedCharacter]:
        received = []
        for character in characters:
            end_ns = self.record.end_of(character)
            self.read_to_ns = end_ns if self.read_to_ns is None else max(self.read_to_ns, end_ns)
            unsettled_ns = round(UNSETTLED_BITS * NS_PER_S / character.bit_rate_bps)
            if self.gaps.overlap(character.t_ns - unsettled_ns, end_ns):
                continue
            if self.carried_on.overlap(character.t_ns, self.record.checked_end_of(character)):
                status = Status.REPAIRED if character.status is Status.OK else character.status
                character = replace(character, status=status, confidence=min(character.confidence, UNHEARD_CONFIDENCE))
            self.record.push(character)
            received.append(ReceivedCharacter(track_id, character))
        return received

    def miss(self, start_ns: int, stop_ns: int) -> None:
        if isinstance(self.demodulator, GapAware):
            self.demodulator.miss(start_ns, stop_ns)

    def ending(self, track_id: int) -> Iterator[list[ReceivedCharacter] | float]:
        for part in self.searching.ending() if self.searching is not None else [self.demodulator.flush()]:
            yield part if isinstance(part, float) else self.judge(track_id, part)


@dataclass(frozen=True, slots=True)
class _Tried:
    """What remains of a turn that is over."""

    ended_ns: int
    record: ParityRecord
    read_to_ns: int | None


_NO_EVENTS = Routed(np.empty(0, np.int64), np.empty(0, np.int8))


class CandidateSlots:
    """Gives tracks their turn at the demodulators, and keeps those that parity confirms.

    Args:
        parameters: see "Candidate slots" of :class:`Parameters`.
        make_demodulator: called once for each slot that is given.

    Attributes:
        search_share: share of ``search_load`` that may be spent from the next hop on.
    """

    def __init__(self, parameters: Parameters, make_demodulator: Callable[[Parameters], Demodulator]) -> None:
        self._p = parameters
        self._make_demodulator = make_demodulator
        self._slots: dict[int, _Slot] = {}
        self._tried: dict[int, _Tried] = {}
        self._slots_full = False
        kept_ns = max(_GAPS_KEPT_NS, 10 * buffer_length_ns(parameters)) + round(parameters.lost_after_s * NS_PER_S)
        self._gaps, self._carried_on = Gaps(kept_ns), Gaps(kept_ns)
        self._last_looks = LastLooks[ReceivedCharacter](parameters.hop_s)
        self.search_share = 1.0

    def miss(self, start_ns: int, stop_ns: int) -> None:
        """Hear that the events of the stream from ``start_ns``, up to which it is known, to ``stop_ns`` (ns) are missing."""
        if stop_ns <= start_ns:
            return
        self._gaps.add(start_ns, stop_ns)
        for slot in self._slots.values():
            slot.miss(start_ns, stop_ns)

    def carry_on(self, start_ns: int, stop_ns: int) -> None:
        """Hear that nobody vouches for the stream's silence from ``start_ns`` to ``stop_ns`` (ns)."""
        self._carried_on.add(start_ns, stop_ns)

    def forget_gaps(self) -> None:
        """Begin a new time."""
        self._gaps.clear()
        self._carried_on.clear()

    def assign(self, tracks: Mapping[int, Track], t_ns: int, backlog: Backlog) -> list[ReceivedCharacter]:
        """Free the slots of demoted tracks and give free ones to the queue.

        To be called at each point of the hop grid, when every slot has been demodulated up to it.

        Args:
            tracks: the tracks now, by label; those that were lost have been forgotten.  They are told which of them have a
                slot, and which have had one.
            t_ns: the hop's time (ns).
            backlog: returns a track's buffered events before ``t_ns``: times (ns, ``(n,)`` int64) and polarities
                (``(n,)`` int8).  A slot that is given starts from there; of a track that has had one, from the end
                of the last character that was read, so that none is given out twice.

        Returns:
            What the backlogs of the slots given now read, and the last looks at lost tracks, in order of time.
        """
        for track_id, slot in self._slots.items():
            slot.record.advance(t_ns, tracks[track_id].quiet)
        for track_id in [track_id for track_id, slot in self._slots.items() if slot.record.demoted]:
            self._end_turn(track_id, t_ns)
        queue = self._queue(tracks)
        given: list[int] = []
        if queue:
            self._end_turns_that_are_over(t_ns, len(queue) - self._free)
            given = queue[: self._free]
        search_load = self._share_search_load(len(given), t_ns)
        self._slots_full = len(queue) > len(given)
        received = self._last_looks.work(WEIGHT * search_load, t_ns)
        for track_id in given:
            received += self._give(track_id, t_ns, search_load, *backlog(track_id))
        for track_id, track in tracks.items():
            track.held = track_id in self._slots
            if track.held:
                track.tried_ns = None
            elif track_id in self._tried:
                track.tried_ns = self._tried[track_id].ended_ns
        return sorted(received, key=_by_time)

    def demodulate(self, routed: RoutedEvents, t_end_ns: int) -> list[ReceivedCharacter]:
        """Hand the slots their events, and time to those without, so that a silence ends a character.

        Args:
            routed: new events; tracks without a slot are passed over.
            t_end_ns: time up to which the stream is known (ns), never past the next hop.

        Returns:
            The finished characters, in order of time; a track confirmed by one is confirmed from now on.
        """
        received = []
        for track_id, slot in self._slots.items():
            t_ns, polarity = routed.of_track(track_id) or _NO_EVENTS
            received += slot.judge(track_id, slot.demodulator.push(t_ns, polarity, t_end_ns))
        return sorted(received, key=_by_time)

    def forget(self, track_id: int, t_ns: int) -> list[ReceivedCharacter]:
        """Drop a track that is lost at ``t_ns`` (ns); return the last characters of its demodulator, if it has one.

        What it finds when it looks for its bit rate a last time is for :meth:`assign` to return, a little later.
        """
        self._tried.pop(track_id, None)
        slot = self._slots.pop(track_id, None)
        return [] if slot is None else self._last_looks.begin(track_id, slot.ending(track_id), t_ns)

    def end(self) -> list[ReceivedCharacter]:
        """Drop all tracks because the stream ends and another begins; return their last characters, as :meth:`flush` does."""
        received = self.flush()
        self._slots.clear()
        self._tried.clear()
        return received

    def flush(self) -> list[ReceivedCharacter]:
        """Return the last characters of all demodulators, and of lost tracks', at the end of a stream, in order of time."""
        received = self._last_looks.finish_all()
        for track_id, slot in self._slots.items():
            received += slot.judge(track_id, slot.demodulator.flush())
        return sorted(received, key=_by_time)

    @property
    def looked_back_at(self) -> Collection[int]:
        """Labels of lost tracks that are looked at for the last time; as of the last hop."""
        return self._last_looks.track_ids

    @property
    def passed_over(self) -> int:
        """How many lost tracks were not looked at for the last time: too many were lost."""
        return self._last_looks.passed_over

    @property
    def slots_full(self) -> bool:
        """Candidates with events wait because every slot is taken; as of the last hop."""
        return self._slots_full

    @property
    def confirmed(self) -> tuple[int, ...]:
        """Labels of the confirmed beacons, ascending."""
        return tuple(sorted(track_id for track_id, slot in self._slots.items() if slot.record.confirmed))

    def state(self, track_id: int) -> BeaconState:
        """Return a track's state; WAITING for one it has not heard of (that a track is LOST is for others to say)."""
        record = self.record(track_id)
        if record is None:
            return BeaconState.WAITING
        if record.demoted:
            return BeaconState.DEMOTED
        if track_id not in self._slots:
            return BeaconState.WAITING
        return BeaconState.CONFIRMED if record.confirmed else BeaconState.DEMODULATING

    def record(self, track_id: int) -> ParityRecord | None:
        """Return the record of a track's slot, or of its last turn; None if it never had one."""
        held = self._slots.get(track_id) or self._tried.get(track_id)
        return None if held is None else held.record

    def bit_rate_bps(self, track_id: int) -> float | None:
        """Return the settled bit rate of a track's demodulator (bit/s), None without one."""
        slot = self._slots.get(track_id)
        return None if slot is None else slot.demodulator.bit_rate_bps

    def bit_rate_std_bps(self, track_id: int) -> float | None:
        """Return the standard deviation of that bit rate (bit/s), None where it is not estimated."""
        slot = self._slots.get(track_id)
        return None if slot is None else slot.demodulator.bit_rate_std_bps

    def signature(self, track_id: int) -> Signature | None:
        """Return how a confirmed beacon can be known again; None: it is none, or it is not read, or the receiver cannot say."""
        slot = self._slots.get(track_id)
        if slot is None or not slot.record.confirmed or not isinstance(slot.demodulator, Recognising):
            return None
        return slot.demodulator.signature()

    def confirmed_at_ns(self, track_id: int) -> int | None:
        """Return the end of the character that confirmed a track (ns), None if it is not confirmed."""
        slot = self._slots.get(track_id)
        return slot.record.confirmed_at_ns if slot is not None and slot.record.confirmed else None

    @property
    def _free(self) -> int:
        """Number of slots a candidate may get now."""
        confirmed = sum(slot.record.confirmed for slot in self._slots.values())
        for_candidates = max(self._p.candidate_slots - confirmed, self._p.reserved_candidate_slots)
        return for_candidates - (len(self._slots) - confirmed)

    def _queue(self, tracks: Mapping[int, Track]) -> list[int]:
        def place(track_id: int) -> tuple[int, float, int]:
            track, tried = tracks[track_id], self._tried.get(track_id)
            ended_ns = track.tried_ns if tried is None else tried.ended_ns
            return (0, -track.index, track_id) if ended_ns is None else (1, ended_ns, track_id)

        ready = [track_id for track_id, track in tracks.items() if not track.quiet and not track.tentative]
        return sorted((track_id for track_id in ready if track_id not in self._slots), key=place)

    def _end_turns_that_are_over(self, t_ns: int, wanted: int) -> None:
        """Free up to ``wanted`` slots of candidates past ``turn_characters`` or given up, most characters first."""
        over = [
            (-slot.record.characters, track_id)
            for track_id, slot in self._slots.items()
            if not slot.record.confirmed
            and (slot.record.characters >= self._p.turn_characters or slot.demodulator.given_up)
        ]
        for _, track_id in sorted(over)[: max(wanted, 0)]:
            self._end_turn(track_id, t_ns)

    def _end_turn(self, track_id: int, t_ns: int) -> None:
        slot = self._slots.pop(track_id)
        self._tried[track_id] = _Tried(t_ns, slot.record, slot.read_to_ns)

    def _share_search_load(self, more: int, t_ns: int) -> float:
        """Share what may be spent on searching among the slots without a bit rate, and so many more; return each one's."""
        searching = [
            slot.searching
            for slot in self._slots.values()
            if slot.searching is not None and slot.demodulator.bit_rate_bps is None
        ]
        shares = len(searching) + more + (WEIGHT if self._last_looks.track_ids else 0)
        load = self.search_share * self._p.search_load / max(1, shares)
        for one in searching:
            one.share(load, t_ns)
        return load

    def _give(
        self, track_id: int, t_ns: int, search_load: float, times: Times, polarity: Polarities
    ) -> list[ReceivedCharacter]:
        tried = self._tried.pop(track_id, None)
        read_to_ns = None if tried is None else tried.read_to_ns
        first = 0 if read_to_ns is None else int(np.searchsorted(times, read_to_ns, 'left'))
        slot = _Slot(self._make_demodulator(self._p), ParityRecord(self._p), self._gaps, self._carried_on, read_to_ns)
        self._slots[track_id] = slot
        slot.record.advance(t_ns, quiet=False)
        if slot.searching is not None:
            slot.searching.share(search_load, t_ns)
            if tried is not None:
                slot.searching.searched(tried.ended_ns)
        received = self._last_looks.finish(track_id)
        for start_ns, stop_ns in self._gaps.since(int(times[first])) if first < len(times) else ():
            stop = max(first, int(np.searchsorted(times, start_ns, 'right')))
            received += slot.judge(track_id, slot.demodulator.push(times[first:stop], polarity[first:stop], start_ns))
            slot.miss(start_ns, stop_ns)
            first = stop
        return received + slot.judge(track_id, slot.demodulator.push(times[first:], polarity[first:], t_ns))


def _by_time(received: ReceivedCharacter) -> tuple[int, int]:
    return received.character.t_ns, received.track_id
