"""One topic's messages: what is counted, refused, and carried from message to message; no bytes make it raise."""

from __future__ import annotations

import sqlite3
import struct
from collections.abc import Callable
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from beacon_comm.core.events import EventBatch
from beacon_comm.wire.cdr import build_event_array, build_event_packet
from beacon_comm.wire.errors import WireError
from beacon_comm.wire.evt3_encoder import Evt3Encoder
from beacon_comm.wire.stream import COUNTS, MOST_LATE, PACKET_TYPES, SUPPORTED_TYPES, EventStream, is_event_array_type

PACKET, FORMER_PACKET = PACKET_TYPES
ARRAY = 'dvs_msgs/msg/EventArray'
SECOND = 1_000_000_000


def evt3(*words: int) -> bytes:
    return struct.pack(f'<{len(words)}H', *words)


def high(t_s: float) -> int:
    return 0x8000 | int(t_s * 1e6) >> 12 & 0xFFF


PIXEL = (0x6000, 5, 0x2800 | 7)


def packet(payload: bytes, seq: int = 0, stamp_ns: int = 0, **other: object) -> bytes:
    values = {'frame_id': 'cam', 'width': 640, 'height': 480, 'time_base_ns': 0, 'encoding': 'evt3'} | other
    return build_event_packet(stamp_ns, seq=seq, payload=payload, **values)


def noticed(stream: EventStream) -> dict[str, int]:
    assert stream.counts.keys() == COUNTS.keys()
    return {kind: n for kind, n in stream.counts.items() if n and kind not in ('packets', 'events')}


def test_types() -> None:
    assert [is_event_array_type(name) for name in SUPPORTED_TYPES] == [False, False, True, True, True]
    assert is_event_array_type('my_msgs/msg/EventArray')
    with pytest.raises(WireError, match='sensor_msgs/msg/Image: not one of event_camera_msgs'):
        EventStream('sensor_msgs/msg/Image')


def test_a_packet() -> None:
    decoded = EventStream(PACKET).push(packet(evt3(high(1), *PIXEL), 3, 17))
    batch = decoded.batch
    assert (batch.x.tolist(), batch.y.tolist(), batch.polarity.tolist()) == ([7], [5], [1])
    assert (batch.x.dtype, batch.polarity.dtype, batch.t_ns.dtype) == (np.uint16, np.int8, np.int64)
    assert decoded.first_event_ns == batch.t_ns[0] == batch.t_end_ns == (1_000_000 >> 12 << 12) * 1000
    assert (decoded.stamp_ns, decoded.frame_id, decoded.width, decoded.height) == (17, 'cam', 640, 480)
    assert not decoded.restarted and not decoded.resized and decoded.lost_packets == 0 and decoded.problem is None


def test_a_packet_without_events_moves_time_on() -> None:
    stream = EventStream(PACKET)
    assert stream.push(packet(b'')).batch is None
    stream.push(packet(evt3(high(1), 0x6000), 1))
    decoded = stream.push(packet(evt3(high(2), 0x6000), 2))
    assert (len(decoded.batch), decoded.first_event_ns) == (0, None)
    assert decoded.batch.t_end_ns == (2_000_000 >> 12 << 12) * 1000
    assert stream.push(packet(b'', 3)).batch.t_end_ns == decoded.batch.t_end_ns
    assert noticed(stream) == {'empty_packets': 2}


def test_lost_packets() -> None:
    stream = EventStream(PACKET)
    assert stream.push(packet(evt3(high(1), *PIXEL), 10)).lost_packets == 0
    decoded = stream.push(packet(evt3(0x2001, 0x6001, 0x2002), 14))
    assert (decoded.lost_packets, len(decoded.batch)) == (3, 0)
    assert len(stream.push(packet(evt3(0x2001), 15)).batch) == 0
    assert len(stream.push(packet(evt3(high(1.1), *PIXEL), 16)).batch) == 1
    assert noticed(stream) == {'lost_packets': 3, 'undecoded_events': 3}


def nth(n: int) -> bytes:
    """Return packet n of a stream of one event in 10 ms."""
    return packet(evt3(high(1 + n / 100), *PIXEL), n, SECOND + n * 10_000_000)


def test_what_is_missing_reaches_up_to_the_next_event() -> None:
    stream = EventStream(PACKET)
    assert stream.push(nth(1)).batch.missing_until_ns is None
    empty = packet(evt3(high(1.05), 0x6000), 5, SECOND + 50_000_000)
    decoded = stream.push(empty)
    assert (decoded.lost_packets, decoded.batch.missing_until_ns) == (3, decoded.batch.t_end_ns)
    decoded = stream.push(nth(6))
    assert decoded.batch.missing_until_ns == decoded.first_event_ns
    assert stream.push(nth(7)).batch.missing_until_ns is None


def test_what_is_shed_is_missing_and_not_lost() -> None:
    stream = EventStream(PACKET)
    stream.push(nth(1))
    stream.shed()
    stream.shed()
    decoded = stream.push(nth(5))
    assert decoded.batch.missing_until_ns == decoded.first_event_ns
    assert noticed(stream) == {'lost_packets': 1, 'shed_packets': 2}
    assert stream.counts['packets'] == 4


def test_an_array_has_no_seq_and_is_told_of_losses() -> None:
    stream = EventStream(ARRAY)
    columns = [np.array(column) for column in ([1, 2], [3, 4], [1, -1], [2**40, 2**40 + 5])]
    later = [*columns[:3], columns[3] + 1000]
    assert stream.push(build_event_array(9, 'cam', 346, 260, *columns)).batch.missing_until_ns is None
    stream.lost()
    assert stream.push(build_event_array(9, 'cam', 346, 260, *later)).batch.missing_until_ns == 2**40 + 1000
    stream.shed()
    assert stream.push(build_event_array(9, 'cam', 346, 260, *later)).batch.missing_until_ns is not None
    stream.push(build_event_array(9, 'cam', 0, 260, *later))  # what cannot be read is missing, too
    assert stream.push(build_event_array(9, 'cam', 346, 260, *later)).batch.missing_until_ns is not None
    stream.push(build_event_array(9, 'another', 346, 260, *later))
    assert stream.push(build_event_array(9, 'cam', 346, 260, *later)).batch.missing_until_ns is None
    packets = EventStream(PACKET)
    packets.push(nth(1))
    packets.lost()
    assert packets.push(nth(2)).batch.missing_until_ns is None


@pytest.mark.parametrize('name', ['frame_id', 'encoding'])
def test_no_text_fills_the_log(name: str) -> None:
    decoded = EventStream(PACKET).push(packet(b'', **{name: 'a' * 1_000_000}))
    assert decoded.problem == f'{name} of 1000001 bytes: 256 at most'
    assert decoded.problem_kind == 'bad_messages' and decoded.frame_id == ''


def test_a_packet_that_comes_twice_is_read_once() -> None:
    stream = EventStream(PACKET)
    for n in (1, 2, 2, 3):
        stream.push(nth(n))
    assert (noticed(stream), stream.counts['events']) == ({'repeated_packets': 1}, 3)
    often = EventStream(PACKET)
    for n in (1, 2, 2, 2, 2, 2, 3):
        often.push(nth(n))
    assert (noticed(often), often.counts['events']) == ({'repeated_packets': 4}, 3)
    # A driver that numbers nothing and stamps nothing repeats nothing.
    silent = EventStream(PACKET)
    for n in range(5):
        silent.push(packet(evt3(high(1), 0x6000 | n, 5, 0x2800 | 7)))
    assert (noticed(silent), silent.counts['events']) == ({}, 5)


def test_an_overtaken_packet_is_passed_over_and_no_restart() -> None:
    stream = EventStream(PACKET)
    decoded = [stream.push(nth(n)) for n in (1, 2, 4, 3, 5)]
    assert [d.batch is None for d in decoded] == [False, False, False, True, False]
    assert decoded[3].problem is None and decoded[4].lost_packets == 0
    assert noticed(stream) == {'lost_packets': 1, 'overtaken_packets': 1}


def test_a_short_recording_played_again_is_noticed_by_its_third_packet() -> None:
    stream = EventStream(PACKET)
    for n in range(5):
        stream.push(nth(n))
    again = [stream.push(nth(n)) for n in range(5)]
    assert [decoded.restarted for decoded in again] == [False, False, True, False, False]
    assert stream.counts['overtaken_packets'] == 2


def test_unwrapping_survives_a_gap() -> None:
    stream = EventStream(PACKET)
    stream.push(packet(evt3(high(16), *PIXEL), 1, 100 * SECOND))
    decoded = stream.push(packet(evt3(high(9), *PIXEL), 1000, 100 * SECOND + int(9.777 * SECOND)))
    assert not decoded.restarted
    assert abs(decoded.first_event_ns - 25.777 * SECOND) < 10_000_000


def test_restart() -> None:
    stream = EventStream(PACKET)
    stream.push(packet(evt3(high(9), *PIXEL), 1, 100 * SECOND))
    decoded = stream.push(packet(evt3(high(0.5), *PIXEL), 2, 101 * SECOND))
    assert decoded.restarted
    assert decoded.first_event_ns < SECOND
    assert not stream.push(packet(evt3(high(0.6), *PIXEL), 3, 101 * SECOND)).restarted
    assert noticed(stream) == {'restarts': 1}


def test_resize() -> None:
    stream = EventStream(PACKET)
    stream.push(packet(evt3(high(1), *PIXEL), 1))
    decoded = stream.push(packet(evt3(0x2000 | 1200), 2, width=1280, height=720))
    assert decoded.resized
    assert (decoded.width, decoded.height, decoded.batch.x.tolist()) == (1280, 720, [1200])
    assert not stream.push(packet(b'', 3, width=1280, height=720)).resized
    assert noticed(stream) == {'resizes': 1, 'empty_packets': 1}


def test_a_second_camera_is_refused_by_name() -> None:
    stream = EventStream(PACKET)
    stream.push(packet(evt3(high(1), *PIXEL), 1))
    decoded = stream.push(packet(evt3(high(9), *PIXEL), 77, frame_id='other', width=1280))
    assert decoded.batch is None
    assert (decoded.problem, decoded.problem_kind) == ("second camera 'other' on the topic of 'cam'", 'refused_frames')
    decoded = stream.push(packet(evt3(high(1), *PIXEL), 2))
    assert (decoded.lost_packets, decoded.resized, decoded.problem) == (0, False, None)
    assert noticed(stream) == {'refused_frames': 1}


@pytest.mark.parametrize(
    ('cdr', 'kind', 'text'),
    [
        (b'', 'bad_messages', '0 bytes'),
        (packet(b'1234')[:-1], 'bad_messages', 'events ends at byte'),
        (packet(b'', time_base_ns=2**63), 'bad_messages', 'time_base'),
        (packet(b'', encoding='evt2'), 'unknown_encodings', "'evt2': known are evt3, libcaer_cmp, libcaer, mono"),
        (packet(b'', width=0), 'bad_sizes', '0 x 480 px'),
        (packet(b'', height=2**32 - 1), 'bad_sizes', '640 x 4294967295 px'),
        (packet(b'').replace(b'evt3\0\0', b'evt3\0\1'), 'big_endian_payloads', 'evt3'),
    ],
)
def test_what_cannot_be_read_is_counted_and_named(cdr: bytes, kind: str, text: str) -> None:
    stream = EventStream(PACKET)
    decoded = stream.push(cdr)
    assert decoded.batch is None
    assert text in decoded.problem
    assert decoded.problem_kind == kind
    assert noticed(stream) == {kind: 1}
    # It leaves nothing behind.
    assert len(stream.push(packet(evt3(high(1), *PIXEL), 9, frame_id='any')).batch) == 1


def test_an_odd_byte_is_counted_and_the_rest_read() -> None:
    stream = EventStream(PACKET)
    assert len(stream.push(packet(evt3(high(1), *PIXEL) + b'x')).batch) == 1
    assert noticed(stream) == {'odd_bytes': 1}


def test_another_encoding_is_another_clock() -> None:
    stream = EventStream(PACKET)
    stream.push(packet(evt3(high(1), *PIXEL), 1))
    decoded = stream.push(packet(struct.pack('<Q', 5), 2, encoding='mono', time_base_ns=2**40))
    assert decoded.restarted
    assert decoded.first_event_ns == 2**40 + 5


def test_an_event_array() -> None:
    stream = EventStream(ARRAY)
    columns = [np.array(column) for column in ([1, 2], [3, 4], [1, -1], [2**40, 2**40 + 5])]
    decoded = stream.push(build_event_array(9, 'cam', 346, 260, *columns))
    assert [getattr(decoded.batch, name).tolist() for name in ('x', 'y', 'polarity', 't_ns')] == [
        column.tolist() for column in columns
    ]
    assert (decoded.stamp_ns, decoded.first_event_ns, decoded.batch.t_end_ns) == (9, 2**40, 2**40 + 5)
    assert stream.push(build_event_array(9, 'two', 346, 260, *columns)).problem_kind == 'refused_frames'


def recorded(file: Path) -> list[bytes]:
    with closing(sqlite3.connect(f'file:{file}?mode=ro&immutable=1', uri=True)) as bag:
        return [cdr for (cdr,) in bag.execute('select data from messages order by id')]


@pytest.mark.parametrize(
    ('file', 'message_type', 'events'),
    [
        ('evt3_static/test_events_1.db3', PACKET, 343_474),
        ('evt3_trigger_hd/test_data_evt3_trigger_0.db3', PACKET, 82_469),
        ('mono_legacy/test_data_mono_cd_0.db3', FORMER_PACKET, 100),
    ],
)
def test_recordings(data_folder: Path, file: str, message_type: str, events: int) -> None:
    stream, messages = EventStream(message_type), recorded(data_folder / file)
    ends = [stream.push(cdr).batch.t_end_ns for cdr in messages]
    assert ends == sorted(ends)
    assert stream.counts['events'] == events
    assert noticed(stream).keys() <= {'triggers_0', 'triggers_1'}
    if len(messages) <= MOST_LATE:
        return
    # Played again from its start, it is a new time and the same events.
    again = [stream.push(cdr) for cdr in messages]
    assert again[0].restarted and not any(decoded.restarted for decoded in again[1:])
    assert [decoded.batch.t_end_ns for decoded in again] == ends
    assert stream.counts['events'] == 2 * events


def test_thirty_seconds_through_encoder_and_packets() -> None:
    encoder, stream = Evt3Encoder(640, 480), EventStream(PACKET)
    start_ns = 2**40 // 1000 * 1000
    t_ns = np.arange(0, 30 * SECOND, 100_000_000, np.int64) + start_ns
    out = []
    for seq, t in enumerate(t_ns):
        one = EventBatch(np.array([3], 'u2'), np.array([4], 'u2'), np.array([1], 'i1'), np.array([t]), int(t) + 10**6)
        decoded = stream.push(packet(encoder.encode(one), seq, int(t) + 5 * 10**17))
        out += decoded.batch.t_ns.tolist()
    assert (np.diff(out) == 100_000_000).all()
    assert noticed(stream) == {}


# Bytes that were never meant to be read

SAMPLES = {
    (PACKET, 'evt3'): evt3(high(1), *PIXEL, 0x3801, 0x4FFF, 0x5003, 0xA001, high(2), *PIXEL),
    (PACKET, 'libcaer_cmp'): evt3(0x2001, 0x0001, 0x1003, 0x3801, 0x4001, 0x50FF),
    (PACKET, 'libcaer'): struct.pack('<8I', 3 << 17 | 2, 5, 1 << 17 | 8, 6, 0, 7, 0, 2**31 + 5),
    (FORMER_PACKET, 'mono'): struct.pack('<3Q', 5, 1 << 63 | 3 << 48 | 2 << 32 | 7, 3),
}


def corpus() -> list[tuple[str, bytes]]:
    messages = [(kind, packet(payload, encoding=name)) for (kind, name), payload in SAMPLES.items()]
    columns = [np.array(column) for column in ([1, 2], [3, 4], [1, -1], [2**40, 2**40 + 5])]
    return [*messages, (ARRAY, build_event_array(9, 'cam', 346, 260, *columns))]


def check_order(pushed: list[bytes], stream: EventStream) -> None:
    end_ns = None
    for cdr in pushed:
        decoded = stream.push(cdr)
        if decoded.batch is None:
            assert not decoded.restarted
            continue
        t_ns = decoded.batch.t_ns
        assert (np.diff(t_ns) >= 0).all()
        assert (decoded.batch.x < decoded.width).all() and (decoded.batch.y < decoded.height).all()
        if len(t_ns):
            assert end_ns is None or decoded.restarted or t_ns[0] >= end_ns
            assert decoded.first_event_ns == t_ns[0] and t_ns[-1] <= decoded.batch.t_end_ns
        assert end_ns is None or decoded.restarted or decoded.batch.t_end_ns >= end_ns
        end_ns = decoded.batch.t_end_ns
    assert stream.counts['packets'] == len(pushed)


mutations = st.lists(st.lists(st.tuples(st.integers(0, 10_000), st.integers(0, 255)), max_size=5), max_size=8)


@settings(max_examples=150, deadline=None)
@given(st.sampled_from(corpus()), mutations, st.binary(max_size=3))
def test_mutated_messages(sample: tuple[str, bytes], changes: list[list[tuple[int, int]]], tail: bytes) -> None:
    message_type, cdr = sample
    pushed = []
    for change in changes:
        mutated = bytearray(cdr + tail)
        for at, value in change:
            mutated[at % len(mutated)] = value
        pushed.append(bytes(mutated))
    check_order(pushed, EventStream(message_type))


@settings(max_examples=100, deadline=None)
@given(
    st.sampled_from(sorted(name for _, name in SAMPLES)),
    st.lists(
        st.tuples(
            st.binary(max_size=60), st.integers(0, 5), st.integers(-(2**31), 2**31 - 1), st.integers(0, 2**62)
        ),
        max_size=8,
    ),
)
def test_random_payloads(encoding: str, drawn: list[tuple[bytes, int, int, int]]) -> None:
    pushed = [
        packet(payload, seq, stamp_s * SECOND, encoding=encoding, time_base_ns=base_ns)
        for payload, seq, stamp_s, base_ns in drawn
    ]
    check_order(pushed, EventStream(PACKET))


@settings(max_examples=100, deadline=None)
@given(st.sampled_from(SUPPORTED_TYPES), st.binary(max_size=200), st.sampled_from([bytes, bytearray, memoryview]))
def test_random_bytes(message_type: str, body: bytes, buffer: Callable[[bytes], bytes]) -> None:
    stream = EventStream(message_type)
    stream.push(buffer(body))
    stream.push(buffer(b'\x00\x01\x00\x00' + body))
    assert stream.counts['packets'] == 2
