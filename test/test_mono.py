"""Encoding mono: the real recording, the bits, disorder."""

from __future__ import annotations

import sqlite3
import struct
from contextlib import closing
from pathlib import Path

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from beacon_comm.wire.cdr import Packet, parse_event_packet
from beacon_comm.wire.mono import MonoDecoder
from beacon_comm.wire.reading import TALLY_KINDS, Continuity, Reading


class Run:
    """A decoder with its tally."""

    def __init__(self) -> None:
        self.decoder = MonoDecoder()
        self.tally = np.zeros(len(TALLY_KINDS), np.int64)

    def push(self, rows: list[tuple[int, int, int, bool]], base_ns: int = 0, tail: bytes = b'') -> Reading:
        """Rows: x, y, offset_ns, polarity."""
        words = [t | x << 32 | y << 48 | on << 63 for x, y, t, on in rows]
        payload = np.frombuffer(struct.pack(f'<{len(words)}Q', *words) + tail, np.uint8)
        packet = Packet(0, 'camera', 640, 480, 0, base_ns, 'mono', False, payload)
        return self.decoder.decode(packet, Continuity(), self.tally)

    @property
    def counts(self) -> dict[str, int]:
        return {kind: int(n) for kind, n in zip(TALLY_KINDS, self.tally, strict=True) if n}


def test_recording(data_folder: Path) -> None:
    run, batches = Run(), []
    file = data_folder / 'mono_legacy' / 'test_data_mono_cd_0.db3'
    with closing(sqlite3.connect(f'file:{file}?mode=ro&immutable=1', uri=True)) as bag:
        for (cdr,) in bag.execute('select data from messages order by id'):
            batches.append(run.decoder.decode(parse_event_packet(cdr), Continuity(), run.tally).batch)
    x, y, polarity, t_ns = (
        np.concatenate([getattr(batch, name) for batch in batches]) for name in ('x', 'y', 'polarity', 't_ns')
    )
    assert (len(x), (polarity > 0).sum(), (polarity < 0).sum()) == (100, 50, 50)
    # Sums that the recording's makers publish with it.
    assert (t_ns.sum(), x.sum(dtype=np.int64), y.sum(dtype=np.int64)) == (4_950_000, 34_450, 26_450)
    assert run.counts == {}


@settings(deadline=None)
@given(
    st.lists(
        st.tuples(st.integers(0, 639), st.integers(0, 479), st.integers(0, 2**32 - 1), st.booleans()), max_size=8
    ),
    st.integers(0, 2**60),
)
def test_words(rows: list[tuple[int, int, int, bool]], base_ns: int) -> None:
    rows.sort(key=lambda row: row[2])
    batch = Run().push(rows, base_ns).batch
    decoded = zip(batch.x, batch.y, batch.t_ns, batch.polarity, strict=True)
    assert list(decoded) == [(x, y, base_ns + t, 1 if on else -1) for x, y, t, on in rows]
    assert batch.t_end_ns == base_ns + (rows[-1][2] if rows else 0)


def test_outside_disorder_odd_bytes_and_restart() -> None:
    run = Run()
    reading = run.push([(1, 1, 50, True), (640, 1, 60, True), (1, 480, 60, True), (2, 1, 40, False)], 2**40, b'123')
    assert run.counts == {'outside_events': 2, 'clamped_times': 1}
    assert reading.batch.t_ns.tolist() == [2**40 + 50] * 2
    assert reading.odd_bytes == 3
    reading = run.push([], 2**40 + 10**9)
    assert reading.batch.t_end_ns == 2**40 + 10**9
    assert not run.push([(1, 1, 0, True)], 2**40).restarted
    reading = run.push([(1, 1, 0, True)], 2**40 - 1)
    assert reading.restarted
    assert reading.batch.t_end_ns == 2**40 - 1
