"""Tracks at a hop, as their own events have left them."""

import pytest

from beacon_comm.core import motion
from beacon_comm.core.blobs import Blob
from beacon_comm.core.motion_tracks import MotionTrack, MotionTracker, Steady
from beacon_comm.core.parameters import Parameters

T0_NS = 1_000_000_000
HOP_NS = 10_000_000


def track_at(track_id, x_px, speed=0.0, **options):
    """Return a track that had as many events of its own as usual."""
    track = MotionTrack(
        track_id, x_px, 100.0, T0_NS, 4.0, 1.0, 0, T0_NS, matched_ns=T0_NS, origin_ns=T0_NS, **options
    )  # fmt: skip
    motion.begin(track.row, 0.0, x_px, 100.0, speed, 0.0, 0.01, 100.0)
    track.settle()
    values = {
        motion.EXTENT: 4.0, motion.HOP_ON: 500.0, motion.HOP_OFF: 500.0, motion.HOP_RR: 8000.0, motion.USUAL: 1e4,
        motion.LAST: 0.009, motion.TRUST: 1.0,
    }  # fmt: skip
    track.row[list(values)] = list(values.values())
    return track


def test_a_track_that_jumped_does_not_return_to_one_that_is_merged_at_that_hop():
    tracker = MotionTracker(Parameters(), (640, 480))
    read = track_at(1, 200.0, bit_rate_bps=1000.0)
    double = track_at(2, 201.0, covered_since_ns=T0_NS - 590_000_000)
    jumped = track_at(3, 240.0, 1500.0, bit_rate_bps=1000.0, steady=Steady(201.0, 100.0, 0.0, 0.0, 4.0, T0_NS))
    for track in (read, double, jumped):
        tracker._tracks[track.track_id] = track
    changes = tracker.update([], T0_NS + HOP_NS)
    assert [track.track_id for track in changes.lost] == [2]
    assert abs(read.x_px - 200.0) < 1.0 and jumped.x_px > 230.0


def test_two_tracks_that_are_exchanged_are_where_the_other_one_was():
    tracker = MotionTracker(Parameters(), (640, 480))
    one, other = track_at(1, 200.0, bit_rate_bps=1000.0), track_at(2, 300.0, 50.0, bit_rate_bps=500.0)
    tracker._tracks.update({1: one, 2: other})
    tracker.exchange(1, 2)
    assert (one.x_px, other.x_px) == (300.0, 200.0)
    assert (one.vx_px_per_s, other.vx_px_per_s) == (50.0, 0.0)
    assert (one.bit_rate_bps, other.bit_rate_bps) == (1000.0, 500.0)  # what they are stays
    assert one.row[motion.X] == 300.0 and other.row[motion.X] == 200.0


@pytest.mark.parametrize(('extent_px', 'moves'), [(4.0, True), (60.0, False)])
def test_a_track_that_jumped_goes_on_in_one_that_moves_as_it_did_and_is_of_about_its_size(extent_px, moves):
    tracker = MotionTracker(Parameters(), (640, 480))
    jumped = track_at(1, 240.0, 1500.0, bit_rate_bps=1000.0, steady=Steady(201.0, 100.0, 0.0, 0.0, 4.0, T0_NS))
    other = track_at(2, 202.0)
    other.extent_px = other.row[motion.EXTENT] = extent_px
    other.row[motion.HOP_RR] *= (extent_px / 4.0) ** 2
    for track in (jumped, other):
        tracker._tracks[track.track_id] = track
    tracker.update([], T0_NS + HOP_NS)
    assert (abs(jumped.x_px - 202.0) < 2.0) == moves


def hops(tracker, count):
    """Give the tracker hops without blobs, each track's events as they were in the first; return the labels lost."""
    lost = []
    rows = {track_id: track.row.copy() for track_id, track in tracker.tracks.items()}
    for k in range(1, count + 1):
        for track_id, track in tracker.tracks.items():
            track.row[motion.HOP_OFF : motion.LAST] = rows[track_id][motion.HOP_OFF : motion.LAST]
        lost += [track.track_id for track in tracker.update([], T0_NS + k * HOP_NS).lost]
    return lost


def test_a_track_whose_place_is_known_keeps_its_blob_from_one_that_may_be_anywhere():
    tracker = MotionTracker(Parameters(), (640, 480))
    read, unsure = track_at(1, 200.0, bit_rate_bps=20.0), track_at(2, 205.0)
    for k in range(1, 51):
        read.observe(200.0, 100.0, T0_NS + k * 100_000, 0.05)
    unsure.begin(205.0, 100.0, T0_NS, 0.1, 4e4)  # it has just begun, at an unknown velocity
    for track in (read, unsure):
        tracker._tracks[track.track_id] = track
        track.row[[motion.HOP_ON, motion.HOP_OFF]] = 0.0  # a held bit
    held = Blob(200.2, 100.0, T0_NS, 4.0, 1.0, 4000, 50, 0, False, 1)
    tracker.update([held], T0_NS + 2 * HOP_NS)
    assert not read.quiet and unsure.quiet


@pytest.mark.parametrize(
    ('rates', 'age_s', 'lost'),
    [
        ((None, None), 0.05, [2]), ((1000.0, None), 0.05, [2]), ((None, 1000.0), 0.05, [1]), ((1000.0, 1000.0), 0.05, []),
        ((None, None), 0.5, []), ((1000.0, None), 0.5, []),
    ],
)  # fmt: skip
def test_a_new_double_that_nobody_has_read_ends_before_it_is_read(rates, age_s, lost):
    tracker = MotionTracker(Parameters(), (640, 480))
    for track_id, rate in zip((1, 2), rates, strict=True):
        track = tracker._tracks[track_id] = track_at(track_id, 200.0 + track_id, bit_rate_bps=rate)
        track.first_seen_ns = T0_NS - round(age_s * 1e9)
    assert hops(tracker, 4) == lost


@pytest.mark.parametrize(('rate', 'goes_on'), [(None, True), (1001.0, True), (2000.0, False)])
def test_a_quiet_track_goes_on_in_a_younger_one_there_unless_that_sends_at_another_rate(rate, goes_on):
    tracker = MotionTracker(Parameters(), (640, 480))
    quiet = track_at(1, 203.0, bit_rate_bps=1000.0)
    quiet.row[motion.HOP_OFF] = quiet.row[motion.HOP_ON] = 0.0
    tracker._tracks.update({1: quiet, 2: track_at(2, 200.0, bit_rate_bps=rate)})
    tracker.update([], T0_NS + HOP_NS)
    assert (not quiet.quiet and abs(quiet.x_px - 200.0) < 1.0) == goes_on


@pytest.mark.parametrize(('rate', 'grown_px'), [(None, 22.0), (1000.0, 5.8)])
def test_what_is_read_does_not_grow_at_once(rate, grown_px):
    tracker = MotionTracker(Parameters(), (640, 480))
    track = tracker._tracks[1] = track_at(1, 200.0, bit_rate_bps=rate)
    track.row[motion.HOP_RR] = 0.5 * 1000.0 * 50.0**2  # all over a disc of 50 px
    tracker.update([Blob(200.0, 100.0, T0_NS + HOP_NS // 2, 40.0, 1.0, 2000, 5000, 1000, True, 0)], T0_NS + HOP_NS)
    assert track.extent_px == pytest.approx(grown_px)


def test_a_track_that_was_thrown_off_and_sees_nothing_waits_where_it_would_be():
    tracker = MotionTracker(Parameters(), (640, 480))
    thrown = track_at(1, 240.0, 9000.0, bit_rate_bps=1000.0, steady=Steady(201.0, 100.0, 50.0, 0.0, 5.0, T0_NS))
    thrown.row[motion.HOP_OFF] = thrown.row[motion.HOP_ON] = 0.0
    tracker._tracks[1] = thrown
    tracker.update([], T0_NS + HOP_NS)
    assert thrown.quiet
    assert thrown.position_at(T0_NS + 2 * HOP_NS) == pytest.approx((202.0, 100.0), abs=0.1)


def test_a_beacon_that_went_on_in_another_track_is_known_where_it_is_now():
    tracker = MotionTracker(Parameters(), (640, 480))
    jumped = track_at(1, 240.0, 1500.0, bit_rate_bps=1000.0, steady=Steady(201.0, 100.0, 0.0, 0.0, 4.0, T0_NS))
    other = track_at(2, 202.0)
    for track in (jumped, other):
        tracker._tracks[track.track_id] = track
    tracker.update([], T0_NS + HOP_NS)
    assert jumped.steady is not None and abs(jumped.steady.x_px - 202.0) < 2.0
    assert other.steady is None
