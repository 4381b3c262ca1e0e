"""Candidate slots: who gets a demodulator, who keeps it, and that nobody is cut off or left waiting."""

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from beacon_comm.core.candidates import BeaconState, CandidateSlots, ReceivedCharacter
from beacon_comm.core.character import Character, Status
from beacon_comm.core.framing import CharacterFrame
from beacon_comm.core.parameters import Parameters
from beacon_comm.core.routing import Routed, RoutedEvents
from beacon_comm.core.tracks import Track

T0_NS = 2**40 // 10_000_000 * 10_000_000
HOP_NS = 10_000_000
FRAME = CharacterFrame()
RATE_BPS = 1100.0  # one character a hop
TEXT = 'the quick brown fox jumps over the lazy dog; '
WAITING, DEMODULATING, CONFIRMED, DEMOTED = list(BeaconState)[:4]


class OneEventOneCharacter:
    """A demodulator for tests: an event's time becomes a character of TEXT; an OFF event's has the wrong parity."""

    bit_rate_bps = RATE_BPS
    bit_rate_std_bps = None
    given_up = False

    def __init__(self, parameters: Parameters) -> None:
        self.held: list[Character] = []

    def push(self, t_ns: np.ndarray, polarity: np.ndarray, t_end_ns: int) -> list[Character]:
        """Give a character out when the stream's time has passed its end."""
        assert np.all(t_ns < t_end_ns)
        for t, sign in zip(t_ns, polarity, strict=True):
            code = ord(TEXT[int(t) // HOP_NS % len(TEXT)])
            status = Status.OK if sign > 0 else Status.PARITY_ERROR
            self.held.append(Character(int(t), code, status, 1.0, FRAME.frame_of(code), RATE_BPS))
        ready = [c for c in self.held if c.t_ns + HOP_NS // 2 <= t_end_ns]
        self.held = self.held[len(ready) :]
        return ready

    def flush(self) -> list[Character]:
        """Give out the rest."""
        held, self.held = self.held, []
        return held


class Aware(OneEventOneCharacter):
    """A demodulator that is told of gaps."""

    def __init__(self, parameters: Parameters) -> None:
        super().__init__(parameters)
        self.told: list[tuple[int, int]] = []

    def miss(self, start_ns: int, stop_ns: int) -> None:
        """Remember it."""
        self.told.append((start_ns, stop_ns))


class Lamp(OneEventOneCharacter):
    """A demodulator whose every character is ok and the same: for ever a candidate."""

    def push(self, t_ns: np.ndarray, polarity: np.ndarray, t_end_ns: int) -> list[Character]:
        """Read '\\x07', whatever comes."""
        return [
            Character(c.t_ns, 7, Status.OK, 1.0, 0b00001111111, RATE_BPS)
            for c in super().push(t_ns, polarity, t_end_ns)
        ]


@dataclass
class World:
    """Blobs that send an event a hop (OFF: wrong parity), and slots on the hop grid."""

    parameters: Parameters
    signs: dict[int, int]  # +1: a beacon, -1: no beacon, 0: silent
    make_demodulator: Callable[[Parameters], OneEventOneCharacter] = OneEventOneCharacter
    index: dict[int, float] = field(default_factory=dict)
    buffer_hops: int = 50
    hop: int = 0

    def __post_init__(self) -> None:
        self.slots = CandidateSlots(self.parameters, self.make_demodulator)
        self.tracks: dict[int, Track] = {}
        self.events: dict[int, list[tuple[int, int]]] = {}
        self.given: list[int] = []
        self.received: list[ReceivedCharacter] = []

    @property
    def t_ns(self) -> int:
        return T0_NS + self.hop * HOP_NS

    def backlog(self, track_id: int) -> tuple[np.ndarray, np.ndarray]:
        self.given.append(track_id)
        events = [e for e in self.events.get(track_id, []) if e[0] >= self.t_ns - self.buffer_hops * HOP_NS]
        return np.array([t for t, _ in events], np.int64), np.array([p for _, p in events], np.int8)

    def run(self, hops: int, pieces: int = 1) -> 'World':
        """Let time pass; each hop's events come in ``pieces`` batches."""
        for _ in range(hops):
            start, self.hop = self.t_ns, self.hop + 1
            fresh = {track_id: (start + 1000 + track_id, sign) for track_id, sign in self.signs.items() if sign}
            for track_id, event in fresh.items():
                self.events.setdefault(track_id, []).append(event)
            cuts = [start + HOP_NS * k // pieces for k in range(pieces + 1)]
            for early, late in zip(cuts, cuts[1:], strict=False):
                routed = {
                    track_id: Routed(np.array([t], np.int64), np.array([sign], np.int8))
                    for track_id, (t, sign) in fresh.items()
                    if early <= t < late
                }
                self.received += self.slots.demodulate(RoutedEvents.of(routed), late)
            for track_id, sign in self.signs.items():
                index = self.index.get(track_id, 1.0)
                track = self.tracks.setdefault(track_id, Track(track_id, 0, 0, self.t_ns, 3, index, self.t_ns, self.t_ns))
                track.quiet = sign == 0
            self.received += self.slots.assign(self.tracks, self.t_ns, self.backlog)
        return self

    def states(self) -> dict[int, BeaconState]:
        return {track_id: self.slots.state(track_id) for track_id in self.tracks}

    def text(self, track_id: int) -> list[int]:
        return [r.character.t_ns for r in self.received if r.track_id == track_id]


def parameters(slots: int, **others: object) -> Parameters:
    return Parameters(candidate_slots=slots, **others)


def test_the_highest_index_gets_the_slot_and_ties_go_by_label() -> None:
    world = World(parameters(2), dict.fromkeys(range(5), 1), index={0: 1.0, 1: 2.0, 2: 3.0, 3: 2.0, 4: 1.0}).run(1)
    assert world.given == [2, 1]
    assert world.states() == {0: WAITING, 1: DEMODULATING, 2: DEMODULATING, 3: WAITING, 4: WAITING}
    assert world.slots.slots_full


def test_slots_are_not_full_when_nobody_waits() -> None:
    world = World(parameters(2), {1: 1, 2: -1}).run(1)
    assert not world.slots.slots_full


def test_a_tentative_track_has_no_turn_yet_and_nobody_waits() -> None:
    world = World(parameters(2), {1: 1, 2: 1}, index={1: 2.0, 2: 1.0})
    world.tracks[1] = Track(1, 0, 0, T0_NS, 3, 2.0, T0_NS, T0_NS, tentative=True)
    assert world.run(1).given == [2] and not world.slots.slots_full
    world.tracks[1].tentative = False
    assert world.run(1).given == [2, 1]


def test_a_beacon_is_confirmed_and_keeps_its_slot() -> None:
    world = World(parameters(2), {1: 1}).run(16)
    assert world.states() == {1: CONFIRMED}
    assert world.slots.confirmed == (1,)
    assert world.slots.confirmed_at_ns(1) == T0_NS + 1001 + 15 * HOP_NS  # the end of the 15th character
    assert world.slots.bit_rate_bps(1) == RATE_BPS
    record = world.slots.record(1)
    assert record is not None and (record.characters, record.ok) == (16, 16)
    assert world.run(500).given == [1]


def test_the_demoted_wait_for_the_others() -> None:
    world = World(parameters(1), {1: -1, 2: -1}, index={1: 2.0, 2: 1.0}, buffer_hops=5).run(15)
    assert world.states() == {1: DEMOTED, 2: DEMODULATING}
    record = world.slots.record(1)
    assert record is not None and record.parity_errors == 15
    assert world.slots.bit_rate_bps(1) is None and world.slots.confirmed_at_ns(1) is None
    world.run(10)  # with the 5 of the backlog
    assert world.given == [1, 2, 1]
    assert world.states() == {1: DEMODULATING, 2: DEMOTED}


def test_a_backlog_may_decide_at_once_and_the_slot_is_free_at_the_next_hop() -> None:
    world = World(parameters(1), {1: -1, 2: -1}, index={1: 2.0, 2: 1.0}).run(15)
    assert (world.given, world.states()) == ([1, 2], {1: DEMOTED, 2: DEMOTED})
    assert world.run(1).given == [1, 2, 1]


def test_oldest_demotion_first() -> None:
    world = World(parameters(1), {1: -1, 2: -1, 3: -1}, buffer_hops=0).run(300)
    turns = world.given
    assert turns[:6] == [1, 2, 3, 1, 2, 3]


def test_a_demoted_track_is_tried_again_when_nobody_waits() -> None:
    world = World(parameters(1), {1: -1}).run(15)
    assert world.given == [1, 1] and world.states() == {1: DEMODULATING}
    world.signs[1] = 1  # it begins to send, 15 characters of it are enough
    world.run(31)
    assert world.states() == {1: CONFIRMED}


def test_nothing_is_read_twice() -> None:
    world = World(parameters(1), {1: -1, 2: -1, 3: -1}).run(400)
    for track_id in world.tracks:
        times = world.text(track_id)
        assert len(times) == len(set(times)) > 20 and times == sorted(times)


def test_a_slot_starts_from_the_backlog() -> None:
    world = World(parameters(1), {1: -1, 2: 1}, index={1: 2.0}).run(15)
    assert world.states() == {1: DEMOTED, 2: CONFIRMED}
    assert world.text(2) == [T0_NS + 1002 + k * HOP_NS for k in range(15)]


def test_a_quiet_track_keeps_its_slot_and_does_not_get_one() -> None:
    world = World(parameters(1), {1: -1, 2: 0}, index={2: 5.0}).run(5)
    assert world.given == [1]
    assert not world.slots.slots_full
    world.signs = {1: 0, 2: 0, 3: 1}
    world.run(1000)
    assert world.states() == {1: DEMODULATING, 2: WAITING, 3: WAITING}
    assert world.slots.slots_full


def test_a_starved_track_gives_up_its_slot() -> None:
    class Silent(OneEventOneCharacter):
        def push(self, t_ns: np.ndarray, polarity: np.ndarray, t_end_ns: int) -> list[Character]:
            return []

    world = World(parameters(1), {1: 1, 2: 1}, make_demodulator=Silent).run(201)
    assert world.states() == {1: DEMOTED, 2: DEMODULATING}


def test_confirmed_beacons_never_take_all_and_none_is_cut_off() -> None:
    """Three beacons for two slots, one of them reserved: all are read, and a newcomer still gets a slot."""
    world = World(parameters(2, reserved_candidate_slots=1), {1: 1, 2: 1, 3: 1}).run(60)
    assert world.states() == {1: CONFIRMED, 2: CONFIRMED, 3: CONFIRMED}
    for track_id in (1, 2, 3):
        assert len(world.text(track_id)) == 60
    world.signs |= {4: -1, 5: -1}
    world.run(1)
    assert [world.slots.state(track_id) for track_id in (4, 5)] == [DEMODULATING, WAITING]
    assert world.slots.slots_full


def test_a_slot_comes_back_when_a_confirmed_beacon_is_lost() -> None:
    world = World(parameters(2), {1: 1, 2: 1, 3: -1, 4: -1}, index={1: 3.0, 2: 2.0}).run(40)
    assert sorted(world.states().values()) == [DEMODULATING, CONFIRMED, CONFIRMED, DEMOTED]
    for track_id in (1, 2):
        del world.signs[track_id], world.tracks[track_id]
        world.slots.forget(track_id, world.t_ns)
    world.run(1)
    assert world.states() == {3: DEMODULATING, 4: DEMODULATING}


def test_forgetting_gives_the_last_characters() -> None:
    world = World(parameters(1), {1: 1}).run(3)
    t_ns = world.t_ns
    routed = {1: Routed(np.array([t_ns + 9_000_000], np.int64), np.array([1], np.int8))}
    assert world.slots.demodulate(RoutedEvents.of(routed), t_ns + 9_500_000) == []
    (last,) = world.slots.forget(1, t_ns)
    assert (last.track_id, last.character.t_ns) == (1, t_ns + 9_000_000)
    assert world.slots.state(1) is WAITING and world.slots.record(1) is None
    assert world.slots.forget(1, t_ns) == [] and world.slots.forget(99, t_ns) == []


def test_flush_gives_the_last_characters_of_all() -> None:
    world = World(parameters(2), {1: 1, 2: 1}).run(3)
    t_ns = world.t_ns + 9_000_000
    routed = {k: Routed(np.array([t_ns + k], np.int64), np.array([1], np.int8)) for k in (2, 1)}
    world.slots.demodulate(RoutedEvents.of(routed), t_ns + 100)
    assert [r.track_id for r in world.slots.flush()] == [1, 2]


def test_time_reaches_demodulators_without_events() -> None:
    world = World(parameters(1), {1: 1}).run(3)
    t_ns = world.t_ns
    routed = {1: Routed(np.array([t_ns], np.int64), np.array([1], np.int8))}
    world.slots.demodulate(RoutedEvents.of(routed), t_ns + 1)
    assert [r.character.t_ns for r in world.slots.demodulate(RoutedEvents.of({}), t_ns + 9_000_000)] == [t_ns]


def test_characters_held_until_a_rate_is_settled_are_judged_in_order() -> None:
    class Holding(OneEventOneCharacter):
        """Settles at the 40th character and gives all of them at once."""

        def __init__(self, parameters: Parameters) -> None:
            super().__init__(parameters)
            self.kept: list[Character] = []
            self.settled = False

        def push(self, t_ns: np.ndarray, polarity: np.ndarray, t_end_ns: int) -> list[Character]:
            self.kept += super().push(t_ns, polarity, t_end_ns)
            self.settled |= len(self.kept) >= 40
            given, self.kept = (self.kept, []) if self.settled else ([], self.kept)
            return given

    world = World(parameters(1), {1: 1}, make_demodulator=Holding).run(39)
    assert world.states() == {1: DEMODULATING}
    world.run(1)
    assert world.states() == {1: CONFIRMED}
    assert world.slots.confirmed_at_ns(1) == T0_NS + 1001 + 15 * HOP_NS


def test_a_turn_ends_only_when_others_wait() -> None:
    world = World(parameters(1), {1: -1}, make_demodulator=Lamp).run(200)
    assert world.given == [1]
    assert world.states() == {1: DEMODULATING}
    world.signs[2] = -1
    world.run(1)
    assert world.states() == {1: WAITING, 2: DEMODULATING}


def test_a_beacon_among_lamps_gets_a_slot_within_three_rounds_of_the_queue() -> None:
    """Two slots, six lamps that read as valid characters for ever, and a beacon of the lowest index."""

    def make(of: dict[int, type]) -> Callable[[Parameters], OneEventOneCharacter]:
        return lambda parameters: of[world.given[-1]](parameters)

    kinds: dict[int, type] = dict.fromkeys(range(1, 7), Lamp) | {9: OneEventOneCharacter}
    world = World(parameters(2), dict.fromkeys(range(1, 7), 1), index=dict.fromkeys(range(1, 7), 5.0))
    world.slots = CandidateSlots(world.parameters, make(kinds))
    world.run(300)
    world.signs[9] = 1
    turns_before = len(world.given)
    for _ in range(200):
        world.run(1)
        if world.slots.confirmed:
            break
    assert world.slots.confirmed == (9,)
    assert len(world.given) - turns_before <= 3 * 7
    assert world.given.index(9) - turns_before <= 2  # never tried goes first
    world.run(500)
    assert world.slots.confirmed == (9,)
    assert set(world.given[turns_before:]) == set(range(1, 7)) | {9}  # the lamps go on taking turns


@settings(max_examples=30, deadline=None)
@given(
    signs=st.lists(st.sampled_from([1, -1, -1, 0]), min_size=1, max_size=6),
    slots=st.integers(1, 3),
    pieces=st.integers(2, 9),
)
def test_any_batching_gives_the_same(signs: list[int], slots: int, pieces: int) -> None:
    whole, cut = (World(parameters(slots), dict(enumerate(signs))).run(90, n) for n in (1, pieces))
    assert whole.states() == cut.states()
    assert whole.given == cut.given
    assert sorted(whole.received, key=by_time) == sorted(cut.received, key=by_time)


def by_time(received: ReceivedCharacter) -> tuple[int, int]:
    return received.character.t_ns, received.track_id


def test_states_are_those_of_the_message() -> None:
    assert [(state.name, int(state)) for state in BeaconState] == [
        ('WAITING', 0),
        ('DEMODULATING', 1),
        ('CONFIRMED', 2),
        ('DEMOTED', 3),
        ('LOST', 4),
    ]


@pytest.mark.parametrize('reserved', [1, 2, 3])
def test_reserved_slots_are_always_there_for_candidates(reserved: int) -> None:
    world = World(parameters(3, reserved_candidate_slots=reserved), dict.fromkeys(range(8), 1)).run(100)
    assert len(world.slots.confirmed) == 8
    world.signs |= dict.fromkeys(range(20, 26), -1)
    world.run(1)
    assert list(world.states().values()).count(DEMODULATING) == reserved


def starts(world: World) -> list[int]:
    """Return the hops in which the received characters began."""
    return [(received.character.t_ns - T0_NS) // HOP_NS for received in world.received]


def test_what_overlaps_a_gap_is_erased_and_not_counted() -> None:
    """A character lies 1 µs behind its hop's beginning, one bit is a tenth of a hop."""
    world = World(Parameters(), {1: 1}).run(20)
    bit_ns = HOP_NS // 10
    world.slots.miss(world.t_ns + HOP_NS + bit_ns, world.t_ns + 3 * HOP_NS)  # into hop 21, to the end of 22
    world.run(10)
    # 23 begins within a bit behind the gap.
    assert starts(world) == [*range(21), *range(24, 30)]
    assert world.slots.record(1).characters == 27
    world.slots.miss(world.t_ns + HOP_NS + 2 * bit_ns, world.t_ns + 2 * HOP_NS - 2 * bit_ns)  # within hop 31
    world.run(5)
    assert starts(world)[-4:] == [30, 32, 33, 34]


def test_a_slot_that_is_given_later_hears_of_the_gaps_in_its_backlog() -> None:
    made: list[Aware] = []

    def make(parameters: Parameters) -> Aware:
        made.append(Aware(parameters))
        return made[-1]

    world = World(Parameters(candidate_slots=1), {1: 1}, make).run(15)
    world.signs[2] = 1
    gap = (world.t_ns + 3 * HOP_NS, world.t_ns + 4 * HOP_NS)
    world.run(3)
    world.slots.miss(*gap)
    world.run(7)
    assert [demodulator.told for demodulator in made] == [[gap], [gap]]
    of_second = [r.character.t_ns for r in world.received if r.track_id == 2]
    assert len(of_second) == 10 - 2 and not any(gap[0] <= t < gap[1] for t in of_second)


def test_a_new_time_has_no_gaps() -> None:
    world = World(Parameters(), {1: 1}).run(2)
    world.slots.miss(world.t_ns, world.t_ns + 3 * HOP_NS)
    world.slots.forget_gaps()
    world.run(5)
    assert starts(world) == list(range(7))
