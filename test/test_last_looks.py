"""Last looks at candidates that are lost: bounded, in their turn, and nothing that was read is lost by them."""

from collections.abc import Iterator

import numpy as np
from line_events import text_bits
from sequence_lines import beacon_events

from beacon_comm.core.candidates import CandidateSlots, ReceivedCharacter
from beacon_comm.core.demodulator import make_demodulator
from beacon_comm.core.last_looks import LONGEST_WAIT_NS, MOST_WAITING, PIECE_COST_S, SHARE, LastLooks
from beacon_comm.core.parameters import Parameters
from beacon_comm.core.routing import Routed, RoutedEvents
from beacon_comm.core.tracks import Track
from beacon_comm.simulation.led import noise

NS = 1_000_000_000
HOP_NS = 10_000_000
LOAD_OF_A_PIECE = PIECE_COST_S / 0.01 / SHARE  # a hop


def last_looks() -> LastLooks[int]:
    return LastLooks(0.01)


def parts(*numbers: int, pieces: int = 1) -> Iterator[list[int]]:
    """Give numbers, and behind each of them look at so many pieces."""
    for number in numbers:
        yield [number]
        yield from [[] for _ in range(pieces)]


def test_what_needs_no_look_is_given_at_once() -> None:
    looks = last_looks()
    assert looks.begin(1, iter([[1, 2], [3]]), 0) == [1, 2, 3]
    assert not looks


def test_a_look_is_worked_on_by_as_many_pieces_a_hop_as_the_load_allows() -> None:
    looks = last_looks()
    assert looks.begin(1, parts(1, 2, pieces=4), 0) == [1]
    given = [looks.work(2.0 * LOAD_OF_A_PIECE, k * HOP_NS) for k in range(6)]
    assert given == [[], [2], [], [], [], []]
    assert not looks


def test_half_a_piece_a_hop_is_one_every_other_hop() -> None:
    looks = last_looks()
    looks.begin(1, parts(1, 2, 3, pieces=1), 0)
    assert [looks.work(0.5 * LOAD_OF_A_PIECE, k * HOP_NS) for k in range(8)] == [[], [2], [], [], [], [3], [], []]


def test_one_is_looked_at_after_the_other_and_none_for_ever() -> None:
    looks = last_looks()
    for track_id in range(MOST_WAITING + 3):
        assert looks.begin(track_id, parts(track_id, 100 + track_id), 0) == [track_id]
    assert looks.work(4.0 * LOAD_OF_A_PIECE, HOP_NS) == [100, 101]
    assert looks.work(4.0 * LOAD_OF_A_PIECE, LONGEST_WAIT_NS + 1) == []
    assert not looks  # what waited for so long has been passed over, and so was what came when too many did


def test_the_end_brings_all_to_their_ends() -> None:
    looks = last_looks()
    for track_id in (5, 3, 4):
        looks.begin(track_id, parts(track_id, 10 * track_id, 11 * track_id), 0)
    assert looks.finish(3) == [30, 33]
    assert looks.finish(3) == looks.finish(99) == []
    assert looks.finish_all() == [50, 55, 40, 44]
    assert not looks


class Lost:
    """Candidates on the hop grid: noise, and with the highest label a message too short for the search; then all are lost."""

    text = 'Hello, pie'

    def __init__(self, noises: int) -> None:
        self.slots = CandidateSlots(Parameters(rate_search='blind'), make_demodulator)
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
            self.received += self.slots.demodulate(RoutedEvents.of(routed), now_ns + HOP_NS)
        for k in events:
            del self.tracks[k]
            self.received += self.slots.forget(k, self.lost_ns)

    def hop(self, now_ns: int) -> None:
        nothing = np.empty(0, np.int64), np.empty(0, np.int8)
        self.received += self.slots.assign(self.tracks, now_ns, lambda _: nothing)

    def read(self, track_id: int) -> str:
        return ''.join(chr(one.character.code) for one in self.received if one.track_id == track_id)


def test_a_short_message_is_read_a_little_after_its_track_was_lost() -> None:
    lost = Lost(noises=2)
    assert lost.received == [] and lost.slots.looking_back
    for now_ns in range(lost.lost_ns, lost.lost_ns + NS, HOP_NS):
        lost.hop(now_ns)
    assert lost.read(2) == lost.text and not lost.slots.looking_back
    assert lost.read(0) == lost.read(1) == ''


def test_a_label_that_comes_back_has_all_it_said_before_it_says_more() -> None:
    lost = Lost(noises=0)
    lost.tracks[0] = Track(0, 10.0, 10.0, lost.lost_ns, 4.0, 1.0, lost.lost_ns, 0)
    lost.hop(lost.lost_ns)
    assert lost.read(0) == lost.text and not lost.slots.looking_back


def test_the_streams_end_reads_what_still_waits() -> None:
    lost = Lost(noises=2)
    lost.received += lost.slots.flush()
    assert lost.read(2) == lost.text and lost.slots.flush() == []
