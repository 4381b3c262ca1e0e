"""Overload: what is shed, how far behind the node may fall, and that what was shed is erased and not invented."""

from __future__ import annotations

from collections import deque

import pytest
from live_session import BIT_RATE, MS, PACKET_NS, START_NS, TEXT, TYPE, Heard, Session, beacon_events, packets, spared

from beacon_comm.ros.overload import Shedder
from beacon_comm.ros.report import Report

MAX_LAG_NS = 50 * MS


def test_it_sheds_from_the_longest_wait_on_until_nearly_nothing_waits() -> None:
    shedder = Shedder(MAX_LAG_NS)
    waits_ms = [0, 49, 50, 51, 30, 6, 5, 30, 50, 51, 4, 50]
    assert [shedder.sheds(wait * MS) for wait in waits_ms] == [
        False, False, False, True, True, True, False, False, False, True, False, False
    ]  # fmt: skip
    assert not shedder.sheds(-5 * MS), 'the host clock was set back'


def test_what_reading_takes_is_part_of_the_lag() -> None:
    shedder = Shedder(MAX_LAG_NS)
    shedder.read(20 * MS)
    assert [shedder.sheds(wait * MS) for wait in (30, 31, 5)] == [False, True, False]
    for _ in range(500):
        shedder.read(MS)
    assert [shedder.sheds(wait * MS) for wait in (48, 50)] == [False, True]
    shedder.read(10 * MAX_LAG_NS)  # one takes longer than may be: still, what has just come is read
    assert [shedder.sheds(wait * MS) for wait in (6, 5)] == [True, False]


def test_who_has_waited_for_long_is_in_a_hurry_before_anything_is_shed() -> None:
    shedder = Shedder(MAX_LAG_NS)
    assert [shedder.hurries(wait * MS) for wait in (-5, 0, 15, 16, 49)] == [False, False, False, True, True]
    assert not shedder.sheds(16 * MS)


class Queue:
    """The node's queue and its one thread: a packet every ``PACKET_NS``, reading one takes a given time."""

    def __init__(self, session: Session) -> None:
        self._session = session
        self._shedder = Shedder(MAX_LAG_NS)
        self._waiting: deque[tuple[int, int, bytes]] = deque()
        self._arrival_ns = self._free_ns = session.now_ns
        self._count = 0
        self.shed: list[int] = []
        self.lags_ns: list[int] = []

    def send(self, stream: list[bytes], reading_ns: int) -> None:
        """Let packets arrive, each of which takes so long to read."""
        for message in stream:
            self._arrival_ns += PACKET_NS
            self._waiting.append((self._arrival_ns, self._count, message))
            self._count += 1
            while self._waiting and max(self._free_ns, self._waiting[0][0]) <= self._arrival_ns:
                self._take(reading_ns)

    def _take(self, reading_ns: int) -> None:
        arrival_ns, number, message = self._waiting.popleft()
        now_ns = max(self._free_ns, arrival_ns)
        self._session.now_ns = now_ns
        if self._shedder.sheds(now_ns - arrival_ns):
            self.shed.append(number)
            self._session.live.shed(now_ns)
            self._free_ns = now_ns + MS // 20
            return
        self.lags_ns.append(now_ns + reading_ns - arrival_ns)
        self._session.steps.append(self._session.live.push(message, now_ns))
        self._free_ns = now_ns + reading_ns
        self._shedder.read(reading_ns)


@pytest.mark.parametrize('receiver', ['threshold'])
def test_twice_the_load_is_shed_erased_and_survived(receiver: str) -> None:
    text = 8 * TEXT
    stream = packets(beacon_events(text))
    session = Session(receiver=receiver)
    queue = Queue(session)
    third = len(stream) // 3
    queue.send(stream[:third], PACKET_NS // 2)
    assert not queue.shed
    queue.send(stream[third : 2 * third], 2 * PACKET_NS)
    assert len(queue.shed) == pytest.approx(third / 2, rel=0.1)
    shed = len(queue.shed)
    queue.send(stream[2 * third :], PACKET_NS // 2)
    assert len(queue.shed) - shed < 20, 'only what had waited too long already'
    session.wait(0.2)

    assert max(queue.lags_ns) <= MAX_LAG_NS
    counts = session.live.counts
    assert counts['shed_packets'] == len(queue.shed) and counts['lost_packets'] == counts['restarts'] == 0
    assert counts['packets'] == len(stream)
    heard = Heard(session.characters(), text)
    assert heard.wrong_ok == []
    gaps = [(START_NS + k * PACKET_NS, START_NS + (k + 1) * PACKET_NS) for k in queue.shed]
    assert spared(gaps, len(text)) <= heard.right
    assert len(session.track_ids()) == 1


def test_the_report_tells_of_what_was_shed() -> None:
    session = Session()
    report = Report()
    session.live.shed(session.now_ns)
    report.shed()
    report.published(0.012)
    traffic, events, values = report.look(session.live, 0)
    assert (traffic.messages, traffic.shed, events) == (1, 1, 0)
    assert values['shed_packets'] == 1 and values['lag_s'] == '0.0120'


@pytest.mark.parametrize('late', ['shed', 'hurry'])
def test_who_is_late_searches_less_and_as_much_as_before_a_second_later(late: str) -> None:
    session = Session(bit_rates=(504.0, BIT_RATE))
    stream = packets(beacon_events(5 * TEXT))
    session.push(stream[:20])
    slots = session.live._receiver._slots  # type: ignore[union-attr]
    assert slots.search_share == 1.0
    if late == 'shed':
        session.live.shed(session.now_ns)
    else:
        session.live.hurry()
    session.push(stream[21:100])
    assert slots.search_share == 0.2
    session.push(stream[100:250])
    assert slots.search_share == 1.0
    session.live.shed(session.now_ns)
    session.live.open(TYPE, session.now_ns)  # another stream, whose time has nothing to do with this one's
    session.push(stream[:2])
    assert slots.search_share == 1.0
