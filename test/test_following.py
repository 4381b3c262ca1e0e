"""Tracks that move on with their own events: fast, turning, crossing, hidden, lost and found again."""

from collections.abc import Callable

import numpy as np
import pytest
from disc_events import HOP_NS, T0_NS, batch, detect, hops, merged, noise
from docs_script import load
from hypothesis import given, settings
from hypothesis import strategies as st
from test_detection import in_pieces

from beacon_comm.core import motion
from beacon_comm.core.blobs import Blob
from beacon_comm.core.detection import Detector
from beacon_comm.core.events import EventBatch
from beacon_comm.core.following import FollowingRouter, _doubted
from beacon_comm.core.hop_events import CODE_BITS, NOTHING_NEAR, NearEvents
from beacon_comm.core.index_image import IndexImages
from beacon_comm.core.motion_tracks import MotionTrack
from beacon_comm.core.nearest import cells_along, events_in
from beacon_comm.core.parameters import Parameters

SIZE = (320, 240)
Path = Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]


def along(path: Path, begin_s: float, end_s: float, seed: int = 0, rate_per_s: float = 100_000.0) -> EventBatch:
    """Return events of a disc of radius 4 that moves along a path, its line random bits of 1 ms."""
    random = np.random.default_rng(seed)
    t_s = np.sort(random.uniform(begin_s, end_s, random.poisson(rate_per_s * (end_s - begin_s))))
    level = random.integers(0, 2, int(1000 * end_s) + 2)[(1000 * t_s).astype(int)]
    angle, radius = random.uniform(0, 2 * np.pi, len(t_s)), 4.0 * np.sqrt(random.uniform(0, 1, len(t_s)))
    x, y = path(t_s)
    x, y = np.rint(x + radius * np.cos(angle)), np.rint(y + radius * np.sin(angle))
    kept = (x >= 0) & (y >= 0) & (x < SIZE[0]) & (y < SIZE[1])
    return batch(x[kept], y[kept], np.where(level, 1, -1)[kept], T0_NS + (t_s[kept] * 1e9).astype(np.int64))


def ramped(t_s: np.ndarray, speed: float) -> np.ndarray:
    """Return the way gone: at rest for 0.1 s, then even acceleration for 0.2 s, then the speed."""
    since = np.clip(t_s - 0.1, 0.0, None)
    return np.where(since < 0.2, speed * since**2 / 0.4, speed * (since - 0.1))


def bouncing(speed: float) -> Path:
    def path(t_s: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        way = 60.0 + np.array([0.9, 0.4])[:, None] * ramped(t_s, speed)
        span = np.array([SIZE[0] - 11.0, SIZE[1] - 11.0])[:, None]
        turned = np.mod(way - 5.0, 2 * span)
        return tuple(5.0 + np.where(turned > span, 2 * span - turned, turned))

    return path


def circling(speed: float, radius: float = 100.0) -> Path:
    def path(t_s: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        angle = ramped(t_s, speed) / radius
        return 160.0 + radius * np.cos(angle), 120.0 + radius * np.sin(angle)

    return path


def still(x: float, y: float) -> Path:
    return lambda t_s: (np.full(len(t_s), x), np.full(len(t_s), y))


@pytest.mark.parametrize(('path', 'within_px'), [(bouncing(2000.0), 1.0), (circling(2000.0), 1.0), (circling(5000.0), 3.0)])
def test_a_fast_blob_is_one_track_that_gets_its_events(path: Path, within_px: float) -> None:
    detector, error = Detector(Parameters(bit_rates=(1000.0,), tracker='motion'), SIZE), []

    def look(t_hop: int, changes: object) -> None:
        if t_hop > T0_NS + 350_000_000:
            for track in detector.tracks.values():
                x, y = path(np.array([(t_hop - T0_NS) / 1e9]))
                error.append(np.hypot(*np.subtract(track.position_at(t_hop), (x[0], y[0]))))

    events = merged(along(path, 0.0, 0.8), noise(*SIZE, 50_000, 0.8))
    routed = detect(detector, events, look)
    assert list(detector.tracks) == [1] and detector.stats.new_tracks == 1
    assert np.median(error) < within_px
    assert sum(len(part.t_ns) for part in routed[1]) > 0.93 * 80_000
    assert detector.tracks[1].extent_px == pytest.approx(4.0, abs=1.0)


@pytest.mark.parametrize('path', [still(100.0, 90.0), bouncing(2000.0), circling(5000.0), bouncing(8000.0)])
def test_what_is_listed_near_tracks_is_all_that_lies_there(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    detector = Detector(Parameters(bit_rates=(1000.0,), tracker='motion'), SIZE)
    find, seen = detector._blobs.find, []

    def note(images: IndexImages, t_hop_ns: int, near: NearEvents) -> list[Blob]:
        seen.append(NearEvents(near.events.copy(), near.cells))
        return find(images, t_hop_ns, near)

    monkeypatch.setattr(detector._blobs, 'find', note)
    across, near = cells_along(SIZE[0]), 0
    for part in hops(merged(along(path, 0.0, 0.5), noise(*SIZE, 300_000, 0.5))):
        followed = bool(detector.tracks)
        for cut in (slice(0, 700), slice(700, 701), slice(701, len(part))):
            detector.route(part.slice(cut.start, cut.stop, part.t_end_ns))
        detector.hop(part.t_end_ns)
        newest, near_events, grid = detector._images.newest, seen[-1], detector._images.grid
        assert followed or not near_events.cells.any()
        near_code, near_offset_ns = near_events.events
        there = events_in(near_events.cells, across, newest.code, grid.shift)
        listed = events_in(near_events.cells, across, near_code, grid.shift)
        assert np.array_equal(near_code[listed] >> CODE_BITS, newest.code[there] >> CODE_BITS)
        assert np.array_equal(near_offset_ns[listed], newest.offset_ns[there])
        near += len(there)
    assert near > 500


@pytest.mark.parametrize('path', [still(100.0, 90.0), circling(5000.0), bouncing(3000.0)])
def test_blobs_that_are_observed_by_what_is_near_are_those_of_all_events(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    events = merged(along(path, 0.0, 0.5), along(still(200.0, 150.0), 0.2, 0.5, 1), noise(*SIZE, 300_000, 0.5))
    seen: list[list[str]] = []
    for _ in range(2):
        detector, states = Detector(Parameters(bit_rates=(1000.0,), tracker='motion'), SIZE), []
        detect(detector, events, lambda t, changes, d=detector, s=states: s.append(repr([*d.tracks.values(), changes])))
        seen.append(states)
        monkeypatch.setattr(FollowingRouter, 'near', NOTHING_NEAR)
    assert seen[0] == seen[1] and len(seen[0]) > 45


def test_the_papers_tracker_breaks_it_up() -> None:
    detector = Detector(Parameters(bit_rates=(1000.0,), tracker='nearest'), SIZE)
    detect(detector, along(bouncing(2000.0), 0.0, 0.8))
    assert detector.stats.new_tracks > 3


@pytest.mark.parametrize('angle_deg', [0.0, 50.0, 130.0])
@pytest.mark.parametrize('past_px', [0.0, 3.0, 8.0])
def test_two_that_cross_keep_their_labels(angle_deg: float, past_px: float) -> None:
    way = np.array([np.cos(np.radians(angle_deg)), np.sin(np.radians(angle_deg))])
    paths = [
        lambda t, s=sign: tuple(
            np.array([160.0, 120.0])[:, None]
            + s * (np.array([-way[1], way[0]])[:, None] * past_px / 2 + way[:, None] * 250.0 * (np.maximum(t, 0.1) - 0.22))
        )
        for sign in (1.0, -1.0)
    ]
    detector = Detector(Parameters(bit_rates=(1000.0,), tracker='motion'), SIZE)
    where: dict[int, list[tuple[float, float]]] = {}

    def look(t_hop: int, changes: object) -> None:
        for track_id, track in detector.tracks.items():
            where.setdefault(track_id, []).append(track.position_at(t_hop))

    detect(detector, merged(*(along(path, 0.0, 0.35, seed) for seed, path in enumerate(paths))), look)
    assert sorted(detector.tracks) == [1, 2]
    for places in where.values():
        moved = np.subtract(places[-1], places[5]) @ way
        assert abs(moved) == pytest.approx(250.0 * 0.25, abs=6.0)  # straight on, and not back


FAST = merged(along(bouncing(3000.0), 0.0, 0.5), along(still(200.0, 40.0), 0.1, 0.5, 1), noise(*SIZE, 30_000, 0.5))
BATCHING = Parameters(tracker='motion', lost_after_s=0.05, bit_rates=(1000.0,))


@settings(max_examples=10, deadline=None)
@given(st.lists(st.integers(1, len(FAST) - 1), max_size=80))
def test_any_batching_gives_the_same(cuts: list[int]) -> None:
    whole = in_pieces(Detector(BATCHING, SIZE), FAST, [])
    assert in_pieces(Detector(BATCHING, SIZE), FAST, cuts) == whole


@pytest.mark.parametrize('speed', [0.0, 300.0])
def test_what_was_hidden_for_a_moment_goes_on_under_its_label(speed: float) -> None:
    def path(t_s: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return 60.0 + speed * t_s, np.full(len(t_s), 100.0)

    detector, quiet = Detector(Parameters(bit_rates=(1000.0,), tracker='motion'), SIZE), []
    events = merged(along(path, 0.0, 0.4), along(path, 0.5, 0.7, 1), noise(*SIZE, 50_000, 0.7))
    detect(detector, events, lambda t_hop, changes: quiet.append(any(t.quiet for t in detector.tracks.values())))
    assert list(detector.tracks) == [1] and any(quiet) and not quiet[-1]
    (track,) = detector.tracks.values()
    assert track.position_at(T0_NS + 700_000_000) == pytest.approx((60.0 + 0.7 * speed, 100.0), abs=1.0)


@pytest.mark.parametrize(
    ('parameters', 'rate_bps', 'x_px', 'label'),
    [
        (Parameters(tracker='motion', lost_after_s=0.1), 1000.0, 60.0, 1),
        (Parameters(tracker='motion', lost_after_s=0.1), None, 60.0, 2),
        (Parameters(tracker='motion', lost_after_s=0.1), 1000.0, 160.0, 2),
        (Parameters(tracker='motion', lost_after_s=0.1, reacquire_s=0.5), 1000.0, 60.0, 2),
    ],
)
def test_a_lost_label_comes_back_where_it_was_lost_and_only_there(
    parameters: Parameters, rate_bps: float | None, x_px: float, label: int
) -> None:
    detector = Detector(parameters, SIZE)
    detect(detector, along(still(60.0, 100.0), 0.0, 0.3))
    detector.tracks[1].bit_rate_bps = rate_bps
    detect(detector, along(still(x_px, 100.0), 1.0, 1.2))
    assert list(detector.tracks) == [label]
    assert detector.tracks[label].claimed_bps == (rate_bps if label == 1 else None)


def test_a_label_that_was_given_wrongly_is_taken_away() -> None:
    detector = Detector(Parameters(tracker='motion', lost_after_s=0.1), SIZE)
    detect(detector, along(still(60.0, 100.0), 0.0, 0.3))
    detector.tracks[1].bit_rate_bps = 1000.0
    back = along(still(60.0, 100.0), 1.0, 1.4)
    first, second = (back.slice(a, b, int(back.t_ns[b - 1])) for a, b in ((0, 20_000), (20_000, len(back))))
    detect(detector, first)
    detector.disown(1)
    changes = []
    routed = detect(detector, second, lambda t_hop, change: changes.append(change))
    assert [t.track_id for change in changes for t in change.lost] == [1]
    assert [t.track_id for change in changes for t in change.new] == [2]
    assert list(detector.tracks) == [2] and set(routed) <= {1, 2}
    kept = detector.backlog(2)[0]
    assert kept[0] <= first.t_ns[100] and len(kept) > 0.95 * len(back)  # nothing is lost on the way


def test_the_error_is_as_large_as_the_covariance_says() -> None:
    """Discs at random places and speeds: the normalised error squared over its expectation."""
    normalised = []
    for seed in range(12):
        random = np.random.default_rng(seed)
        speed, begin = random.uniform(0.0, 300.0), random.uniform(60.0, 100.0, 2)

        def path(t_s: np.ndarray, begin=begin, speed=speed) -> tuple[np.ndarray, np.ndarray]:
            return begin[0] + speed * t_s, np.full(len(t_s), begin[1])

        detector = Detector(Parameters(bit_rates=(1000.0,), tracker='motion', event_latency_s=0.0), SIZE)

        def look(t_hop: int, changes: object, detector=detector, path=path) -> None:
            if t_hop > T0_NS + 250_000_000:
                (track,) = detector.tracks.values()
                x, y = path(np.array([(t_hop - T0_NS) / 1e9]))
                error = np.subtract(track.light_at(t_hop), (x[0], y[0]))
                normalised.append(error @ np.linalg.solve(track.covariance_at(t_hop), error) / 2)

        detect(detector, along(path, 0.0, 0.5, seed), look)
    assert len(normalised) > 200
    assert 0.4 < np.mean(normalised) < 1.2


@pytest.mark.parametrize('seed', [0, 4])
def test_the_front_and_the_back_of_a_moving_light_do_not_shake_its_track(seed: int) -> None:
    """Taken as they come, ON events at the front and OFF events at the back put it 0.4 px off."""
    script = load('tracking')
    simulated = script.scene([script.moving('line', 1000.0, seed)], 1.3, 1000 + seed)
    table = script.looked_at(simulated, 'line')
    assert len(table) > 60 and np.sqrt((table[:, :2] ** 2).sum(axis=1).mean()) < 0.25


def test_a_prediction_is_the_less_certain_the_longer_nothing_is_seen() -> None:
    detector = Detector(Parameters(bit_rates=(1000.0,), tracker='motion'), SIZE)
    detect(detector, along(still(160.0, 120.0), 0.0, 0.4), t_end_ns=T0_NS + 700_000_000)
    (track,) = detector.tracks.values()
    assert track.quiet
    variances = [track.covariance_at(T0_NS + 1_000_000 * ms)[0][0] for ms in (400, 700, 1500)]
    assert variances[1] > 2.0 * variances[0] and variances[2] > 2.0 * variances[1]


def test_a_moving_light_is_ahead_of_its_events() -> None:
    track = MotionTrack(1, 10.0, 20.0, T0_NS, 4.0, 1.0, T0_NS, T0_NS, 1000.0, 0.0, latency_s=200e-6)
    motion.begin(track.row, 0.0, 10.0, 20.0, 1000.0, 0.0, 0.01, 100.0)
    x, y = track.light_at(T0_NS)
    assert x == pytest.approx(10.2) and y == 20.0
    (xx, xy), (yx, yy) = track.covariance_at(T0_NS)
    assert xx > yy and xy == yx == 0.0


def test_a_new_beacon_in_the_path_of_a_fast_one_is_found() -> None:
    """The fast one's events are not in the windows: no trail, and nothing that hides the new one."""
    detector = Detector(Parameters(bit_rates=(1000.0,), tracker='motion'), SIZE)
    path = circling(1000.0, 60.0)
    detect(detector, merged(along(path, 0.0, 0.8), along(still(220.0, 120.0), 0.5, 0.8, 1)))
    assert sorted(detector.tracks) == [1, 2]
    places = sorted(track.position_at(T0_NS + 800_000_000)[0] for track in detector.tracks.values() if not track.quiet)
    assert any(abs(x - 220.0) < 3.0 for x in places)


def test_hops_without_any_event_cost_no_track_its_velocity_at_once() -> None:
    detector = Detector(Parameters(bit_rates=(1000.0,), tracker='motion'), SIZE)

    def path(t_s: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return 40.0 + 400.0 * t_s, np.full(len(t_s), 100.0)

    detect(detector, along(path, 0.0, 0.3))
    detector.hop((T0_NS + 340_000_000) // HOP_NS * HOP_NS)
    assert detector.tracks[1].position_at(T0_NS + 340_000_000)[0] == pytest.approx(40.0 + 0.34 * 400.0, abs=3.0)


@pytest.mark.parametrize('seed', range(4))
def test_edges_that_pass_do_not_take_a_beacon_along(seed: int) -> None:
    """What is read has the events in its circle before what nobody can read."""
    detector = Detector(Parameters(bit_rates=(1000.0,), tracker='motion'), SIZE)
    beacon = along(still(160.0, 120.0), 0.0, 0.6, seed, rate_per_s=30_000.0)
    edges = [
        along(lambda t_s, y=y: (20.0 + 1500.0 * (t_s - 0.2), np.full(len(t_s), y)), 0.2, 0.4, 10 * seed + k, 60_000.0)
        for k, y in enumerate((110.0, 118.0, 126.0))
    ]

    def look(t_hop: int, changes: object) -> None:
        detector.tracks[1].bit_rate_bps = 1000.0

    detect(detector, merged(beacon, *edges), look)
    assert detector.tracks[1].position_at(T0_NS + 600_000_000) == pytest.approx((160.0, 120.0), abs=1.0)


@pytest.mark.parametrize('bit_rates', [(1000.0,), (504.0, 3125.0)])
def test_what_dense_noise_has_begun_is_lost_when_there_is_less_of_it(bit_rates: tuple[float, ...]) -> None:
    size = (160, 120)
    dense, thin = noise(*size, 45.0 * size[0] * size[1], 0.4), noise(*size, 11.0 * size[0] * size[1], 2.8, seed=10)
    thin = batch(thin.x, thin.y, thin.polarity, thin.t_ns + 400_000_000)
    detector = Detector(Parameters(bit_rates=bit_rates), size)
    tracks = []
    detect(detector, merged(dense, thin, along(still(80.0, 60.0), 0.0, 3.2)), lambda *_: tracks.append(len(detector.tracks)))
    assert max(tracks[:50]) > 40
    assert list(detector.tracks) == [1]
    assert detector.tracks[1].position_at(T0_NS + 3_200_000_000) == pytest.approx((80.0, 60.0), abs=1.0)


def test_lights_of_a_single_pixel_side_by_side_are_followed() -> None:
    """Their blobs have no extent, and their events may be of either."""
    t_ns = T0_NS + np.arange(0, 300_000_000, 200_000)
    polarity = np.where(np.arange(len(t_ns)) // 50 % 2, 1, -1)
    lights = [batch(np.full(len(t_ns), x), np.full(len(t_ns), 20), polarity, t_ns + x) for x in (20, 22)]
    detector = Detector(Parameters(min_area_px=1, closing_px=1), (60, 40))
    detect(detector, merged(*lights))
    places = sorted((round(track.x_px), round(track.y_px)) for track in detector.tracks.values())
    assert places and set(places) <= {(20, 20), (21, 20), (22, 20)}


def test_an_observation_that_is_far_off_for_once_is_doubted() -> None:
    def row(speed: float) -> np.ndarray:
        state = np.zeros(motion.WIDTH)
        motion.begin(state, 0.0, 100.0, 100.0, speed, 0.0, 0.01, 100.0)
        state[motion.EXTENT] = 4.0
        return state

    slow = row(300.0)
    assert _doubted(slow, 1e-3, 0.1, 0.1, 0.04) == 0.04  # as expected
    assert _doubted(slow, 1e-3, 3.0, -3.0, 0.04) == pytest.approx(0.04 + 2.0**2)  # half a radius: the first rows of a burst
    assert _doubted(slow, 1e-3, 4.0, -2.0, 0.04) == 0.04  # again: it moves
    assert _doubted(slow, 1e-3, 0.1, 0.0, 0.04) == 0.04
    assert _doubted(slow, 1e-3, 3.0, 3.0, 0.04) > 4.0
    assert _doubted(slow, 1e-3, -3.0, -3.0, 0.04) > 4.0  # to the other side is not again
    assert _doubted(row(3000.0), 1e-3, 4.0, 4.0, 0.04) == 0.04  # a fast one may have turned back
