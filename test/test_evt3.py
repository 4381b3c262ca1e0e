"""EVT3: the compiled decoder against a plain loop, the encoder against the decoder, and time's odd ways."""

from __future__ import annotations

import sqlite3
from collections.abc import Iterator
from contextlib import closing
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from beacon_comm.core.events import EventBatch
from beacon_comm.wire import evt3, evt3_encoder
from beacon_comm.wire.cdr import Packet, parse_event_packet
from beacon_comm.wire.errors import WireError
from beacon_comm.wire.evt3 import Evt3Decoder
from beacon_comm.wire.evt3_encoder import Evt3Encoder
from beacon_comm.wire.reading import TALLY_KINDS, Continuity, Reading

WIDTH, HEIGHT = 640, 480
SECOND_HIGHS = 244


def high(value: int) -> int:
    return 0x8000 | value & 0xFFF


def low(value: int) -> int:
    return 0x6000 | value


def y(row: int) -> int:
    return row


def x(column: int, on: bool = True) -> int:
    return 0x2000 | on << 11 | column


def packet_of(words: list[int] | np.ndarray, width: int = WIDTH, height: int = HEIGHT) -> Packet:
    payload = np.asarray(words, '<u2').view(np.uint8)
    return Packet(0, 'camera', width, height, 0, 0, 'evt3', False, payload)


class Run:
    """A decoder with its tally."""

    def __init__(self) -> None:
        self.decoder = Evt3Decoder()
        self.tally = np.zeros(len(TALLY_KINDS), np.int64)

    def push(self, words: list[int], **continuity: int) -> Reading:
        return self.decoder.decode(packet_of(words), Continuity(**continuity), self.tally)

    def times_us(self, words: list[int], **continuity: int) -> list[int]:
        batch = self.push(words, **continuity).batch
        assert batch is not None
        return [t // 1000 for t in batch.t_ns.tolist()]

    @property
    def counts(self) -> dict[str, int]:
        return {kind: int(n) for kind, n in zip(TALLY_KINDS, self.tally, strict=True) if n}


@dataclass
class Reference:
    """The module head of wire/evt3.py as a plain loop: slow, and read in one go."""

    high_us: int | None = None
    low_us: int | None = None
    row: int | None = None
    base: int | None = None
    sign: int = 1
    latest_us: int = -1
    leapt_us: int = 0
    events: list[tuple[int, int, int, int]] = field(default_factory=list)
    counts: dict[str, int] = field(default_factory=lambda: dict.fromkeys(TALLY_KINDS, 0))

    def push(self, words: list[int], width: int, height: int) -> None:
        first, self.leapt_us = True, 0
        for word in words:
            code, value, coordinate = word >> 12, word & 0xFFF, word & 0x7FF
            sign = 1 if word & 0x800 else -1
            if code == 0:
                self.row = coordinate
            elif code == 2:
                self.event(coordinate, sign, width, height)
            elif code == 3:
                self.base, self.sign = coordinate, sign
            elif code in (4, 5):
                columns = 12 if code == 4 else 8
                for i in range(columns):
                    if word >> i & 1:
                        self.event(None if self.base is None else self.base + i, self.sign, width, height)
                if self.base is not None:
                    self.base += columns
            elif code == 6:
                if self.high_us is not None:
                    self.low_us = value
                    self.latest_us = max(self.latest_us, self.high_us + value)
            elif code == 8:
                self.time_high(value << 12, first)
                first = False
            elif code == 10:
                self.counts['triggers_1' if word & 1 else 'triggers_0'] += 1
            elif code not in (7, 14, 15):
                self.counts['skipped_words'] += 1

    def time_high(self, bits_us: int, first: bool) -> None:
        if self.high_us is None:
            self.high_us = bits_us
        elif bits_us != self.high_us % 2**24:
            turn = self.high_us // 2**24 * 2**24
            fall = self.high_us - (turn + bits_us)
            rise_across = fall + 2**24
            step_us = -fall % 2**24
            if not first and step_us >= 3 * 4096 and 2**24 - step_us > 1_000_000:
                if self.leapt_us + step_us > 2**24:
                    self.counts['skipped_words'] += 1
                    return
                self.leapt_us += step_us
            limit = 2**23 if first else 1_000_000
            if first and limit >= fall > 1_000_000:
                self.high_us, self.low_us, self.row, self.base, self.latest_us = bits_us, None, None, None, -1
                self.counts['undecoded_events'] += len(self.events)
                self.events.clear()
            elif fall > limit:
                self.high_us, self.low_us = turn + 2**24 + bits_us, 0 if self.low_us is not None else None
            elif rise_across <= 1_000_000:
                self.high_us, self.low_us = turn - 2**24 + bits_us, 0 if self.low_us is not None else None
            else:
                self.high_us, self.low_us = turn + bits_us, 0 if self.low_us is not None else None
        self.latest_us = max(self.latest_us, self.high_us + (self.low_us or 0))

    def event(self, column: int | None, sign: int, width: int, height: int) -> None:
        if self.high_us is None or self.low_us is None or self.row is None or column is None:
            self.counts['undecoded_events'] += 1
        elif column >= width or self.row >= height:
            self.counts['outside_events'] += 1
        else:
            self.counts['clamped_times'] += self.high_us + self.low_us < self.latest_us
            self.events.append((column, self.row, sign, self.latest_us * 1000))


def as_tuples(batch: EventBatch | None) -> list[tuple[int, int, int, int]]:
    if batch is None:
        return []
    columns = batch.x.tolist(), batch.y.tolist(), batch.polarity.tolist(), batch.t_ns.tolist()
    return list(zip(*columns, strict=True))


def recorded_packets(file: Path) -> Iterator[Packet]:
    with closing(sqlite3.connect(f'file:{file}?mode=ro&immutable=1', uri=True)) as bag:
        for (cdr,) in bag.execute('select data from messages order by id'):
            yield parse_event_packet(cdr)


def check_against_reference(packets: list[Packet]) -> tuple[Run, list[EventBatch]]:
    run, reference, batches = Run(), Reference(), []
    for packet in packets:
        reference.events.clear()
        reference.push(packet.payload.view('<u2').tolist(), packet.width, packet.height)
        batch = run.decoder.decode(packet, Continuity(), run.tally).batch
        assert as_tuples(batch) == reference.events
        assert (batch.t_end_ns // 1000 if batch is not None else -1) == reference.latest_us
        assert dict(zip(TALLY_KINDS, run.tally.tolist(), strict=True)) == reference.counts
        if batch is not None:
            batches.append(batch)
    return run, batches


# Real recordings


def test_static_scene_event_for_event(data_folder: Path) -> None:
    packets = list(recorded_packets(data_folder / 'evt3_static' / 'test_events_1.db3'))
    run, batches = check_against_reference(packets)
    polarity = np.concatenate([batch.polarity for batch in batches])
    assert len(polarity) == 343_474
    assert ((polarity > 0).sum(), (polarity < 0).sum()) == (125_183, 218_291)
    # Nothing is dropped, clamped or unknown; the recording's truth calls the edges with bit 0 the rising ones.
    assert run.counts == {'triggers_0': 2078, 'triggers_1': 2079}


def test_high_resolution_scene(data_folder: Path) -> None:
    packets = list(recorded_packets(data_folder / 'evt3_trigger_hd' / 'test_data_evt3_trigger_0.db3'))
    run, batches = check_against_reference(packets)
    assert sum(map(len, batches)) == 82_469
    assert run.counts == {'triggers_0': 1, 'triggers_1': 1}
    # Sums of t, x, y that the recording's makers publish with it.
    assert sum(int(batch.t_ns.sum()) for batch in batches) == 1_222_326_831_810_000
    assert sum(int(batch.x.sum(dtype=np.int64)) for batch in batches) == 42_078_718
    assert sum(int(batch.y.sum(dtype=np.int64)) for batch in batches) == 31_656_267


def test_words_that_leap_again_and_again_are_no_hours_of_the_stream() -> None:
    run = Run()
    leaps = [word for k in range(1, 200) for word in (high(k * 244 % 4096), low(0), y(3), x(5, True))]
    batch = run.push([high(0), low(0), *leaps]).batch
    assert 15e9 < batch.t_end_ns < 17e9
    assert run.counts['skipped_words'] > 100 and len(batch) == 199
    assert run.push([high(5), low(0), y(3), x(5, True)]).batch.t_end_ns < 34e9  # and the next packet goes on


# Random words

word = st.one_of(
    st.integers(0, 0xFFFF),
    st.integers(0, 5).map(high),
    st.sampled_from([4095, 4090, 3000, 2048, 1000]).map(high),
    st.integers(0, 0xFFF).map(low),
    st.integers(0, HEIGHT + 2).map(y),
    st.builds(x, st.integers(0, WIDTH + 5), st.booleans()),
    st.integers(0, 0xFFF).map(lambda v: 0x3000 | v),
    st.integers(0, 0xFFF).map(lambda v: 0x4000 | v),
    st.integers(0, 0xFFF).map(lambda v: 0x5000 | v),
)


@settings(max_examples=300, deadline=None)
@given(st.lists(st.lists(word, max_size=40), max_size=6))
def test_random_words_decode_as_the_reference_does(packets: list[list[int]]) -> None:
    _, batches = check_against_reference([packet_of(words) for words in packets])
    for batch in batches:
        assert (np.diff(batch.t_ns) >= 0).all()
        assert len(batch) == 0 or batch.t_ns[-1] <= batch.t_end_ns


@settings(max_examples=60, deadline=None)
@given(st.lists(word, max_size=60))
def test_no_write_behind_the_columns(words: list[int]) -> None:
    array = np.asarray(words, np.uint16)
    array.flags.writeable = False
    decoder = Evt3Decoder()
    decoder._state[evt3._HIGH_US] = decoder._state[evt3._ROW] = decoder._state[evt3._BASE] = 0
    decoder._state[evt3._TIMED] = evt3._ALL_BITS
    capacity = evt3._capacity(array)
    columns = [np.empty(capacity, kind) for kind in (np.uint16, np.uint16, np.int8, np.int64)]
    guarded = [np.full(capacity + 64, 77, column.dtype) for column in columns]
    inside = [column[:capacity] for column in guarded]
    n = evt3._decode(array, 2048, 2048, decoder._state, decoder._link, *inside, np.zeros(6, np.int64))
    assert n <= capacity
    assert all((column[capacity:] == 77).all() for column in guarded)


# Starting in mid-stream


def test_nothing_before_time_and_row() -> None:
    run = Run()
    assert run.push([y(3), x(1), low(5), x(2)]).batch is None
    assert run.push([high(2), x(3)]).batch.t_end_ns == 8192 * 1000  # a lower bound of what follows
    batch = run.push([low(7), x(3), y(4), x(5, False)]).batch
    assert as_tuples(batch) == [(3, 3, 1, 8_199_000), (5, 4, -1, 8_199_000)]
    assert run.counts == {'undecoded_events': 3}


def test_pixels_wait_for_their_row_and_vectors_for_their_base() -> None:
    run = Run()
    batch = run.push([high(0), low(0), x(1), 0x4003, y(9), 0x5003, 0x3000 | 0x800 | 20, 0x4801, 0x5081]).batch
    assert [event[:3] for event in as_tuples(batch)] == [(20, 9, 1), (31, 9, 1), (32, 9, 1), (39, 9, 1)]
    assert run.counts == {'undecoded_events': 5}


def test_state_lasts_from_packet_to_packet() -> None:
    run = Run()
    run.push([high(1), low(2), y(5), 0x3000 | 8])
    assert as_tuples(run.push([x(6), 0x4001]).batch) == [(6, 5, 1, 4_098_000), (8, 5, -1, 4_098_000)]
    assert as_tuples(run.push([0x4001]).batch) == [(20, 5, -1, 4_098_000)]


def test_missing_packets_need_a_new_start_and_keep_the_unwrapped_time() -> None:
    run = Run()
    run.push([high(4095), low(0), y(5), x(1)])
    run.push([high(0), low(0), x(2)])
    batch = run.push([x(3), y(1), low(4), x(3), high(1), x(4), low(3), x(5)], packets_missing=True).batch
    assert as_tuples(batch) == [(5, 1, 1, (2**24 + 4096 + 3) * 1000)]
    assert run.push([x(6)], packets_missing=True).batch.t_end_ns == batch.t_end_ns
    # The row is of before the gap.
    assert as_tuples(run.push([high(1), low(9), x(7)], packets_missing=True).batch) == []


# Time


def test_time_high_alone_moves_time_on() -> None:
    run = Run()
    run.push([high(1), low(100)])
    assert run.push([high(1)]).batch.t_end_ns == 4_196_000
    assert run.push([high(3)]).batch.t_end_ns == 3 * 4_096_000


def test_wraps_add_up() -> None:
    run = Run()
    starts = [high(value) for value in (0, 1000, 2000, 3000, 4000)]
    for turn in range(5):
        for place, time_high in enumerate(starts):
            (t_us,) = run.times_us([time_high, low(1), y(0), x(0)])
            assert t_us == turn * 2**24 + place * 1000 * 4096 + 1
    assert run.counts == {}


def test_a_late_time_high_is_clamped_and_jumps_nowhere() -> None:
    run = Run()
    words = [high(8), low(4000), y(0), x(0), high(9), low(10), x(1), high(8), low(4090), x(2), high(9), low(20), x(3)]
    top = 9 * 4096
    assert run.times_us(words) == [8 * 4096 + 4000, top + 10, top + 10, top + 20]
    assert run.counts == {'clamped_times': 1}


def test_an_early_time_high_does_not_carry_the_lower_bits_ahead() -> None:
    run = Run()
    words = [high(8), low(4090), y(0), x(0), high(9), x(1), high(8), low(4092), x(2), high(9), low(1), x(3)]
    top = 9 * 4096
    assert run.times_us(words) == [8 * 4096 + 4090, top, top, top + 1]


@pytest.mark.parametrize('split', [False, True])
def test_a_step_back_across_the_wrap(split: bool) -> None:
    run = Run()
    first = [high(4095), low(0), y(0), x(0), high(0), low(5), x(1)]
    then = [high(4095), low(4095), x(2), high(0), low(9), x(3), high(1), low(0), x(4)]
    times = run.times_us(first) + run.times_us(then) if split else run.times_us(first + then)
    top = 2**24
    assert times == [4095 * 4096, top + 5, top + 5, top + 9, top + 4096]


@pytest.mark.parametrize('silence_s', [1.5, 8.0, 12.0, 16.0, 16.7])
@pytest.mark.parametrize('start_high', [0, 1000, 4000])
def test_silence_shorter_than_a_wrap(silence_s: float, start_high: int) -> None:
    run = Run()
    silence = int(silence_s * 1e6) >> 12
    run.push([high(start_high), low(0)])
    (t_us,) = run.times_us([high(start_high + silence), low(0), y(0), x(0)], elapsed_ns=int(silence_s * 1e9))
    assert t_us == (start_high + silence) * 4096


def test_a_restart_is_told_from_a_wrap_by_host_time() -> None:
    run = Run()
    run.push([high(12 * SECOND_HIGHS), low(0), y(0), x(0)])
    reading = run.push([x(9), high(1), low(2), x(1), y(3), x(4)], elapsed_ns=500_000_000)
    assert reading.restarted
    assert as_tuples(reading.batch) == [(4, 3, 1, 4_098_000)]
    assert reading.batch.t_end_ns == 4_098_000
    assert not run.push([high(1), low(3)], elapsed_ns=1_000_000).restarted


@pytest.mark.parametrize(('back_s', 'restarted'), [(0.5, False), (0.99, False), (1.2, True), (7.0, True)])
def test_steps_back_without_host_time(back_s: float, restarted: bool) -> None:
    run = Run()
    start = 10 * SECOND_HIGHS
    run.push([high(start), low(0), y(0), x(0)])
    reading = run.push([high(start - int(back_s * SECOND_HIGHS)), low(0), y(0), x(0)])
    assert reading.restarted is restarted
    assert (run.counts.get('clamped_times', 0) == 1) is not restarted


def test_a_recording_from_its_start_again() -> None:
    run = Run()
    run.push([high(1000), low(0), y(0), x(0)])
    reading = run.push([high(900), low(0), y(0), x(0)], elapsed_ns=-410_000_000, seq_fell=1)
    assert reading.restarted


def test_coordinates_outside_the_sensor_are_counted() -> None:
    run = Run()
    batch = run.push([high(0), low(0), y(479), x(639), x(640), y(480), x(0), y(0), 0x3000 | 636, 0x40FF]).batch
    assert [event[0] for event in as_tuples(batch)] == [639, 636, 637, 638, 639]
    assert run.counts == {'outside_events': 6}


def test_unknown_words_are_counted_and_known_ones_without_pixels_are_not() -> None:
    run = Run()
    run.push([0x9000, 0x1000, high(0), low(0), 0xB000, 0xC000, 0xD000, 0x9FFF, 0xE014, 0x7000, 0xF000])
    assert run.counts == {'skipped_words': 6}


# Encoder

events = st.lists(
    st.tuples(
        st.one_of(st.integers(0, 3), st.integers(0, 20_000), st.integers(0, 40_000_000)),  # time step (µs)
        st.integers(0, WIDTH - 1),
        st.one_of(st.integers(0, 2), st.integers(0, HEIGHT - 1)),
        st.sampled_from([-1, 1]),
        st.integers(1, 15),  # repeated in columns to the right
    ),
    max_size=20,
)
tails_us = st.one_of(st.just(0), st.integers(0, 30_000_000))


def batch_of(drawn: list[tuple[int, int, int, int, int]], start_us: int, tail_us: int) -> EventBatch:
    rows, t_us = [], start_us
    for step_us, column, row, polarity, repeats in drawn:
        t_us += step_us
        rows += [(column + i, row, polarity, t_us * 1000) for i in range(repeats) if column + i < WIDTH]
    columns = [np.array([row[i] for row in rows], kind) for i, kind in enumerate(['u2', 'u2', 'i1', 'i8'])]
    return EventBatch(*columns, (t_us + tail_us) * 1000)


@settings(max_examples=200, deadline=None)
@given(st.lists(st.tuples(events, tails_us), max_size=4), st.integers(0, 2**41))
def test_encoded_batches_come_back(drawn: list[tuple[list, int]], start_us: int) -> None:
    encoder, run = Evt3Encoder(WIDTH, HEIGHT), Run()
    turns_ns: int | None = None
    now_us = start_us
    for rows, tail_us in drawn:
        batch = batch_of(rows, now_us, tail_us)
        now_us = batch.t_end_ns // 1000
        if turns_ns is None:
            # 24 bits cannot tell what came before the first word.
            first_us = int(batch.t_ns[0]) // 1000 if len(batch) else now_us
            turns_ns = (first_us >> 24 << 24) * 1000
        words = np.frombuffer(encoder.encode(batch), '<u2')
        assert words[0] >> 12 == 8 and words[1] >> 12 == 6
        decoded = run.push(words.tolist()).batch
        assert as_tuples(decoded) == [(*event[:3], event[3] - turns_ns) for event in as_tuples(batch)]
        assert decoded.t_end_ns == batch.t_end_ns - turns_ns
    assert run.counts == {}


def test_a_packet_can_be_read_from_its_own_start() -> None:
    encoder = Evt3Encoder(WIDTH, HEIGHT)
    encoder.encode(batch_of([(0, 5, 7, 1, 1)], 1000, 0))
    second = np.frombuffer(encoder.encode(batch_of([(0, 6, 7, 1, 1), (9, 6, 7, 1, 1)], 2000, 0)), '<u2')
    assert [event[0] for event in as_tuples(Run().push(second.tolist()).batch)] == [6, 6]


def test_runs_become_vectors_and_times_are_cut_to_microseconds() -> None:
    batch = batch_of([(0, 10, 7, 1, 12)], 5, 0)
    payload = Evt3Encoder(WIDTH, HEIGHT).encode(
        EventBatch(batch.x, batch.y, batch.polarity, batch.t_ns + 999, batch.t_end_ns + 999)
    )
    assert np.frombuffer(payload, '<u2').tolist() == [0x8000, 0x6005, 7, 0x3000 | 0x800 | 10, 0x4FFF]


def test_encoder_refuses_what_it_cannot_hold() -> None:
    with pytest.raises(WireError, match='4096 x 100 px'):
        Evt3Encoder(4096, 100)
    encoder = Evt3Encoder(WIDTH, HEIGHT)
    with pytest.raises(WireError, match='outside the 640 x 480 px sensor'):
        encoder.encode(batch_of([(0, 10, 480, 1, 1)], 0, 0))
    encoder.encode(EventBatch.empty(5_000_000))
    with pytest.raises(WireError, match='in order, from 5000 µs on'):
        encoder.encode(batch_of([(0, 10, 4, 1, 1)], 4999, 100))
    with pytest.raises(WireError, match='200000 s in one payload'):
        encoder.encode(EventBatch.empty(200_000 * 10**9 + 5_000_000))


def test_each_loop_is_compiled_once() -> None:
    assert len(evt3._decode.signatures) <= 1
    assert len(evt3_encoder._encode.signatures) <= 1
