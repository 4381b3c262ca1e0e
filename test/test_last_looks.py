"""Last looks at candidates that are lost: bounded, in their turn, and nothing that was read is lost by them."""

from collections.abc import Callable, Iterator

import numpy as np
import pytest
from line_events import text_bits
from sequence_lines import beacon_events

from beacon_comm.core.candidates import CandidateSlots, ReceivedCharacter
from beacon_comm.core.demodulator import make_demodulator
from beacon_comm.core.last_looks import LONGEST_WAIT_NS, MOST_LOAD, MOST_WAITING, LastLooks
from beacon_comm.core.parameters import Parameters
from beacon_comm.core.receiver import Output, Receiver, SignalReceiver
from beacon_comm.core.routing import Routed, RoutedEvents
from beacon_comm.core.tracks import Track
from beacon_comm.simulation.led import noise

NS = 1_000_000_000
HOP_NS = 10_000_000
PIECE_S = 0.0004
LOAD_OF_A_PIECE = PIECE_S / 0.01  # a hop


def last_looks() -> LastLooks[int]:
    return LastLooks(0.01)


def parts(*numbers: int, pieces: int = 1) -> Iterator[list[int] | float]:
    """Give numbers, and behind each of them look at so many pieces."""
    for number in numbers:
        yield [number]
        yield []
        yield from [PIECE_S] * pieces


def test_what_needs_no_look_is_given_at_once() -> None:
    looks = last_looks()
    assert looks.begin(1, iter([[1, 2], [], [3]]), 0) == [1, 2, 3]
    assert not looks.track_ids and looks.begin(1, iter([]), 0) == []


def test_a_look_is_worked_on_by_as_many_pieces_a_hop_as_the_load_allows() -> None:
    looks = last_looks()
    assert looks.begin(1, parts(1, 2, pieces=4), 0) == [1]
    given = [looks.work(2.0 * LOAD_OF_A_PIECE, k * HOP_NS) for k in range(6)]
    assert given == [[], [2], [], [], [], []]
    assert not looks.track_ids


def test_a_piece_that_takes_longer_is_paid_for_by_the_hops_that_follow() -> None:
    looks = last_looks()
    looks.begin(1, parts(1, 2, 3, pieces=1), 0)
    assert [looks.work(0.5 * LOAD_OF_A_PIECE, k * HOP_NS) for k in range(8)] == [[2], [], [3], [], [], [], [], []]


def test_no_load_is_so_great_that_a_hop_is_long() -> None:
    looks = last_looks()
    looks.begin(1, iter([PIECE_S] * 1000), 0)
    pieces = iter(range(1000))
    looks.begin(2, (PIECE_S for _ in pieces), 0)
    looks.finish(1)
    for k in range(10):
        looks.work(50.0, k * HOP_NS)
    assert next(pieces) == pytest.approx(1 + 10 * MOST_LOAD / LOAD_OF_A_PIECE, abs=2)


def test_one_is_looked_at_after_the_other_and_none_for_ever() -> None:
    looks = last_looks()
    for track_id in range(MOST_WAITING + 3):
        assert looks.begin(track_id, parts(track_id, 100 + track_id, pieces=3), 0) == [track_id]
    assert looks.passed_over == 3 and len(looks.track_ids) == MOST_WAITING
    assert looks.work(4.0 * LOAD_OF_A_PIECE, HOP_NS) == [100]
    assert list(looks.track_ids) == list(range(MOST_WAITING))
    given = [looks.work(4.0 * LOAD_OF_A_PIECE, LONGEST_WAIT_NS + k * HOP_NS) for k in range(1, 5)]
    assert given == [[], [], [], []] and not looks.track_ids  # the one that was begun has come to its end
    assert looks.passed_over == 3 + MOST_WAITING - 1


def test_the_end_brings_all_to_their_ends() -> None:
    looks = last_looks()
    for track_id in (5, 3, 4):
        looks.begin(track_id, parts(track_id, 10 * track_id, 11 * track_id), 0)
    assert looks.finish(3) == [30, 33]
    assert looks.finish(3) == looks.finish(99) == []
    assert looks.finish_all() == [50, 55, 40, 44]
    assert not looks.track_ids


class Lost:
    """Candidates on the hop grid: noise, and with the highest label a message that is over before the search looks."""

    text = 'Hello, pie'

    def __init__(self, noises: int, slots: int = 16, gap_at_ns: int | None = None) -> None:
        self.slots = CandidateSlots(Parameters(rate_search='blind', candidate_slots=slots), make_demodulator)
        t_ns, polarity = beacon_events(text_bits(self.text), 504.0)
        self.lost_ns = (int(t_ns[-1]) // HOP_NS + 1) * HOP_NS
        events = {k: noise(5000.0, self.lost_ns / NS, seed=k) for k in range(noises)}
        events[noises] = t_ns, polarity
        self.tracks = {k: Track(k, 10.0 * k, 10.0, 0, 4.0, 1.0, 0, 0) for k in events}
        self.received: list[ReceivedCharacter] = []
        for now_ns in range(0, self.lost_ns, HOP_NS):
            self.hop(now_ns)
            routed = {}
            for k, (times, signs) in events.items():
                part = slice(*np.searchsorted(times, (now_ns, now_ns + HOP_NS)))
                routed[k] = Routed(times[part], signs[part])
            if now_ns == gap_at_ns:
                self.slots.miss(now_ns, now_ns + 1000)
            self.received += self.slots.demodulate(RoutedEvents.of(routed), now_ns + HOP_NS)
        assert self.received == []

    def lose(self) -> 'Lost':
        """Lose all."""
        for k in list(self.tracks):
            del self.tracks[k]
            self.received += self.slots.forget(k, self.lost_ns)
        assert self.received == []
        return self

    def hop(self, now_ns: int) -> None:
        nothing = np.empty(0, np.int64), np.empty(0, np.int8)
        self.received += self.slots.assign(self.tracks, now_ns, lambda _: nothing)

    def read(self, track_id: int) -> str:
        return ''.join(chr(one.character.code) for one in self.received if one.track_id == track_id)


@pytest.mark.parametrize('noises', [0, 2, 12])
def test_a_short_message_is_read_a_little_after_its_track_was_lost(noises: int) -> None:
    lost = Lost(noises).lose()
    assert len(lost.slots.looked_back_at) == noises + 1
    for now_ns in range(lost.lost_ns, lost.lost_ns + LONGEST_WAIT_NS, HOP_NS):
        lost.hop(now_ns)
    assert lost.read(noises) == lost.text and not lost.slots.looked_back_at
    assert {lost.read(k) for k in range(noises)} <= {''}


def test_a_gap_is_remembered_until_then() -> None:
    lost = Lost(noises=12, gap_at_ns=60_000_000)
    for k in range(4):  # others come meanwhile
        lost.slots.miss(lost.lost_ns + k * NS, lost.lost_ns + k * NS + 1000)
    lost.lose()
    for now_ns in range(lost.lost_ns, lost.lost_ns + LONGEST_WAIT_NS, HOP_NS):
        lost.hop(now_ns)
    assert lost.read(12) == lost.text[:2] + lost.text[3:]  # without the one that the gap is in


def test_a_label_that_comes_back_has_all_it_said_before_it_says_more() -> None:
    lost = Lost(noises=0).lose()
    lost.tracks[0] = Track(0, 10.0, 10.0, lost.lost_ns, 4.0, 1.0, lost.lost_ns, 0)
    lost.hop(lost.lost_ns)
    assert lost.read(0) == lost.text and not lost.slots.looked_back_at


def test_the_streams_end_reads_what_still_waits() -> None:
    lost = Lost(noises=2).lose()
    lost.received += lost.slots.flush()
    assert lost.read(2) == lost.text and lost.slots.flush() == []


def test_a_restart_reads_all_that_it_loses_at_once() -> None:
    lost = Lost(noises=MOST_WAITING + 2, slots=MOST_WAITING + 3)
    lost.received += lost.slots.end()
    assert lost.read(MOST_WAITING + 2) == lost.text and not lost.slots.looked_back_at
    assert lost.slots.passed_over == 0


def short_message() -> tuple[np.ndarray, np.ndarray]:
    """Return the events of a message that is over before the blind search looks."""
    return beacon_events(text_bits(Lost.text), 504.0, tail_s=0.0)


@pytest.mark.parametrize('step_ns', [1_000_000, 10_000_000, 70_000_000, 5 * NS])
def test_a_receiver_reads_it_in_the_silence_that_follows_whatever_the_batches(step_ns: int) -> None:
    t_ns, polarity = short_message()
    given = []
    for step in (step_ns, 10_000_000):
        receiver, characters, lost_first = SignalReceiver(Parameters(rate_search='blind', lost_after_s=0.02)), [], False
        for now_ns in range(0, 5 * NS, step):
            part = slice(*np.searchsorted(t_ns, (now_ns, now_ns + step)))
            output = receiver.push_signal(t_ns[part], polarity[part], now_ns + step)
            characters += output.characters
            lost_first |= bool(output.lost) and not characters
        given.append(characters)
        assert ''.join(chr(one.character.code) for one in characters) == Lost.text
        assert lost_first == (step < NS)
        assert not receiver.track_ids and receiver.flush().characters == ()
    assert given[0] == given[1]


@pytest.mark.parametrize('restart', [Receiver.reset, lambda receiver: receiver.resize((1, 1))])
def test_a_receiver_that_is_restarted_reads_it_before(restart: Callable[[Receiver], Output]) -> None:
    t_ns, polarity = short_message()
    receiver = SignalReceiver(Parameters(rate_search='blind', lost_after_s=0.02))
    lost_ns = int(t_ns[-1]) // HOP_NS * HOP_NS + 4 * HOP_NS
    output = receiver.push_signal(t_ns, polarity, lost_ns)
    assert output.lost and output.characters == () and receiver.track_ids
    assert ''.join(chr(one.character.code) for one in restart(receiver).characters) == Lost.text
    assert not receiver.track_ids
