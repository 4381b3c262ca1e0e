"""Events of discs for the tests of detection: seeded, as int64 nanoseconds from 2⁴⁰ on."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np

from beacon_comm.core.detection import Detector
from beacon_comm.core.events import NS_PER_S, EventBatch
from beacon_comm.core.hop_events import HopEvents
from beacon_comm.core.parameters import Parameters
from beacon_comm.core.routing import Routed, Router
from beacon_comm.core.tracks import TrackChanges

T0_NS = 1 << 40
HOP_NS = 10_000_000


def batch(x, y, polarity, t_ns, t_end_ns: int | None = None) -> EventBatch:
    """Return columns of numbers as a batch that ends with its last event."""
    t_ns = np.asarray(t_ns, np.int64)
    end = t_end_ns if t_end_ns is not None else int(t_ns[-1]) if len(t_ns) else 0
    return EventBatch(
        np.asarray(x, np.uint16), np.asarray(y, np.uint16), np.asarray(polarity, np.int8), t_ns, end
    )


def disc(
    x_px: float,
    y_px: float,
    radius_px: float = 4.0,
    vx: float = 0.0,
    vy: float = 0.0,
    start_s: float = 0.0,
    duration_s: float = 1.0,
    rate_per_s: float = 128 * 504.0,
    bit_rate_bps: float = 504.0,
    seed: int = 0,
) -> EventBatch:
    """Return events spread over a moving disc; random bits decide the polarity.

    The default is the real 504 bps signal at 30 m: 128 events a bit on 49 pixels.  ``x_px, y_px``: centre at T0.
    """
    rng = np.random.default_rng(seed)
    t = start_s + np.sort(rng.uniform(0.0, duration_s, rng.poisson(rate_per_s * duration_s)))
    level = rng.integers(0, 2, int((start_s + duration_s) * bit_rate_bps) + 2)[(t * bit_rate_bps).astype(int)]
    angle = rng.uniform(0.0, 2.0 * np.pi, len(t))
    distance = radius_px * np.sqrt(rng.uniform(0.0, 1.0, len(t)))
    x = np.rint(x_px + vx * t + distance * np.cos(angle))
    y = np.rint(y_px + vy * t + distance * np.sin(angle))
    return batch(x, y, np.where(level, 1, -1), T0_NS + (t * NS_PER_S).astype(np.int64))


def noise(width: int, height: int, rate_per_s: float, duration_s: float, seed: int = 9) -> EventBatch:
    """Return events spread over the whole sensor."""
    rng = np.random.default_rng(seed)
    t = np.sort(rng.uniform(0.0, duration_s, rng.poisson(rate_per_s * duration_s)))
    x, y = rng.integers(0, width, len(t)), rng.integers(0, height, len(t))
    return batch(x, y, rng.choice([-1, 1], len(t)), T0_NS + (t * NS_PER_S).astype(np.int64))


def merged(*parts: EventBatch) -> EventBatch:
    """Return all events in order of time, no two at the same one, so that a time names an event."""
    t_ns = np.concatenate([part.t_ns for part in parts])
    order = np.argsort(t_ns, kind='stable')
    rank = np.arange(len(t_ns))
    columns = (
        np.concatenate([getattr(part, name) for part in parts])[order] for name in ('x', 'y', 'polarity')
    )
    return batch(*columns, np.maximum.accumulate(t_ns[order] - rank) + rank)


def gathered(segment: EventBatch, size: tuple[int, int]) -> HopEvents:
    """Return a segment as the router hands it to the index images."""
    router = Router(Parameters(), size)
    router.aim((), int(segment.t_ns[0]) if len(segment) else 0)
    router.route(segment)
    return router.close()


def hops(events: EventBatch, t_end_ns: int | None = None, hop_ns: int = HOP_NS) -> Iterator[EventBatch]:
    """Cut events at the points of the hop grid, up to the one at or after ``t_end_ns``."""
    end = max(events.t_end_ns, t_end_ns or 0)
    t_hop = int(events.t_ns[0]) // hop_ns * hop_ns if len(events) else end // hop_ns * hop_ns
    start = 0
    while t_hop <= end:
        t_hop += hop_ns
        stop = int(np.searchsorted(events.t_ns, t_hop))
        yield events.slice(start, stop, t_hop)
        start = stop


def detect(
    detector: Detector,
    events: EventBatch,
    at_hop: Callable[[int, TrackChanges], None] | None = None,
    t_end_ns: int | None = None,
) -> dict[int, list[Routed]]:
    """Feed events hop by hop; return what was routed to each track."""
    routed: dict[int, list[Routed]] = {}
    for segment in hops(events, t_end_ns):
        for track_id, part in detector.route(segment).items():
            routed.setdefault(track_id, []).append(part)
        changes = detector.hop(segment.t_end_ns)
        if at_hop is not None:
            at_hop(segment.t_end_ns, changes)
    return routed
