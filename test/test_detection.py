"""Detection end to end: events in, tracks and routed events out; any batching; real backgrounds."""

from dataclasses import replace

import numpy as np
import pytest
from disc_events import HOP_NS, T0_NS, batch, detect, disc, merged, noise
from hypothesis import given, settings
from hypothesis import strategies as st

from beacon_comm.core.detection import Detector
from beacon_comm.core.events import EventBatch
from beacon_comm.core.parameters import Parameters

SIZE = (160, 120)


def busy_scene(duration_s=0.35):
    """Return a still disc, a moving one, one that comes and goes, and noise: some 67 000 events."""
    return merged(
        disc(40.0, 30.0, duration_s=duration_s),
        disc(60.0, 80.0, vx=200.0, duration_s=duration_s, bit_rate_bps=3125.0, seed=1),
        disc(120.0, 30.0, start_s=0.08, duration_s=0.07, seed=2),
        noise(*SIZE, 50_000, duration_s),
    )


def in_pieces(detector, events, cuts):
    """Feed events cut anywhere and at hops; return everything that can be seen of the detector."""
    routed: dict[int, list] = {}
    seen = []
    t_hop = int(events.t_ns[0]) // HOP_NS * HOP_NS + HOP_NS
    at_hops = np.searchsorted(events.t_ns, np.arange(t_hop, events.t_end_ns, HOP_NS))
    bounds = sorted({0, len(events), *at_hops.tolist(), *cuts})
    for start, stop in zip(bounds, bounds[1:], strict=False):
        for track_id, part in detector.route(events.slice(start, stop, int(events.t_ns[stop - 1]))).items():
            routed.setdefault(track_id, []).append(part)
        if stop in at_hops:
            changes = detector.hop(t_hop)
            new, lost = ([track.track_id for track in tracks] for tracks in (changes.new, changes.lost))
            seen.append((t_hop, new, lost, detector.index_threshold))
            seen.append([repr(track) for track in detector.tracks.values()])
            seen.append([tuple(column.tobytes() for column in detector.backlog(i)) for i in detector.tracks])
            t_hop += HOP_NS
    streams = {
        i: (np.concatenate([p.t_ns for p in parts]).tobytes(), np.concatenate([p.polarity for p in parts]).tobytes())
        for i, parts in routed.items()
    }
    return streams, seen, detector.stats


SCENE = busy_scene()
CLUTTERED = merged(SCENE, *(disc(15.0 + 20.0 * k, 105.0, start_s=0.1, duration_s=0.1, seed=k) for k in range(7)))
BATCHING = Parameters(lost_after_s=0.05, bit_rates=(200.0, 3125.0))


@settings(max_examples=20, deadline=None)
@given(st.sampled_from([64, 1]), st.lists(st.integers(1, len(CLUTTERED) - 1), max_size=60))
def test_any_batching_gives_the_same(new_tracks_burst, cuts):
    parameters = replace(BATCHING, new_tracks_burst=new_tracks_burst)
    whole = in_pieces(Detector(parameters, SIZE), CLUTTERED, [])
    assert in_pieces(Detector(parameters, SIZE), CLUTTERED, cuts) == whole
    assert len(whole[0]) >= 3 and any(lost for _, _, lost, _ in whole[1][::3])
    assert any(threshold > 0.6 for _, _, _, threshold in whole[1][::3]) == (new_tracks_burst == 1)


@pytest.mark.parametrize('rests', [1, 9])
def test_a_rest_changes_nothing_that_is_counted(rests):
    """Not even before a restart, where a hop's work may be left."""
    parameters = Parameters(buffer_max_bytes=9000)
    idle, rested = Detector(parameters, SIZE), Detector(parameters, SIZE)
    for size in (SIZE, SIZE, (200, 150)):
        detect(idle, SCENE)
        detect(rested, SCENE, lambda *_: [rested.rest() for _ in range(rests)])
        idle.resize(size)
        rested.resize(size)
    assert idle.stats == rested.stats and idle.stats.buffer_overflow_events > 0


def test_every_event_is_routed_at_most_once_and_only_to_a_track_that_is_near():
    events = busy_scene()
    routed = detect(Detector(Parameters(), SIZE), events)
    taken = np.concatenate([part.t_ns for parts in routed.values() for part in parts])
    assert len(np.unique(events.t_ns)) == len(events)  # so that times name events
    assert len(np.unique(taken)) == len(taken)
    assert np.isin(taken, events.t_ns).all()
    for parts in routed.values():
        assert (np.diff(np.concatenate([part.t_ns for part in parts])) > 0).all()


def test_backlog_and_routed_events_are_one_gapless_stream():
    """From the first event on: the new track's window, then what is routed."""
    detector = Detector(Parameters(), SIZE)
    events = disc(40.0, 30.0, duration_s=0.3)
    streams: dict[int, np.ndarray] = {}

    def at_hop(t_hop, changes):
        for track in changes.new:
            streams[track.track_id] = detector.backlog(track.track_id)[0]
            assert streams[track.track_id].max() < t_hop

    routed = detect(detector, events, at_hop)
    assert list(streams) == [1]
    stream = np.concatenate([streams[1], *(part.t_ns for part in routed[1])])
    assert (np.diff(stream) >= 0).all()
    np.testing.assert_array_equal(stream, detector.backlog(1)[0])
    assert len(stream) > 0.995 * len(events)
    polarity = dict(zip(events.t_ns.tolist(), events.polarity.tolist(), strict=True))
    for t_ns, sign in zip(*(a.tolist() for a in detector.backlog(1)), strict=True):
        assert polarity[t_ns] == sign


def test_a_new_track_does_not_get_what_went_to_another():
    """The second disc begins beside a track, whose circle holds some of its events."""
    detector = Detector(Parameters(), SIZE)
    second = disc(51.6, 30.0, start_s=0.1, duration_s=0.2, seed=3)
    events = merged(disc(40.0, 30.0, duration_s=0.3), second)
    kept = {}

    def at_hop(t_hop, changes):
        for track in changes.new:
            kept[track.track_id] = detector.backlog(track.track_id)[0]

    routed = detect(detector, events, at_hop)
    assert len(kept) == 2
    begin = kept[2].max()
    assert any(np.isin(p.t_ns[p.t_ns < begin], second.t_ns).any() for p in routed[1])
    everything = np.concatenate([*kept.values(), *(p.t_ns for parts in routed.values() for p in parts)])
    assert len(np.unique(everything)) == len(everything)


def test_the_buffer_holds_no_more_than_its_length():
    parameters = Parameters(bit_rates=(3125.0,), buffer_min_s=0.1, buffer_characters=1)
    detector = Detector(parameters, SIZE)
    detect(detector, disc(40.0, 30.0, duration_s=0.5))
    t_ns = detector.backlog(1)[0]
    assert 0.09e9 < t_ns[-1] - t_ns[0] <= 0.1e9
    bounded = Detector(Parameters(buffer_max_bytes=9000), SIZE)
    detect(bounded, disc(40.0, 30.0, duration_s=0.5))
    assert len(bounded.backlog(1)[0]) == 1000
    assert bounded.stats.buffer_overflow_events > 20_000


@pytest.mark.parametrize('radius_px', [1.0, 2.0, 4.0, 10.0])
def test_a_still_disc_is_one_track_that_gets_all(radius_px):
    density = 128 * 504.0 / 49  # per pixel, as the real beacon's
    events = disc(60.0, 60.0, radius_px, rate_per_s=density * max(4.0, np.pi * radius_px**2))
    detector = Detector(Parameters(), SIZE)
    detect(detector, events)
    assert detector.stats.new_tracks == 1
    assert detector.stats.routed_events > 0.98 * len(events)
    assert detector.tracks[1].extent_px == pytest.approx(radius_px, abs=0.4)


@pytest.mark.parametrize('distance_radii', [3, 4, 6])
def test_two_discs_are_two_tracks(distance_radii):
    other = disc(50.0 + 4.0 * distance_radii, 60.0, seed=4)
    detector = Detector(Parameters(), SIZE)
    routed = detect(detector, merged(disc(50.0, 60.0), other))
    assert detector.stats.new_tracks == 2
    for x_px, own in ((50.0, None), (50.0 + 4.0 * distance_radii, other)):
        (track,) = (t for t in detector.tracks.values() if abs(t.x_px - x_px) < 1)
        if own is not None:
            taken = np.concatenate([part.t_ns for part in routed[track.track_id]])
            assert np.isin(taken, own.t_ns).mean() > 0.97


@pytest.mark.parametrize(('speed', 'duration_s'), [(50.0, 5.0), (500.0, 1.0)])
def test_a_moving_disc_keeps_one_label_and_its_centre_does_not_lag(speed, duration_s):
    detector = Detector(Parameters(), (640, 120))
    events = disc(40.0, 60.0, vx=speed, duration_s=duration_s, rate_per_s=30 * 504.0)
    error = []

    def at_hop(t_hop, changes):
        for track in detector.tracks.values():
            for t_ns in (t_hop, t_hop + 5_000_000):
                x, y = track.position_at(t_ns)
                error.append((x - 40.0 - speed * (t_ns - T0_NS) / 1e9, y - 60.0))

    detect(detector, events, at_hop)
    assert detector.stats.new_tracks == 1
    assert np.sqrt(np.mean(np.square(error[10:]), axis=0)) == pytest.approx((0, 0), abs=0.3)
    assert np.abs(np.mean(error[10:], axis=0)).max() < 0.1
    assert detector.stats.routed_events > 0.97 * len(events)


@pytest.mark.parametrize(('gap_s', 'labels'), [(1.5, [1]), (2.2, [2])])
def test_a_beacon_that_comes_back(gap_s, labels):
    detector = Detector(Parameters(), SIZE)
    first = disc(40.0, 30.0, duration_s=0.4)
    back = disc(40.0, 30.0, start_s=0.4 + gap_s, duration_s=0.2, seed=1)
    detect(detector, merged(first, back))
    assert list(detector.tracks) == labels
    assert not detector.tracks[labels[0]].quiet


def test_a_slow_beacon_is_one_track():
    parameters = Parameters(bit_rates=(20.0, 3125.0))
    detector = Detector(parameters, SIZE)
    events = disc(60.0, 60.0, rate_per_s=49 * 60.0, bit_rate_bps=20.0, duration_s=3.0)
    bits = np.round((events.t_ns - T0_NS) / 1e9 * 20) / 20
    bursts = np.abs((events.t_ns - T0_NS) / 1e9 - bits) < 0.005  # events only around the edges
    index = np.flatnonzero(bursts)
    events = batch(events.x[index], events.y[index], events.polarity[index], events.t_ns[index])
    events = merged(events, disc(60.0, 60.0, rate_per_s=49 * 30.0, bit_rate_bps=20.0, duration_s=3.0))
    detect(detector, events)
    assert detector.stats.new_tracks == 1
    assert (detector.tracks[1].x_px, detector.tracks[1].y_px) == pytest.approx((60, 60), abs=0.5)


def test_jumps_over_hours_of_silence_are_exact_and_quick():
    """One call over the gap gives the same tracks as a call at every hop; then nothing is left to do."""
    early, late = disc(40.0, 30.0, duration_s=0.2), disc(40.0, 30.0, start_s=3.0, duration_s=0.2, seed=1)
    stepwise, jumping = Detector(Parameters(), SIZE), Detector(Parameters(), SIZE)
    detect(stepwise, merged(early, late))
    detect(jumping, early)
    detect(jumping, late)
    assert [repr(t) for t in jumping.tracks.values()] == [repr(t) for t in stepwise.tracks.values()]
    assert list(jumping.tracks) == [2]
    year = T0_NS // HOP_NS * HOP_NS + 365 * 86400 * 10**9
    changes = jumping.hop(year)
    assert [track.track_id for track in changes.lost] == [2]
    assert jumping.idle and jumping.stats.hops < 800


def test_labels_are_never_given_again():
    detector = Detector(Parameters(), SIZE)
    labels = []
    for restart in (detector.reset, lambda: detector.resize((200, 100)), lambda: detector.resize(SIZE)):
        detect(detector, merged(disc(40.0, 30.0, duration_s=0.1), disc(80.0, 60.0, duration_s=0.1)))
        labels += list(detector.tracks)
        lost = restart().lost
        assert [track.track_id for track in lost] == labels[-2:]
        assert not detector.tracks and detector.idle
    assert labels == [1, 2, 3, 4, 5, 6]
    assert detector.stats.lost_tracks == 6


def test_more_blobs_than_tracks_wait():
    discs = [disc(15.0 + 25 * k, 30.0, duration_s=0.1, seed=k, rate_per_s=4e4 + 1e4 * k) for k in range(5)]
    detector = Detector(Parameters(max_tracks=2), SIZE)
    detect(detector, merged(*discs))
    assert len(detector.tracks) == 2 and detector.stats.waiting_blobs in (0, 3)
    assert detector.stats.new_tracks == 2


def test_nothing_comes_of_nothing():
    detector = Detector(Parameters(), SIZE)
    assert detector.route(EventBatch.empty(T0_NS)) == {}
    assert detector.hop(T0_NS // HOP_NS * HOP_NS) == detector.hop(T0_NS // HOP_NS * HOP_NS)
    assert detector.idle and not detector.tracks
    with pytest.raises(KeyError):
        detector.backlog(1)


def real_events(folder):
    """Return all events of a bag and the sensor's size."""
    from beacon_comm.recordings.bags import open_recording
    from beacon_comm.wire.stream import EventStream

    with open_recording(folder) as bag:
        topic = bag.event_topic()
        stream = EventStream(topic.type)
        decoded = [stream.push(message[1]) for message in bag.messages(topic)]
    batches = [d.batch for d in decoded if d.batch is not None]
    columns = (np.concatenate([getattr(b, name) for b in batches]) for name in ('x', 'y', 'polarity', 't_ns'))
    return batch(*columns), (decoded[0].width, decoded[0].height)


@pytest.mark.parametrize('name', ['evt3_static', 'libcaer_grid'])
def test_a_beacon_on_a_real_background_is_one_track(data_folder, name):
    """Strong lamp flicker, and moving edges everywhere: one label, the centre within half a pixel."""
    background, size = real_events(data_folder / name)
    seconds = (background.t_ns - background.t_ns[0]) / 1e9
    first = seconds < 1.0
    background = batch(
        background.x[first],
        background.y[first],
        background.polarity[first],
        T0_NS + (seconds[first] * 1e9).astype(np.int64),
    )
    detector = Detector(Parameters(), size)
    seen = []

    def at_hop(t_hop, changes):
        x, y = 100.0 + 50.0 * (t_hop - T0_NS) / 1e9, 120.0
        for track in detector.tracks.values():
            if np.hypot(*np.subtract(track.position_at(t_hop), (x, y))) < 6.0:
                seen.append((track.track_id, *np.subtract(track.position_at(t_hop), (x, y))))

    detect(detector, merged(background, disc(100.0, 120.0, vx=50.0)), at_hop)
    assert len(seen) > 98 and len({track_id for track_id, _, _ in seen}) == 1
    error = np.array(seen)[:, 1:]
    assert np.sqrt((error**2).mean(axis=0)) == pytest.approx((0, 0), abs=0.2)
    assert detector.stats.new_tracks < 40
