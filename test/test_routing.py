"""Routing against a search over all tracks, and the event buffer against a plain list."""

import numpy as np
import pytest
from disc_events import HOP_NS, T0_NS, batch
from hypothesis import given, settings
from hypothesis import strategies as st

from beacon_comm.core.event_buffer import EVENT_BYTES, EventBuffer, buffer_length_ns
from beacon_comm.core.hop_events import ROUTED
from beacon_comm.core.parameters import Parameters
from beacon_comm.core.routing import Router
from beacon_comm.core.tracks import Track

SIZE = (120, 90)


def track(track_id, x, y, extent=4.0, vx=0.0, vy=0.0, t_ns=T0_NS):
    return Track(track_id, x, y, t_ns, extent, 1.0, t_ns, t_ns, vx, vy)


def events(n, seed=0, size=SIZE):
    rng = np.random.default_rng(seed)
    x, y = rng.integers(0, size[0], n), rng.integers(0, size[1], n)
    return batch(x, y, rng.choice([-1, 1], n), T0_NS + np.sort(rng.integers(0, HOP_NS, n)))


def test_a_hops_events_stay_as_they_were_when_the_next_ones_come():
    router = Router(Parameters(), SIZE)
    closed = []
    for k in range(6):  # the room of the first hops grows, that of the later ones is handed over
        segment = events(20_000, seed=k)
        router.aim((), T0_NS)
        router.route(segment)
        closed.append((router.close(), segment))
    assert any(hop.room > len(hop) for hop, _ in closed)
    for hop, segment in closed:
        assert len(hop) == len(segment) <= hop.room
        assert hop.size_bytes >= 8 * hop.room
        np.testing.assert_array_equal(hop.code & 1, segment.polarity > 0)
        np.testing.assert_array_equal(hop.code >> 2 & 127, segment.x)
        np.testing.assert_array_equal(hop.t_start_ns + hop.offset_ns.astype(np.int64), segment.t_ns)


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 2**32), st.integers(1, 250))
def test_every_event_goes_to_the_nearest_track_that_holds_it(seed, count):
    rng = np.random.default_rng(seed)
    tracks = [
        track(7 + k, x, y, extent, vx, vy)
        for k, (x, y, extent, vx, vy) in enumerate(
            zip(
                rng.uniform(-20, 140, count),
                rng.uniform(-20, 110, count),
                rng.uniform(0.5, rng.choice([3, 30]), count),
                rng.normal(0, 300, count),
                rng.normal(0, 300, count),
                strict=True,
            )
        )
    ]
    router = Router(Parameters(), SIZE)
    router.aim(tracks, T0_NS)
    seen = events(200, seed)
    routed = router.route(seen)
    expected: dict[int, list[tuple[int, int]]] = {}
    for x, y, polarity, t_ns in zip(seen.x, seen.y, seen.polarity, seen.t_ns, strict=True):
        nearest = None
        for one in tracks:
            cx, cy = one.position_at(int(t_ns))
            distance = np.hypot(float(x) - cx, float(y) - cy)
            if distance <= one.extent_px * 1.5 + 2.0 and (nearest is None or distance < nearest[0]):
                nearest = (distance, one.track_id)
        if nearest is not None:
            expected.setdefault(nearest[1], []).append((int(t_ns), int(polarity)))
    assert {i: list(zip(p.t_ns.tolist(), p.polarity.tolist(), strict=True)) for i, p in routed.items()} == expected
    assert list(routed) == sorted(routed) and len(routed) == len(expected)
    assert routed.count == sum(map(len, expected.values()))
    assert router.gathered == 200
    assert (router.close().code & ROUTED > 0).sum() == sum(len(part.t_ns) for part in routed.values())


def test_a_fast_track_takes_its_events_along():
    """At 2000 px/s a disc moves 20 px in a hop."""
    router = Router(Parameters(), SIZE)
    router.aim([track(1, 20, 40, vx=2000.0)], T0_NS)
    t_ns = T0_NS + np.arange(0, HOP_NS, 1000)
    along = batch(np.rint(20 + (t_ns - T0_NS) * 2e-6), np.full(len(t_ns), 44), np.ones(len(t_ns)), t_ns)
    assert len(router.route(along)[1].t_ns) == len(t_ns)


def test_an_event_between_two_tracks_is_of_one():
    router = Router(Parameters(), SIZE)
    router.aim([track(3, 40, 40), track(5, 52, 40)], T0_NS)
    routed = router.route(batch([46, 45, 47, 40, 52], [40] * 5, [1, 1, -1, 1, -1], [T0_NS] * 5))
    assert [(track_id, part.polarity.tolist()) for track_id, part in routed.items()] == [(3, [1, 1, 1]), (5, [-1, -1])]


def test_events_outside_the_sensor_are_dropped_and_counted():
    router = Router(Parameters(), SIZE)
    router.aim([track(1, 118, 88)], T0_NS)
    routed = router.route(batch([119, 120, 119, 60_000], [89, 89, 90, 60_000], [1] * 4, [T0_NS] * 4))
    assert len(routed[1].t_ns) == 1
    assert router.outside_events == 3
    assert len(router.close()) == 1


def test_without_tracks_nothing_is_routed_but_all_is_gathered():
    router = Router(Parameters(), SIZE)
    for k in range(20):
        assert router.route(events(1000, k)) == {}
    gathered = router.close()
    assert len(gathered) == 20_000 and not (gathered.code & ROUTED).any()
    assert router.gathered == 0


@settings(max_examples=50, deadline=None)
@given(st.lists(st.tuples(st.integers(0, 600), st.integers(0, 4)), max_size=25), st.integers(100, 20_000))
def test_the_buffer_is_the_end_of_the_stream(pieces, max_bytes):
    buffer = EventBuffer(3 * HOP_NS, max_bytes)
    stream = np.empty(0, np.int64)
    overflow = 0
    t_hop = T0_NS
    for k, (n, hops) in enumerate(pieces):
        rng = np.random.default_rng(k)
        t_ns = t_hop + np.sort(rng.integers(0, HOP_NS, n))
        stream = np.append(stream, t_ns)
        buffer.append(t_ns, np.where(t_ns % 2, 1, -1).astype(np.int8))
        t_hop += HOP_NS * (1 + hops)
        overflow += buffer.trim(t_hop)
        stream = stream[stream >= t_hop - 3 * HOP_NS]
        stream = stream[max(0, len(stream) - max_bytes // EVENT_BYTES) :]
        if k % 3:  # what has been looked at, or not, makes no difference later
            continue
        kept, polarity = buffer.events()
        np.testing.assert_array_equal(kept, stream)
        np.testing.assert_array_equal(polarity, np.where(stream % 2, 1, -1))
        assert len(buffer) * EVENT_BYTES <= max_bytes
    assert buffer.overflow_events == overflow


@pytest.mark.parametrize(
    ('parameters', 'seconds'),
    [
        (Parameters(bit_rates=(3125.0,)), 0.5),
        (Parameters(bit_rates=(504.0, 3125.0)), 30 * 11 / 504),
        (Parameters(bit_rates=(20.0,)), 16.5),
        (Parameters(bit_rates=(20.0,), parity='none', stop_bits=1), 13.5),
    ],
)
def test_buffer_length(parameters, seconds):
    assert buffer_length_ns(parameters) == round(seconds * 1e9)
