"""The libcaer driver's two encodings: the real recording, the bits, and what lasts from packet to packet."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from beacon_comm.recordings.bags import open_recording
from beacon_comm.wire import libcaer
from beacon_comm.wire.cdr import Packet, parse_event_packet
from beacon_comm.wire.libcaer import LibcaerCmpDecoder, LibcaerDecoder
from beacon_comm.wire.reading import TALLY_KINDS, Continuity, Reading, words_of

WIDTH, HEIGHT = 346, 260
MS = 1_000_000


class Run:
    """A decoder with its tally."""

    def __init__(self, decoder: LibcaerDecoder | LibcaerCmpDecoder) -> None:
        self.decoder = decoder
        self.tally = np.zeros(len(TALLY_KINDS), np.int64)

    def push(self, payload: bytes, base_ns: int = 0, **continuity: int) -> Reading:
        data = np.frombuffer(payload, np.uint8)
        packet = Packet(0, 'camera', WIDTH, HEIGHT, 0, base_ns, 'libcaer', False, data)
        return self.decoder.decode(packet, Continuity(**continuity), self.tally)

    def words(self, words: list[int], base_ns: int = 0, **continuity: int) -> list[tuple[int, int, int, int]]:
        return as_tuples(self.push(struct.pack(f'<{len(words)}H', *words), base_ns, **continuity))

    @property
    def counts(self) -> dict[str, int]:
        return {kind: int(n) for kind, n in zip(TALLY_KINDS, self.tally, strict=True) if n}


def as_tuples(reading: Reading) -> list[tuple[int, int, int, int]]:
    batch = reading.batch
    assert batch is not None
    columns = batch.x.tolist(), batch.y.tolist(), batch.polarity.tolist(), batch.t_ns.tolist()
    return list(zip(*columns, strict=True))


def reference_cmp(words: list[int], base_ns: int) -> list[tuple[int, int, int, int]]:
    """One packet of libcaer_cmp as a plain loop; times in order, every event on the sensor."""
    high = low = column = base = 0
    sign, events = 1, []
    for word in words:
        code, value, coordinate = word >> 12, word & 0xFFF, word & 0x7FF
        now_ns = base_ns + (high << 12 | low) * 1000
        if code == 0:
            high, low = value, low if value == high else 0
        elif code == 1:
            low = value
        elif code == 2:
            column = coordinate
        elif code == 3:
            events.append((column, coordinate, 1 if word & 0x800 else -1, now_ns))
        elif code == 4:
            base, sign = coordinate, 1 if word & 0x800 else -1
        elif code == 5:
            events += [(column, base + i, sign, now_ns) for i in range(8) if word >> i & 1]
            base += 8
    return events


def test_recording_event_for_event(data_folder: Path) -> None:
    run, on, off = Run(LibcaerCmpDecoder()), 0, 0
    with open_recording(data_folder / 'libcaer_grid') as bag:
        for number, (_, cdr) in enumerate(bag.messages(bag.event_topic())):
            packet = parse_event_packet(cdr)
            reading = run.decoder.decode(packet, Continuity(), run.tally)
            on += int((reading.batch.polarity > 0).sum())
            off += int((reading.batch.polarity < 0).sum())
            if number % 10 == 0:
                words = words_of(packet.payload, '<u2', 2).tolist()
                assert as_tuples(reading) == reference_cmp(words, packet.time_base_ns)
    assert (on, off) == (211_043, 360_223)
    assert run.counts == {}


def test_cmp_words() -> None:
    run = Run(LibcaerCmpDecoder())
    events = run.words([0x2005, 0x3800 | 9, 0x1007, 0x3003, 0x0001, 0x4800 | 100, 0x5081, 0x1002, 0x5001], 2**40)
    times = [2**40, 2**40 + 7000, 2**40 + 4_096_000, 2**40 + 4_096_000, 2**40 + 4_098_000]
    assert events == list(zip([5] * 5, [9, 3, 100, 107, 108], [1, -1, 1, 1, 1], times, strict=True))
    assert run.counts == {}


def test_cmp_column_lasts_until_packets_are_missing_and_time_does_not() -> None:
    run = Run(LibcaerCmpDecoder())
    assert run.words([0x3001, 0x5001]) == []
    run.words([0x2005, 0x0003])
    assert run.words([0x3001], 20 * MS) == [(5, 1, -1, 20 * MS)]
    assert run.words([0x3001], 30 * MS, packets_missing=True) == []
    assert run.counts == {'undecoded_events': 3}


def test_cmp_outside_unknown_disorder() -> None:
    run = Run(LibcaerCmpDecoder())
    outside = [0x2000 | WIDTH, 0x3001, 0x2001, 0x3000 | HEIGHT]
    events = run.words([*outside, 0x9000, 0x1009, 0x3002, 0x1003, 0x3003, 0x4000, 0x5001])
    assert [event[3] for event in events] == [9000, 9000, 9000]
    assert run.counts == {'outside_events': 2, 'skipped_words': 1, 'clamped_times': 2}


def test_cmp_time_moves_without_events_and_restarts() -> None:
    run = Run(LibcaerCmpDecoder())
    assert run.push(b'', 5000 * MS).batch.t_end_ns == 5000 * MS
    assert run.push(struct.pack('<H', 0x1001), 5001 * MS).batch.t_end_ns == 5001 * MS + 1000
    assert not run.push(b'', 4500 * MS).restarted
    assert run.push(b'', 4000 * MS, seq_fell=False).restarted
    assert run.push(b'', 3999 * MS, seq_fell=True).restarted


@settings(max_examples=60, deadline=None)
@given(st.lists(st.integers(0, 0x6FFF), max_size=60))
def test_cmp_no_write_behind_the_columns(words: list[int]) -> None:
    array = np.asarray(words, np.uint16)
    array.flags.writeable = False
    capacity = libcaer._capacity(array)
    guarded = [np.full(capacity + 64, 77, kind) for kind in (np.uint16, np.uint16, np.int8, np.int64)]
    inside = [column[:capacity] for column in guarded]
    n, _ = libcaer._decode_cmp(array, 2048, 2060, 0, 0, np.zeros(3, np.int64), *inside, np.zeros(6, np.int64))
    assert n <= capacity
    assert all((column[capacity:] == 77).all() for column in guarded)


@settings(deadline=None)
@given(
    st.lists(
        st.tuples(st.integers(0, WIDTH - 1), st.integers(0, HEIGHT - 1), st.integers(0, 2**31 - 1), st.booleans()),
        max_size=8,
    ),
    st.integers(0, 2**60),
)
def test_libcaer_words(rows: list[tuple[int, int, int, bool]], base_ns: int) -> None:
    rows.sort(key=lambda row: row[2])
    data = b''.join(struct.pack('<II', x << 17 | y << 2 | on << 1 | 1, t) for x, y, t, on in rows)
    run = Run(LibcaerDecoder())
    reading = run.push(data + b'odd', base_ns)
    assert reading.odd_bytes == 3
    if not rows:
        assert reading.batch is None
        return
    assert as_tuples(reading) == [(x, y, 1 if on else -1, base_ns + t * 1000) for x, y, t, on in rows]
    assert run.push(b'', base_ns).batch.t_end_ns == reading.batch.t_end_ns


def test_libcaer_rolls_over_inside_a_packet() -> None:
    data = b''.join(struct.pack('<II', 4 | 2, t) for t in (2**31 - 1, 0, 5))
    events = as_tuples(Run(LibcaerDecoder()).push(data, 10))
    assert [event[3] for event in events] == [(2**31 - 1) * 1000 + 10, 2**31 * 1000 + 10, (2**31 + 5) * 1000 + 10]
