"""Whole simulated scenes: physics, truth and determinism, on small sensors."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from beacon_comm.core.errors import ParameterError
from beacon_comm.core.events import EventBatch
from beacon_comm.core.framing import CharacterFrame
from beacon_comm.simulation.description import (
    BackgroundKeys,
    BeaconKeys,
    Led,
    Reflection,
    SceneDescription,
    Sensor,
    Texture,
    make_description,
)
from beacon_comm.simulation.line import line_of
from beacon_comm.simulation.paths import Circle, Line, Shake, Still
from beacon_comm.simulation.readout import Readout
from beacon_comm.simulation.scene import SimulatedScene, simulate
from beacon_comm.simulation.truth import SceneTruth

# All by hand, so that a new calibration changes no test.
QUIET = Sensor(
    *(64, 64, 0.22, 0.22, 0.05, 0.03, 60.0, 40.0, 90.0, 0.03),
    leak_hz=0.0,
    photon_noise=0.0,
    noise_hz=0.0,
    hot_share=0.0,
    psf_px=1.5,
    scan_us=0.0,
)
SQUARE = Led(rise_us=1.0, fall_us=1.0, rise_slew_us=1.0, fall_slew_us=1.0, contrast=20.0)
MS = 1_000_000


def beacon(**keys) -> BeaconKeys:
    return BeaconKeys(**{'text': 'Hello', 'led': SQUARE, 'start_s': 0.005, 'path': Still((31.5, 31.5)), **keys})


def scene(*beacons: BeaconKeys, duration_s: float = 0.2, sensor: Sensor = QUIET, **keys) -> SceneDescription:
    return SceneDescription(duration_s=duration_s, beacons=beacons, sensor=sensor, **keys)


def run(description: SceneDescription, seed: int = 0, **keys) -> tuple[EventBatch, SceneTruth]:
    batches, truth = simulate(description, seed, **keys)
    parts = list(batches)
    assert all(np.all(one.t_ns < one.t_end_ns + 1000) for one in parts)
    joined = (np.concatenate([getattr(one, name) for one in parts]) for name in ('x', 'y', 'polarity', 't_ns'))
    return EventBatch(*joined, parts[-1].t_end_ns), truth


def same(a: EventBatch, b: EventBatch) -> bool:
    return all(np.array_equal(getattr(a, name), getattr(b, name)) for name in ('x', 'y', 'polarity', 't_ns'))


@settings(max_examples=12, deadline=None)
@given(
    bit_rate_bps=st.sampled_from([100.0, 504.0, 1000.0, 3125.0]),
    speed=st.floats(0.0, 8000.0),
    direction=st.floats(-180.0, 180.0),
    noise_hz=st.floats(0.0, 20.0),
    seed=st.integers(0, 1000),
)
def test_events_are_in_order_on_the_sensor_and_in_whole_microseconds(bit_rate_bps, speed, direction, noise_hz, seed) -> None:
    path = Line((30.0, 20.0), (speed,), direction)
    description = scene(
        beacon(bit_rate_bps=(bit_rate_bps,), path=path), duration_s=0.03, sensor=replace(QUIET, noise_hz=noise_hz)
    )
    events, _ = run(description, seed)
    assert np.all(np.diff(events.t_ns) >= 0) and not np.any(events.t_ns % 1000)
    assert np.all((events.x < 64) & (events.y < 64)) and set(np.unique(events.polarity)) <= {-1, 1}


def test_the_seed_decides_all_and_the_pieces_nothing() -> None:
    description = scene(
        beacon(path=Circle((31.5, 31.5), 15.0, (500.0,))),
        duration_s=0.06,
        sensor=replace(QUIET, noise_hz=5.0, photon_noise=0.02),
        background=BackgroundKeys(texture=Texture()),
        shake=Shake(2.0, 8.0),
    )
    first, _ = run(description, 1)
    assert same(first, run(description, 1)[0])
    assert same(first, run(description, 1, piece_s=0.003)[0])
    assert not same(first, run(description, 2)[0])


def test_each_level_gives_its_polarity_within_a_refractory_time_or_two() -> None:
    events, truth = run(scene(beacon(bit_rate_bps=(1000.0,))))
    (one,) = truth.beacons
    level = np.concatenate(([1], one.levels))[np.searchsorted(one.changes_ns, events.t_ns - 150_000, side='right')]
    settled = np.searchsorted(one.changes_ns, events.t_ns, side='right') == np.searchsorted(
        one.changes_ns, events.t_ns - 150_000, side='right'
    )
    assert settled.sum() > 500
    assert np.all(events.polarity[settled] == np.where(level[settled] == 1, 1, -1))


def test_an_edge_gives_as_many_events_as_its_log_step_holds_thresholds() -> None:
    """Without reset time, mismatch and noise: each pixel's ON events are ⌊ln(1 + contrast) / θ⌋."""
    even = replace(QUIET, threshold_mismatch=0.0, threshold_noise=0.0)
    sensor = replace(even, refractory_us=0.0, photoreceptor_us=0.0, follower_us=100.0)
    slow = replace(SQUARE, rise_us=2000.0, fall_us=500.0)
    events, truth = run(scene(beacon(text='U', bit_rate_bps=(100.0,), led=slow, path=Still((31.0, 31.0))), sensor=sensor))
    rises = truth.beacons[0].changes_ns[truth.beacons[0].levels == 1]
    mine = (events.x == 31) & (events.y == 31) & (events.t_ns > rises[0]) & (events.t_ns < rises[0] + 9.9 * MS)
    swing = np.log1p(20.0) / sensor.threshold_on
    assert abs(np.count_nonzero(events.polarity[mine] > 0) - swing) <= 2.0


def test_a_refractory_time_is_kept_by_every_pixel() -> None:
    sensor = replace(QUIET, refractory_us=200.0, refractory_mismatch=0.0)
    events, _ = run(scene(beacon(bit_rate_bps=(3125.0,)), sensor=sensor))
    pixel = events.y.astype(int) * 64 + events.x
    order = np.lexsort((events.t_ns, pixel))
    gaps = np.diff(events.t_ns[order])[np.diff(pixel[order]) == 0]
    assert len(gaps) > 500 and gaps.min() >= 190_000  # read out some microseconds later or earlier


@pytest.mark.parametrize(
    'path',
    [
        Still((20.3, 40.8)),
        Line((20.0, 20.0), (300.0,), 30.0),
        Line((32.0, 32.0), (3000.0,), 70.0),
        Circle((31.0, 30.0), 15.0, (1000.0,)),
    ],
)
def test_the_truth_is_where_the_events_are(path) -> None:
    events, truth = run(scene(beacon(path=path, bit_rate_bps=(1000.0,))))
    x, y = truth.beacons[0].centre(events.t_ns)
    radius = truth.beacons[0].radius_px(events.t_ns)
    near = np.hypot(events.x - x, events.y - y) < radius + 6.0
    assert near.mean() > 0.95
    assert np.mean((events.x - x)[near]) == pytest.approx(0.0, abs=0.25)
    assert np.mean((events.y - y)[near]) == pytest.approx(0.0, abs=0.25)


def test_a_still_spot_is_as_wide_as_the_truth_says_and_fades_with_the_square_of_the_distance() -> None:
    sensor = replace(QUIET, threshold_mismatch=0.0, threshold_noise=0.0)
    radii = []
    for metres in (30.0, 60.0):
        events, truth = run(scene(beacon(distance_m=(metres,), bit_rate_bps=(200.0,)), sensor=sensor))
        distance = np.hypot(events.x - 31.5, events.y - 31.5)
        radius = float(truth.beacons[0].radius_px(0))
        assert distance.max() == pytest.approx(radius, abs=1.0)
        radii.append(radius)
    # A Gaussian of a quarter of the height reaches θ at a squared radius smaller by 2 σ² ln 4.
    assert radii[0] ** 2 - radii[1] ** 2 == pytest.approx(2 * sensor.psf_px**2 * np.log(4.0), rel=0.05)


def test_what_is_hidden_gives_nothing_and_what_idles_gives_nearly_nothing() -> None:
    description = scene(
        beacon(occluded_s=((0.05, 0.08),), idle_s=((0.1, 0.14),), shown_s=(0.0, 0.17), text='Hello ' * 20), sensor=QUIET
    )
    events, truth = run(description)

    def count(begin_s: float, end_s: float) -> int:
        return int(np.count_nonzero((events.t_ns >= begin_s * 1e9) & (events.t_ns < end_s * 1e9)))

    assert count(0.02, 0.04) > 300
    assert count(0.055, 0.078) == count(0.11, 0.138) == count(0.18, 0.2) == 0
    one = truth.beacons[0]
    assert one.visible([40 * MS, 60 * MS, 90 * MS, 180 * MS]).tolist() == [True, False, True, False]
    sent = CharacterFrame().duration_ns(1000.0)
    assert not np.any((one.characters_ns + sent > 100 * MS + 1) & (one.characters_ns < 140 * MS))
    assert one.sendings_ns.tolist() == [5 * MS, 140 * MS]


@given(st.floats(50, 4000), st.floats(-300, 300), st.floats(0, 40), st.text('abcU~ ', min_size=1, max_size=8))
def test_a_line_says_what_its_characters_are(bit_rate_bps, clock_ppm, gap_bits, text) -> None:
    keys = BeaconKeys(text=text, bit_rate_bps=(bit_rate_bps,), clock_ppm=clock_ppm, gap_bits=gap_bits, idle_s=((0.4, 0.5),))
    line = line_of(keys, 1.0)
    bit_ns = 1e9 / line.bit_rate_bps
    assert line.bit_rate_bps == pytest.approx(bit_rate_bps * (1 + 1e-6 * clock_ppm))
    assert np.all(np.diff(line.changes_ns) > 0) and np.all(np.abs(np.diff(line.levels.astype(int))) == 1)
    frame = CharacterFrame()
    for start, code in zip(line.characters_ns, line.codes, strict=True):
        middles = start + (np.arange(11) + 0.5) * bit_ns
        bits = np.concatenate(([1], line.levels))[np.searchsorted(line.changes_ns, middles, side='right')]
        assert int(''.join(map(str, bits)), 2) == frame.frame_of(int(code))


def test_a_bus_that_is_too_slow_delays_and_loses_events() -> None:
    sensor = replace(QUIET, noise_hz=500.0, row_us=1.0, pixel_us=1.0, longest_wait_us=300.0)  # 2.05 Mev/s asked
    fast = SimulatedScene(scene(sensor=replace(sensor, pixel_us=0.0)), 3)
    slow = SimulatedScene(scene(sensor=sensor), 3)
    counts = [sum(len(batch) for batch in one.batches()) for one in (fast, slow)]
    assert fast.readout.lost == 0 and slow.readout.lost > 0.2 * counts[0]
    assert counts[1] <= 0.2 * 1e6  # a microsecond an event at least
    assert counts[0] - counts[1] == pytest.approx(slow.readout.lost, abs=1000)  # some still wait at the end


def test_with_scans_a_pixel_fires_once_a_scan_and_the_spot_in_bursts() -> None:
    sensor = replace(QUIET, refractory_us=5.0, refractory_mismatch=0.0, scan_us=100.0, scan_jitter=0.0, scan_row_us=1.0)
    events, _ = run(scene(beacon(bit_rate_bps=(3125.0,)), sensor=sensor))
    assert np.all((events.t_ns // 1000 - events.y) % 100 <= 20)  # its row's turn; the bus takes some time
    pixel = (events.y.astype(int) * 64 + events.x) * 10_000_000 + events.t_ns // 100_000
    assert len(np.unique(pixel)) > 0.98 * len(pixel) > 500


def test_pixels_of_a_row_that_wait_share_a_stamp() -> None:
    columns = np.array([5, 9, 7, 3], np.uint16), np.array([2, 2, 2, 8], np.uint16), np.array([1, 1, -1, 1], np.int8)
    readout = Readout(replace(QUIET, row_us=10.0))
    batch = readout.read([(np.array([1000, 1100, 1200, 1050]), *columns)], MS)
    assert batch.y.tolist() == [2, 8, 2, 2] and batch.x.tolist() == [5, 3, 7, 9]
    assert batch.t_ns.tolist() == [1000, 11000, 21000, 21000]


def test_a_texture_gives_about_the_events_asked_for() -> None:
    sensor = replace(QUIET, width=160, height=120)
    background = BackgroundKeys(texture=Texture(contrast=0.5, events_per_s=4e5))
    events, truth = run(scene(sensor=sensor, background=background, shake=Shake(10.0, 8.0), duration_s=0.5))
    assert len(events) / 0.5 == pytest.approx(4e5, rel=0.5)
    assert np.mean(events.polarity > 0) == pytest.approx(0.5, abs=0.1)
    assert truth.camera_path is not None and truth.camera_path.speed_px_per_s() > 100.0
    too_many = BackgroundKeys(texture=Texture(events_per_s=1e9))
    with pytest.raises(ParameterError, match=r'background\.texture\.events_per_s = 1e\+09: more contrast'):
        SimulatedScene(scene(sensor=sensor, background=too_many, shake=Shake(1.0, 1.0)))


def test_a_shaken_camera_moves_everything_alike() -> None:
    reflection = Reflection(of='beacon 1', share=0.5, shift_px=(10.0, -5.0))
    _, truth = run(scene(beacon(), shake=Shake(3.0, 5.0), distractors=(reflection,), duration_s=0.05))
    t_ns = np.arange(0, 50 * MS, MS)
    dx, dy = truth.camera_path.at(t_ns)
    x, y = truth.beacons[0].centre(t_ns)
    assert np.allclose(x - 31.5, dx) and np.allclose(y - 31.5, dy)
    assert np.allclose(truth.distractors[0].trajectory.at(t_ns), (x + 10.0, y - 5.0))


def test_recorded_events_are_mixed_in() -> None:
    t_ns = np.arange(0, 300 * MS, 700_000)
    recorded = EventBatch(
        np.full(len(t_ns), 3, np.uint16), np.full(len(t_ns), 4, np.uint16), np.ones(len(t_ns), np.int8), t_ns, 300 * MS
    )
    pieces = [recorded.slice(0, 100, int(t_ns[99])), recorded.slice(100, len(t_ns), 300 * MS)]
    events, _ = run(scene(beacon()), background=iter(pieces))
    mixed = events.t_ns[(events.x == 3) & (events.y == 4)]
    assert np.allclose(mixed, t_ns[t_ns < 200 * MS], rtol=0, atol=20_000)  # the bus may be busy


@pytest.mark.parametrize(
    ('content', 'error'),
    [
        ([], 'the file = []: must be a mapping of keys'),
        ({'beacon': []}, 'beacon: no such key; there are duration_s, beacons'),
        ({'duration_s': 'long'}, "duration_s = 'long': must be a number"),
        ({'beacons': [{'bit_rate_bps': [504, 1000]}]}, 'beacons[0].bit_rate_bps = [504.0, 1000.0]: more rates than beacons'),
        ({'duration_s': 0}, 'duration_s = 0: must lie in [0.001, 86400]'),
        ({'beacons': {}}, 'beacons = {}: must be a list'),
        ({'beacons': [{}, {'path': 3}]}, 'beacons[1].path = 3: must be a mapping with kind: still | line'),
        ({'beacons': [{'path': {'kind': 'hop'}}]}, "beacons[0].path.kind = 'hop': must be one of still, line"),
        ({'beacons': [{'path': {'kind': 'still'}}]}, 'beacons[0].path.at_px: missing'),
        ({'beacons': [{'path': {'kind': 'still', 'at_px': [1]}}]}, 'beacons[0].path.at_px = [1]: must be a list of 2 numbers'),
        (
            {'beacons': [{'path': {'kind': 'line', 'from_px': [9, 9], 'speed_px_per_s': [1, 2]}}]},
            'beacons[0].path.ramp_s = [0.0, 0.0]: with two speeds',
        ),
        ({'beacons': [{'text': 7}]}, 'beacons[0].text = 7: must be a text'),
        ({'beacons': [{'text': 'é'}]}, "beacons[0].text: 'é'"),
        ({'beacons': [{'led': {'contrast': -1}}]}, 'beacons[0].led.contrast = -1: must lie in [0, 1e+06]'),
        ({'beacons': [{'occluded_s': [[2, 1]]}]}, 'beacons[0].occluded_s[0] = [2, 1]: must be a begin and a later end'),
        ({'beacons': [{'shown_s': [2, 1]}]}, 'beacons[0].shown_s = [2.0, 1.0]: must be a begin and a later end'),
        ({'beacons': [{'name': 'a'}, {'name': 'a'}]}, "beacons: two are called 'a'"),
        ({'distractors': [{'kind': 'reflection', 'of': 'b', 'shift_px': [1, 1]}]}, "distractors[0].of = 'b': no such beacon"),
        ({'sensor': {'width': 20.5}}, 'sensor.width = 20.5: must be a whole number'),
    ],
)
def test_a_wrong_key_is_named_by_its_path(content, error) -> None:
    with pytest.raises(ParameterError) as raised:
        make_description(content)
    assert str(raised.value).startswith(error)


def test_a_path_that_leaves_the_sensor_is_named() -> None:
    with pytest.raises(ParameterError, match=r'beacons\[0\]\.path\.from_px = \[2.0, 30.0\]: x must lie in \[8, 55\]'):
        SimulatedScene(scene(beacon(path=Line((2.0, 30.0), (10.0,)))))


def test_beacons_of_a_count_stand_on_a_grid_with_rates_in_turn() -> None:
    description = make_description({'beacons': [{'count': 6, 'bit_rate_bps': [504, 1000]}, {'name': 'a'}]})
    assert [one.name for one in description.beacons] == [*(f'beacon {k}' for k in range(1, 7)), 'a']
    assert [one.bit_rate_bps[0] for one in description.beacons][:3] == [504, 1000, 504]
    places = {one.path.at_px for one in description.beacons[:6]}
    assert len(places) == 6 and all(0 <= x < 640 and 0 <= y < 480 for x, y in places)
