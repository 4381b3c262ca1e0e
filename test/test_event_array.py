"""EventArray: the events where they stand, against a serialiser that nobody here wrote."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from beacon_comm.wire.cdr import build_event_array, parse_event_array
from beacon_comm.wire.event_array import EventArrayDecoder
from beacon_comm.wire.reading import TALLY_KINDS, Reading

PACKAGE = 'dvs_msgs'
EVENT = 'uint16 x\nuint16 y\nbuiltin_interfaces/Time ts\nbool polarity'
ARRAY = 'std_msgs/Header header\nuint32 height\nuint32 width\nEvent[] events'


@pytest.fixture(scope='module')
def store():
    store = get_typestore(Stores.ROS2_JAZZY)
    store.register(get_types_from_msg(EVENT, f'{PACKAGE}/msg/Event'))
    store.register(get_types_from_msg(ARRAY, f'{PACKAGE}/msg/EventArray'))
    return store


def serialised(store, frame: str, rows: list[tuple[int, int, int, int]], width: int = 640, height: int = 480) -> bytes:
    """Rows: x, y, t_ns, polarity."""
    kinds = store.types
    time, header = kinds['builtin_interfaces/msg/Time'], kinds['std_msgs/msg/Header']
    event, array = kinds[f'{PACKAGE}/msg/Event'], kinds[f'{PACKAGE}/msg/EventArray']
    events = [event(x, y, time(t // 10**9, t % 10**9), polarity > 0) for x, y, t, polarity in rows]
    message = array(header(time(1, 2), frame), height, width, events)
    return bytes(store.serialize_cdr(message, f'{PACKAGE}/msg/EventArray'))


def decode(cdr: bytes, decoder: EventArrayDecoder | None = None) -> tuple[Reading, dict[str, int]]:
    tally = np.zeros(len(TALLY_KINDS), np.int64)
    reading = (decoder or EventArrayDecoder()).decode(parse_event_array(cdr), tally)
    return reading, {kind: int(n) for kind, n in zip(TALLY_KINDS, tally, strict=True) if n}


rows = st.lists(
    st.tuples(
        st.integers(0, 639),
        st.integers(0, 479),
        st.integers(-(2**31) * 10**9, 2**31 * 10**9 - 1),
        st.sampled_from([-1, 1]),
    ),
    max_size=8,
).map(lambda drawn: sorted(drawn, key=lambda row: row[2]))


@settings(max_examples=100, deadline=None)
@given(drawn=rows, frame=st.sampled_from(['', 'c', 'ca', 'cam', 'came', 'camera']))
def test_any_array_is_read_and_built(store, drawn: list[tuple[int, int, int, int]], frame: str) -> None:
    cdr = serialised(store, frame, drawn)
    reading, counts = decode(cdr)
    assert counts == {}
    batch = reading.batch
    if not drawn:
        assert batch is None
    else:
        assert list(zip(batch.x, batch.y, batch.t_ns, batch.polarity, strict=True)) == drawn
        assert batch.t_end_ns == drawn[-1][2]
    columns = [np.array([row[i] for row in drawn], np.int64) for i in (0, 1, 3, 2)]
    assert build_event_array(1_000_000_002, frame, 640, 480, *columns) == cdr


def test_outside_disorder_and_restart(store) -> None:
    decoder = EventArrayDecoder()
    second = 10**9
    reading, counts = decode(
        serialised(store, 'c', [(1, 2, 9 * second, 1), (640, 2, 99 * second, 1), (3, 2, 8 * second, -1)]), decoder
    )
    assert counts == {'outside_events': 1, 'clamped_times': 1}
    assert reading.batch.t_ns.tolist() == [9 * second, 9 * second]
    reading, counts = decode(serialised(store, 'c', [(1, 2, 8 * second, 1)]), decoder)
    assert (reading.restarted, counts) == (False, {'clamped_times': 1})
    reading, _ = decode(serialised(store, 'c', [(1, 2, 7 * second, 1)]), decoder)
    assert reading.restarted
    assert reading.batch.t_end_ns == 7 * second
    assert decode(serialised(store, 'c', []), decoder)[0].batch.t_end_ns == 7 * second
