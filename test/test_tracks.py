"""Association, labels, prediction, quiet and lost tracks, from blobs made by hand."""

import dataclasses
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from beacon_comm.core.blobs import SPREAD_EVENTS, Blob
from beacon_comm.core.motion_tracks import MotionTracker
from beacon_comm.core.parameters import Parameters
from beacon_comm.core.tracks import Track, Tracker

HOP_NS = 10_000_000
T0_NS = 1 << 40
SIZE = (640, 480)


def blob(x, y, t_ns, index=2.0, extent=4.0, fresh=True, events=1000):
    area = round(math.pi * extent**2)
    return Blob(x, y, t_ns, extent, index, events, area, events // 2 if fresh else 0, fresh, 0)


def follow(tracker, path, hops, start=0, **shape):
    """Let the tracker see one blob a hop at ``path(s)`` (s since T0), observed in the middle of the hop."""
    changes = []
    for k in range(start, start + hops):
        t_ns = T0_NS + k * HOP_NS
        x, y = path((t_ns - T0_NS - HOP_NS / 2) / 1e9)
        changes.append(tracker.update([blob(x, y, t_ns - HOP_NS // 2, **shape)], t_ns))
    return changes


def silence(tracker, start, hops):
    """Let the tracker see nothing."""
    return [tracker.update([], T0_NS + k * HOP_NS) for k in range(start, start + hops)]


def test_one_label_for_one_moving_blob():
    tracker = Tracker(Parameters(), SIZE)
    changes = follow(tracker, lambda s: (10 + 300 * s, 20 - 40 * s), 100)
    assert [len(c.new) for c in changes] == [1] + [0] * 99
    (track,) = tracker.tracks.values()
    assert (track.vx_px_per_s, track.vy_px_per_s) == pytest.approx((300, -40), abs=1)
    assert track.position_at(T0_NS + 1_000_000_000) == pytest.approx((310, -20), abs=0.2)
    assert track.first_seen_ns == T0_NS - HOP_NS // 2
    assert track.last_seen_ns == T0_NS + 99 * HOP_NS - HOP_NS // 2


def test_a_blob_that_turns_back_at_the_border_keeps_its_label():
    tracker = Tracker(Parameters(), SIZE)
    follow(tracker, lambda s: (abs(200 - 400 * s), 50), 100)
    assert list(tracker.tracks) == [1]
    assert tracker.tracks[1].position_at(T0_NS + 990_000_000)[0] == pytest.approx(196, abs=0.5)


def test_a_still_blob_stays_in_silence():
    rng = np.random.default_rng(0)
    tracker = Tracker(Parameters(), SIZE)
    follow(tracker, lambda s: (50 + rng.normal(0, 0.2), 50 + rng.normal(0, 0.2)), 50)
    silence(tracker, 50, 150)
    (track,) = tracker.tracks.values()
    assert track.quiet
    assert track.position_at(T0_NS + 200 * HOP_NS) == pytest.approx((50, 50), abs=1.0)


def test_a_moving_blob_goes_on_in_silence_but_not_without_bounds():
    tracker = Tracker(Parameters(), SIZE)
    follow(tracker, lambda s: (500 * s, 50), 50)
    (track,) = tracker.tracks.values()
    assert track.position_at(T0_NS + 500_000_000)[0] == pytest.approx(250, abs=1)
    silence(tracker, 50, 1)
    assert track.position_at(T0_NS + 590_000_000)[0] == pytest.approx(295, abs=2)
    assert track.position_at(T0_NS + 3600 * 10**9)[0] < 250 + 1.2 * 500


def test_quiet_then_back_is_the_same_track():
    tracker = Tracker(Parameters(), SIZE)
    follow(tracker, lambda s: (50 + 20 * s, 50), 50)
    changes = silence(tracker, 50, 150)
    assert tracker.tracks[1].quiet and not any(c.lost for c in changes)
    follow(tracker, lambda s: (50 + 20 * s, 50), 5, start=200)
    assert list(tracker.tracks) == [1] and not tracker.tracks[1].quiet


def test_a_blob_that_leaves_waits_at_the_border():
    tracker = Tracker(Parameters(), SIZE)
    follow(tracker, lambda s: (400 + 1000 * s, 100 - 20 * s), 23)
    silence(tracker, 23, 100)
    (track,) = tracker.tracks.values()
    x, y = track.position_at(T0_NS + 123 * HOP_NS)
    assert track.quiet and x == SIZE[0] - 1 and y == pytest.approx(95, abs=2)


def test_quiet_for_too_long_is_lost_and_comes_back_under_another_label():
    tracker = Tracker(Parameters(lost_after_s=2.0), SIZE)
    follow(tracker, lambda s: (50, 50), 50)
    changes = silence(tracker, 50, 210)
    lost = [(k, track.track_id) for k, c in enumerate(changes) for track in c.lost]
    assert lost == [(199, 1)]  # the first hop 2 s after the last observation, half a hop before hop 49
    changes = follow(tracker, lambda s: (50, 50), 1, start=260)
    assert [track.track_id for track in changes[0].new] == [2]


def test_the_gate_grows_within_bounds():
    parameters = Parameters(association_gate_px=12.0, gate_growth_px_per_s=40.0, max_gate_px=40.0)
    for silent_hops, distance, same in ((1, 11, True), (1, 14, False), (50, 30, True), (150, 38, True), (150, 42, False)):
        tracker = Tracker(parameters, SIZE)
        follow(tracker, lambda s: (100, 100), 30)
        silence(tracker, 30, silent_hops)
        follow(tracker, lambda s, d=distance: (100 + d, 100), 1, start=30 + silent_hops)
        assert (len(tracker.tracks) == 1) == same, (silent_hops, distance)


def test_nearest_pairs_first():
    """Both tracks are in reach of both blobs; the globally nearest pair decides."""
    tracker = Tracker(Parameters(), SIZE)
    tracker.update([blob(50, 50, T0_NS, index=3.0), blob(60, 50, T0_NS, index=2.0)], T0_NS)
    tracker.update([blob(51, 50, T0_NS + HOP_NS), blob(61, 50, T0_NS + HOP_NS)][::-1], T0_NS + HOP_NS)
    assert [round(track.x_px) for track in tracker.tracks.values()] == [51, 61]


def test_two_blobs_never_share_a_track_nor_two_tracks_a_blob():
    tracker = Tracker(Parameters(), SIZE)
    for k in range(100):
        t_ns = T0_NS + k * HOP_NS
        changes = tracker.update([blob(50, 50, t_ns), blob(62, 50, t_ns, index=1.0)], t_ns)
        assert len(changes.new) == (2 if k == 0 else 0)
    assert [round(track.x_px) for track in tracker.tracks.values()] == [50, 62]


def test_of_merging_tracks_the_older_goes_on():
    tracker = Tracker(Parameters(merge_after_s=0.5), SIZE)
    follow(tracker, lambda s: (40, 50), 10)
    lost = []
    for k in range(10, 140):
        t_ns = T0_NS + k * HOP_NS
        second = 60 - 0.2 * (k - 10)
        if second > 49:
            seen = [blob(40, 50, t_ns), blob(second, 50, t_ns)]
        else:
            seen = [blob((40 + max(second, 40)) / 2 + 1, 50, t_ns, extent=6.0)]  # nearer to the younger at first
        lost += [(k, track.track_id) for track in tracker.update(seen, t_ns).lost]
    assert list(tracker.tracks) == [1]
    assert [track_id for _, track_id in lost] == [2]


def test_two_beacons_that_touch_for_a_moment_keep_their_labels():
    tracker = Tracker(Parameters(merge_after_s=0.5), SIZE)
    for k in range(60):
        t_ns = T0_NS + k * HOP_NS
        apart = [blob(50, 50, t_ns), blob(62, 50, t_ns)]
        tracker.update([blob(56, 50, t_ns, extent=8.0)] if 20 <= k < 40 else apart, t_ns)
    assert list(tracker.tracks) == [1, 2]
    assert [round(track.x_px) for track in tracker.tracks.values()] == [50, 62]


def test_pieces_of_a_followed_blob_begin_no_tracks():
    tracker = Tracker(Parameters(), SIZE)
    for k in range(100):
        t_ns = T0_NS + k * HOP_NS
        whole = [blob(50, 50, t_ns, extent=15.0)]
        pieces = [blob(44 + k % 3, 50, t_ns, extent=6.0), blob(57, 50, t_ns, extent=6.0)]
        tracker.update(pieces if k % 2 else whole, t_ns)
    assert list(tracker.tracks) == [1]


def test_the_strongest_get_the_tracks_and_the_others_wait():
    tracker = Tracker(Parameters(max_tracks=3), SIZE)
    seen = [blob(50 * k, 50, T0_NS, index=1.0 + k % 4, events=100 + k) for k in range(8)]
    changes = tracker.update(seen, T0_NS)
    assert changes.waiting == 5
    assert changes.new_blobs == (7, 3, 6)  # by index, then by events
    assert [track.track_id for track in changes.new] == [1, 2, 3]


def test_a_blob_without_new_events_is_seen_but_does_not_move_its_track():
    tracker = Tracker(Parameters(lost_after_s=0.5), SIZE)
    follow(tracker, lambda s: (50, 50), 10)
    follow(tracker, lambda s: (55, 50), 20, start=10, fresh=False)
    track = tracker.tracks[1]
    assert track.x_px == pytest.approx(50, abs=0.1) and not track.quiet
    assert track.last_seen_ns == T0_NS + 9 * HOP_NS - HOP_NS // 2


def test_labels_go_on_after_clearing():
    tracker = Tracker(Parameters(), SIZE)
    follow(tracker, lambda s: (50, 50), 3)
    assert [track.track_id for track in tracker.clear(SIZE).lost] == [1]
    follow(tracker, lambda s: (50, 50), 1)
    assert list(tracker.tracks) == [2]


@settings(max_examples=40, deadline=None)
@given(st.lists(st.lists(st.tuples(st.integers(0, 100), st.integers(0, 100)), max_size=8), max_size=60))
def test_any_blobs(frames):
    """Labels only ever rise, and the tracks are the new ones less the lost ones."""
    tracker = Tracker(Parameters(max_tracks=6, lost_after_s=0.1, merge_after_s=0.05), SIZE)
    alive: set[int] = set()
    last = 0
    for k, frame in enumerate(frames):
        t_ns = T0_NS + k * HOP_NS
        changes = tracker.update([blob(x, y, t_ns, index=1 + x / 7) for x, y in frame], t_ns)
        for track in changes.new:
            assert track.track_id > last
            last = track.track_id
            alive.add(track.track_id)
        alive -= {track.track_id for track in changes.lost}
        assert alive == set(tracker.tracks) and len(alive) <= 6
        followed = [track for track in tracker.tracks.values() if not track.quiet]
        assert len(followed) <= len(frame)


def test_a_better_observation_moves_a_track_more():
    steps = []
    for variance in (0.01, 1.0, 100.0):
        track = Track(1, 50.0, 50.0, T0_NS, 4.0, 1.0, T0_NS, T0_NS, variance=(0.1, 0.0, 1.0))
        track.observe(50.5, 50.0, T0_NS + HOP_NS, variance)
        steps.append(track.x_px - 50.0)
    assert 0.4 < steps[0] < 0.5 and steps[0] > steps[1] > steps[2] > 0


def full(places, t_ns=T0_NS, **marks):
    """A tracker of four tracks, all of them in use."""
    tracker = Tracker(Parameters(max_tracks=4), SIZE)
    tracker.update([blob(x, 50, t_ns) for x in places], t_ns)
    for track in tracker.tracks.values():
        for name, value in marks.items():
            setattr(track, name, value)
    return tracker


def test_without_room_those_in_sight_and_those_with_a_demodulator_stay():
    tracker = full((50, 100, 150, 200))
    seen = [blob(x, 50, T0_NS + HOP_NS) for x in (50, 100, 150, 200, 300)]
    changes = tracker.update(seen, T0_NS + HOP_NS)
    assert (changes.new, changes.lost, changes.waiting) == ((), (), 1)
    tracker = full((50, 100, 150, 200), held=True)
    changes = tracker.update([blob(300, 50, T0_NS + HOP_NS)], T0_NS + HOP_NS)  # all others are quiet
    assert (changes.new, changes.lost, changes.waiting) == ((), (), 1)


def test_room_is_made_by_quiet_tracks_and_then_by_those_that_had_a_turn_the_last_one_first():
    tracker = full((50, 100, 150, 200))
    first, second, third, fourth = tracker.tracks.values()
    first.tried_ns, second.tried_ns = T0_NS - 2, T0_NS - 1
    fourth.held = True
    ended = []
    for k in range(1, 6):
        t_ns = T0_NS + k * HOP_NS
        in_sight = [50, 100] + [300 + 50 * n for n in range(k)]  # 150 and 200 are quiet from now on
        changes = tracker.update([blob(x, 50, t_ns) for x in in_sight], t_ns)
        ended += [track.track_id for track in changes.lost]
        assert len(tracker.tracks) == 4
    assert ended == [3, 2, 1] and sorted(tracker.tracks) == [4, 5, 6, 7]
    assert changes.waiting == 4


def test_more_lamps_than_tracks_take_turns_and_a_weak_beacon_too():
    """Each track is tried for three hops; the strongest lamp must not be back before the weakest blob had its turn."""
    tracker = Tracker(Parameters(max_tracks=4), SIZE)
    turns = []
    for k in range(120):
        t_ns = T0_NS + k * HOP_NS
        seen = [blob(50 * n, 50, t_ns, index=9.0 - n) for n in range(1, 7)] + [blob(400, 50, t_ns, index=0.7)]
        tracker.update(seen, t_ns)
        if k % 3 == 0:
            for track in tracker.tracks.values():
                if track.held:
                    track.held, track.tried_ns = False, t_ns
            queue = sorted(tracker.tracks.values(), key=lambda t: (t.tried_ns or 0, -t.index, t.track_id))
            queue[0].held, queue[0].tried_ns = True, None
            turns.append(round(queue[0].x_px))
    assert set(turns[:8]) == {50, 100, 150, 200, 250, 300, 400}
    assert min(turns.count(x) for x in set(turns)) >= 3


def test_edges_of_a_texture_that_touch_one_another_are_no_light():
    tracker = MotionTracker(Parameters(), SIZE)
    tracker.update([blob(50, 50, T0_NS)], T0_NS)
    web = Blob(53.0, 50.0, T0_NS + HOP_NS, 30.0, 2.0, 1000, 150, 500, True, 0)  # a twentieth of its disc
    changes = tracker.update([web], T0_NS + HOP_NS)
    assert not changes.new
    assert tracker.tracks[1].quiet and tracker.tracks[1].extent_px == 4.0
    few = dataclasses.replace(web, x_px=90.0, fresh_count=SPREAD_EVENTS - 1)  # too few to know their spread
    assert len(tracker.update([few], T0_NS + 2 * HOP_NS).new) == 1
    nearest = Tracker(Parameters(), SIZE)  # the paper's looks at no shape
    assert len(nearest.update([web], T0_NS + HOP_NS).new) == 1


def test_a_ring_light_begins_a_track():
    ring = Blob(50.0, 50.0, T0_NS, 28.0, 2.0, 1000, round(math.pi * (21.5**2 - 18.5**2)), 500, True, 0)
    assert len(MotionTracker(Parameters(), SIZE).update([ring], T0_NS).new) == 1
