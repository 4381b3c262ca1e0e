"""Clutter: the index threshold rises with the rate of new tracks, and falls again by itself."""

import numpy as np
import pytest
from disc_events import HOP_NS, T0_NS, batch, detect, disc, gathered, merged, noise
from hypothesis import given
from hypothesis import strategies as st

from beacon_comm.core.clutter import CROWD, DOUBLING, MOST_DOUBLINGS, Clutter
from beacon_comm.core.detection import Detector
from beacon_comm.core.events import NS_PER_S, EventBatch
from beacon_comm.core.index_image import IndexImages
from beacon_comm.core.parameters import Parameters
from beacon_comm.core.receiver import Receiver

SIZE = (160, 120)
ALLOWED = Parameters(new_tracks_burst=20, new_tracks_per_s=5.0)


def test_the_threshold_stays_where_it_was_set_within_the_allowance():
    clutter = Clutter(ALLOWED)
    clutter.count(20, 0, HOP_NS)
    for k in range(2, 400):
        clutter.count(1 if k % 20 == 0 else 0, 0, k * HOP_NS)  # 5 a second
        assert clutter.threshold == ALLOWED.index_threshold


def test_new_tracks_beyond_the_allowance_double_it_and_time_halves_it_again():
    clutter = Clutter(ALLOWED)
    clutter.count(20 + DOUBLING, 0, HOP_NS)
    assert clutter.threshold == pytest.approx(2 * ALLOWED.index_threshold)
    clutter.count(0, 0, HOP_NS + round(DOUBLING / 5.0 * NS_PER_S))
    assert clutter.threshold == pytest.approx(ALLOWED.index_threshold)


def test_tracks_that_are_read_were_no_clutter():
    clutter = Clutter(ALLOWED)
    clutter.count(20 + 2 * DOUBLING, 0, HOP_NS)
    clutter.count(0, DOUBLING, HOP_NS)
    assert clutter.threshold == pytest.approx(2 * ALLOWED.index_threshold)
    clutter.count(0, 1000, HOP_NS)
    assert clutter.threshold == ALLOWED.index_threshold and clutter.most_new == 20 + DOUBLING


@given(st.lists(st.integers(0, 1000), min_size=50, max_size=300))
def test_it_is_bounded_and_so_is_the_time_that_it_takes_to_fall(new):
    clutter = Clutter(ALLOWED)
    for k, count in enumerate(new):
        clutter.count(min(count, clutter.most_new), 0, k * HOP_NS)
        assert 1.0 <= clutter.threshold / ALLOWED.index_threshold <= 2.0**MOST_DOUBLINGS
        assert DOUBLING <= clutter.most_new <= 20 + DOUBLING
    falls_ns = round((20 + DOUBLING * MOST_DOUBLINGS) / 5.0 * NS_PER_S)
    clutter.count(0, 0, len(new) * HOP_NS + falls_ns)
    assert clutter.threshold == ALLOWED.index_threshold and clutter.most_new == 20 + DOUBLING


def grain(duration_s: float, start_s: float = 0.0, seed: int = 5) -> EventBatch:
    """Return squares of 3 x 3 pixels that blink for 15 ms, each elsewhere: dozens of small blobs at any time."""
    rng = np.random.default_rng(seed)
    spots = round(2500 * duration_s)
    x, y = rng.integers(1, SIZE[0] - 1, (spots, 1)), rng.integers(1, SIZE[1] - 1, (spots, 1))
    begin_s = start_s + rng.uniform(0.0, duration_s, (spots, 1))
    dy, dx = np.divmod(np.tile(np.arange(9), 12), 3)  # each pixel 12 times
    t_s = np.sort(begin_s + rng.uniform(0.0, 0.015, (spots, len(dx))), axis=1)
    polarity = np.broadcast_to(np.tile(np.repeat([1, -1], 9), 6), t_s.shape)
    order = np.argsort(t_s, axis=None)
    t_ns = T0_NS + (t_s * NS_PER_S).astype(np.int64)
    return batch(*(column.ravel()[order] for column in (x + dx - 1, y + dy - 1, polarity, t_ns)))


def thresholds(detector: Detector, events: EventBatch) -> np.ndarray:
    found: list[float] = []
    detect(detector, events, lambda *_: found.append(detector.index_threshold))
    return np.array(found)


def test_a_detector_in_clutter_begins_few_tracks_and_keeps_the_beacon():
    seconds = 1.5
    events = merged(grain(seconds), disc(80.0, 60.0, radius_px=5.0, duration_s=seconds, rate_per_s=400_000))
    many = Detector(Parameters(new_tracks_burst=1_000_000), SIZE)
    few = Detector(ALLOWED, SIZE)
    assert set(thresholds(many, events)) == {0.6}
    raised = thresholds(few, events)
    assert raised[-1] > 1.0
    assert len(many.tracks) > 100 and len(few.tracks) <= 5
    assert few.stats.new_tracks <= 20 + DOUBLING * (MOST_DOUBLINGS + 1) + 5.0 * seconds
    oldest = next(iter(few.tracks.values()))
    assert abs(oldest.x_px - 80.0) < 1.0 and abs(oldest.y_px - 60.0) < 1.0 and not oldest.quiet


def test_when_the_clutter_ends_a_faint_light_is_found_again():
    dim = disc(40.0, 30.0, start_s=0.7, duration_s=16.0, rate_per_s=20_000)
    detector = Detector(ALLOWED, SIZE)
    raised = thresholds(detector, merged(grain(0.5), dim))
    assert raised.max() > 1.0 and raised[-1] == 0.6
    assert [track for track in detector.tracks.values() if abs(track.x_px - 40.0) < 1.0 and not track.quiet]


def test_what_has_been_read_is_held_at_the_threshold_that_was_set():
    """A beacon whose bit rate is known stays seen where the threshold has risen above it; others do not."""
    dim = disc(40.0, 30.0, duration_s=1.6, rate_per_s=20_000)
    for known_bps in (3125.0, None):
        detector = Detector(ALLOWED, SIZE)
        lost: list[int] = []

        def know(_, changes, detector=detector, lost=lost, known_bps=known_bps):
            lost.extend(track.track_id for track in changes.lost)
            if 1 in detector.tracks:
                detector.tracks[1].bit_rate_bps = known_bps

        detect(detector, merged(dim, grain(1.0, 0.5)), know)
        assert (1 in lost) == (known_bps is None)


def test_pixels_are_found_again_when_the_threshold_changes():
    parameters = Parameters(index_threshold=0.2, index_offset=3.0)
    images = IndexImages(parameters, SIZE)
    events = noise(*SIZE, 3_000_000, 0.01)
    images.push(gathered(events, SIZE))
    for threshold in (0.2, 0.9, 2.0, 0.4):
        images.set_threshold(threshold)
        for window in images.windows:
            np.testing.assert_array_equal(images.low_pixels(window), images.index(window) >= threshold / 2)
    assert images.low_pixels(images.windows[0]).any()


def test_a_restart_of_the_sensor_begins_at_the_threshold_that_was_set():
    detector = Detector(ALLOWED, SIZE)
    assert thresholds(detector, grain(0.5))[-1] > 0.6
    detector.reset()
    assert detector.index_threshold == 0.6


def test_the_receiver_says_what_the_threshold_is():
    receiver = Receiver(ALLOWED, SIZE)
    receiver.push(grain(0.5))
    assert receiver.index_threshold > 0.6


def test_in_clutter_a_track_is_tentative_until_it_has_been_seen_for_a_while():
    events = merged(grain(1.0), disc(80.0, 60.0, radius_px=5.0, start_s=0.5, duration_s=0.5, rate_per_s=400_000))
    detector = Detector(ALLOWED, SIZE)
    ages_ns: dict[bool, list[int]] = {True: [], False: []}

    def look(_, __):
        if detector.index_threshold > ALLOWED.index_threshold:
            for track in detector.tracks.values():
                ages_ns[track.tentative].append(track.last_seen_ns - track.first_seen_ns)

    detect(detector, events, look)
    assert max(ages_ns[True]) < 100_000_000 <= min(ages_ns[False])
    still = [track for track in detector.tracks.values() if abs(track.x_px - 80.0) < 1.0 and abs(track.y_px - 60.0) < 1.0]
    assert len(still) == 1 and not still[0].tentative


@pytest.mark.parametrize('count', [CROWD, CROWD + 1])
def test_what_begins_in_a_crowd_is_tentative_and_nothing_else(count):
    """Before the threshold rises, too: who knows whether more will begin."""
    lights = [disc(20.0 + 30.0 * (k % 5), 15.0 + 25.0 * (k // 5), duration_s=0.3, seed=k) for k in range(count)]
    detector = Detector(Parameters(), SIZE)
    tentative = []
    detect(detector, merged(*lights), lambda *_: tentative.append([one.tentative for one in detector.tracks.values()]))
    assert len(detector.tracks) == count and detector.index_threshold == 0.6
    assert any(map(any, tentative)) == (count > CROWD) and not any(tentative[-1])


@pytest.mark.parametrize('are_read', [True, False])
def test_more_beacons_than_may_begin_at_once_are_all_followed_once_they_are_read(are_read):
    lights = [
        disc(20.0 + 30.0 * (k % 5), 15.0 + 25.0 * (k // 5), duration_s=1.5, rate_per_s=20_000 + 3_000 * k, seed=k)
        for k in range(20)
    ]
    detector = Detector(Parameters(new_tracks_burst=4), SIZE)

    def read(_, __):
        for track in detector.tracks.values():
            if are_read and not track.tentative and track.last_seen_ns - track.first_seen_ns > 50_000_000:
                track.bit_rate_bps = 504.0

    detect(detector, merged(*lights), read)
    assert (len(detector.tracks) == len(lights) and detector.index_threshold == 0.6) == are_read
