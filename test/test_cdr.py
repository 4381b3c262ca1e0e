"""CDR bytes of event messages: fields, alignment, and lengths that are not to be trusted."""

from __future__ import annotations

import struct

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from beacon_comm.wire.cdr import build_event_array, build_event_packet, parse_event_array, parse_event_packet
from beacon_comm.wire.errors import WireError

PACKET = build_event_packet(5_000_000_007, 'cam', 640, 480, 9, 77, 'evt3', b'abcdef')


def test_golden_bytes() -> None:
    fields = struct.pack('<iII4sIIQQI5s', 5, 7, 4, b'cam\0', 480, 640, 9, 77, 5, b'evt3\0')
    # is_bigendian, two bytes up to the next multiple of four, the length of events.
    assert b'\x00\x01\x00\x00' + fields + b'\x00' + bytes(2) + struct.pack('<I', 6) + b'abcdef' == PACKET


frames = st.text(st.characters(codec='utf-8', exclude_characters='\0'), max_size=12)
sides = st.integers(0, 2**32 - 1)
stamps = st.integers(-(2**31) * 10**9, (2**31 - 1) * 10**9)


@settings(deadline=None)
@given(stamps, frames, sides, sides, st.integers(0, 2**64 - 1), st.integers(0, 2**62), frames, st.binary(max_size=40))
def test_a_packet_comes_back(
    stamp_ns: int, frame: str, width: int, height: int, seq: int, base_ns: int, encoding: str, payload: bytes
) -> None:
    packet = parse_event_packet(build_event_packet(stamp_ns, frame, width, height, seq, base_ns, encoding, payload))
    assert (packet.stamp_ns, packet.frame_id, packet.width, packet.height) == (stamp_ns, frame, width, height)
    assert (packet.seq, packet.time_base_ns, packet.encoding, packet.is_bigendian) == (seq, base_ns, encoding, False)
    assert packet.payload.tobytes() == payload


@pytest.mark.parametrize('kind', [bytes, bytearray, memoryview, lambda b: memoryview(b'..' + b)[2:]])
def test_any_buffer_is_read_without_a_copy(kind: type) -> None:
    cdr = kind(PACKET)
    packet = parse_event_packet(cdr)
    assert packet.payload.tobytes() == b'abcdef'
    assert np.shares_memory(packet.payload, np.frombuffer(cdr, np.uint8))


def test_is_bigendian_is_read() -> None:
    cdr = bytearray(PACKET)
    cdr[cdr.index(b'evt3\0') + 5] = 1
    assert parse_event_packet(cdr).is_bigendian


@pytest.mark.parametrize('length', range(len(PACKET)))
def test_every_truncation_is_named(length: int) -> None:
    with pytest.raises(WireError) as caught:
        parse_event_packet(PACKET[:length])
    assert caught.value.kind == 'truncated'


@pytest.mark.parametrize('at', [12, 44, 56])
def test_lengths_beyond_the_message(at: int) -> None:
    cdr = bytearray(PACKET)
    for length in (100, 2**31, 2**32 - 1):
        struct.pack_into('<I', cdr, at, length)
        with pytest.raises(WireError):
            parse_event_packet(cdr)


def test_a_text_ends_at_its_first_zero() -> None:
    assert parse_event_packet(build_event_packet(0, 'cam\0era', 640, 480, 0, 0, 'mono\0x', b'')).encoding == 'mono'
    assert parse_event_packet(build_event_packet(0, 'cam\0era', 640, 480, 0, 0, 'mono', b'')).frame_id == 'cam'


def test_what_is_not_plain_little_endian_cdr() -> None:
    with pytest.raises(WireError, match='encapsulation 0000'):
        parse_event_packet(b'\x00\x00' + PACKET[2:])
    with pytest.raises(WireError, match='beyond'):
        parse_event_packet(build_event_packet(0, 'cam', 640, 480, 0, 2**63, 'mono', b''))


@settings(max_examples=200, deadline=None)
@given(st.lists(st.tuples(st.integers(0, len(PACKET) - 1), st.integers(0, 255)), max_size=6), st.binary(max_size=4))
def test_mutated_bytes_raise_nothing_but_wire_errors(changes: list[tuple[int, int]], tail: bytes) -> None:
    cdr = bytearray(PACKET + tail)
    for at, value in changes:
        cdr[at] = value
    for parse in (parse_event_packet, parse_event_array):
        try:
            packet = parse(cdr)
        except WireError:
            continue
        assert len(packet.payload) <= len(cdr)


@settings(max_examples=200, deadline=None)
@given(st.binary(max_size=120))
def test_random_bytes_raise_nothing_but_wire_errors(body: bytes) -> None:
    for parse in (parse_event_packet, parse_event_array):
        for cdr in (body, b'\x00\x01\x00\x00' + body):
            try:
                parse(cdr)
            except WireError as error:
                assert error.kind in ('truncated', 'encapsulation', 'time_base')


@pytest.mark.parametrize('frame', ['', 'c', 'ca', 'cam', 'camera'])
@pytest.mark.parametrize('count', [0, 1, 2, 5])
def test_event_array_length(frame: str, count: int) -> None:
    zeros = np.zeros(count, np.int64)
    cdr = build_event_array(1, frame, 8, 4, zeros, zeros, zeros, zeros)
    packet = parse_event_array(cdr)
    assert (packet.frame_id, packet.width, packet.height, packet.event_count) == (frame, 8, 4, count)
    assert len(packet.payload) == (16 * count - 3 if count else 0)
    if count:
        with pytest.raises(WireError, match='events ends at byte'):
            parse_event_array(cdr[:-1])
