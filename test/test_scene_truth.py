"""The truth of a scene: paths, visibility, bearings, and that files keep it."""

import numpy as np
import pytest

from beacon_comm.core.bearing import azimuth_elevation
from beacon_comm.core.errors import RecordingError
from beacon_comm.recordings.disc import Disc
from beacon_comm.recordings.truth import ARRAYS_NAME, read_truth, write_simulated_truth
from beacon_comm.simulation.trajectory import Trajectory
from beacon_comm.simulation.truth import BeaconTruth, Camera, DistractorTruth, SceneTruth

MS = 1_000_000
CAMERA = Camera(64, 48, 60.0, 61.0, 31.5, 23.5, d=(-0.1, 0.05, 0.0, 0.0, 0.0))
PATH = Trajectory(np.array([0, 10 * MS, 30 * MS]), np.array([10.0, 20.0, 70.0]), np.array([5.0, 5.0, 25.0]))
BEACON = BeaconTruth(
    'front',
    'simulated',
    PATH,
    (np.array([0, 30 * MS]), np.array([3.0, 4.0])),
    64,
    48,
    shown_ns=(2 * MS, 50 * MS),
    hidden_ns=np.array([[4 * MS, 6 * MS]]),
    text='Hello',
    bit_rate_bps=999.7,
    sendings_ns=np.array([5 * MS]),
    changes_ns=np.array([5 * MS, 6 * MS]),
    levels=np.array([0, 1], np.uint8),
    camera=CAMERA,
    events=7,
    characters_ns=np.array([5 * MS]),
    codes=np.array([72], np.uint8),
)
SCENE = SceneTruth(
    64, 48, 0.0, 0.05, 17, CAMERA, (BEACON,), (DistractorTruth('lamp', 'lamp', Trajectory.still(3.0, 4.0)),), PATH, 5
)


def test_between_knots_a_path_is_straight_and_at_its_ends_still() -> None:
    x, y = PATH.at([-5 * MS, 5 * MS, 20 * MS, 99 * MS])
    assert x.tolist() == [10.0, 15.0, 45.0, 70.0] and y.tolist() == [5.0, 5.0, 15.0, 25.0]
    moved = PATH.plus(Trajectory(np.array([0, 20 * MS]), np.array([0.0, 2.0]), np.array([1.0, 1.0])))
    assert [float(at) for at in moved.at(15 * MS)] == [32.5 + 1.5, 10.0 + 1.0]
    assert PATH.speed_px_per_s() == pytest.approx(np.hypot(50.0, 20.0) / 0.02)


def test_a_beacon_is_visible_on_the_sensor_while_shown_and_not_hidden() -> None:
    times = np.array([1, 2, 3, 4, 5, 6, 20, 27, 28, 45]) * MS  # it leaves the sensor at 27.4 ms
    assert BEACON.visible(times).tolist() == [False, True, True, False, False, True, True, True, False, False]


def test_a_bearing_is_that_of_the_calibration() -> None:
    bearing = BEACON.bearing(20 * MS)
    assert bearing is not None
    (vector,) = CAMERA.calibration().bearings([(45.0, 15.0)])
    assert [float(angle) for angle in bearing] == pytest.approx(azimuth_elevation(vector))


def test_a_file_keeps_all_of_it(tmp_path) -> None:
    write_simulated_truth(tmp_path, SCENE, {'duration_s': 0.05})
    read = read_truth(tmp_path)
    assert (read.width, read.height, read.start_s, read.duration_s, read.stamp_start_ns, read.seed) == (64, 48, 0, 0.05, 17, 5)
    assert read.camera == CAMERA
    assert read.camera_path is not None and np.array_equal(read.camera_path.x_px, PATH.x_px)
    assert [(one.name, one.kind, one.trajectory.at(0)) for one in read.distractors] == [('lamp', 'lamp', (3.0, 4.0))]
    (beacon,) = read.beacons
    for name in ('name', 'kind', 'width', 'height', 'shown_ns', 'text', 'bit_rate_bps', 'camera', 'events'):
        assert getattr(beacon, name) == getattr(BEACON, name)
    for name in ('hidden_ns', 'sendings_ns', 'changes_ns', 'levels', 'characters_ns', 'codes'):
        assert np.array_equal(getattr(beacon, name), getattr(BEACON, name))
    times = np.arange(0, 50 * MS, MS // 3)
    assert np.array_equal(beacon.centre(times), BEACON.centre(times))
    assert np.array_equal(beacon.radius_px(times), BEACON.radius_px(times))
    assert np.array_equal(beacon.visible(times), BEACON.visible(times))


def test_arrays_that_are_missing_or_broken_are_named(tmp_path) -> None:
    write_simulated_truth(tmp_path, SCENE)
    (tmp_path / ARRAYS_NAME).write_bytes(b'no zip')
    with pytest.raises(RecordingError, match=r'truth\.npz: cannot be read'):
        read_truth(tmp_path)
    (tmp_path / ARRAYS_NAME).unlink()
    with pytest.raises(RecordingError, match=r'truth\.npz: cannot be read'):
        read_truth(tmp_path)


def test_the_path_of_a_disc_is_exact_at_and_between_its_bounces() -> None:
    disc = Disc.parse('20,20,4,900,-350', 64, 48)
    t_ns = np.linspace(0, 2e9, 5001).astype(np.int64)
    assert np.allclose(disc.trajectory(2.0).at(t_ns), disc.centre(t_ns * 1e-9), atol=1e-5)
    x, y = Disc.parse('20,20', 64, 48).trajectory(2.0).at(t_ns)
    assert np.all(x == 20.0) and np.all(y == 20.0)
