"""Bearing: pixels to unit vectors, against OpenCV's projection, and calibrations that must be refused."""

import math
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st

from beacon_comm.core.bearing import CameraModel, azimuth_elevation
from beacon_comm.core.errors import CalibrationError

K = [531.2, 0.0, 322.4, 0.0, 529.8, 236.1, 0.0, 0.0, 1.0]
LENSES = {
    'plumb_bob': [-0.31, 0.12, 0.0008, -0.0004, -0.021],
    'rational_polynomial': [0.9, -0.6, 0.0005, 0.0002, -0.1, 1.2, -0.5, -0.2],
    'equidistant': [-0.03, 0.012, -0.009, 0.002],
    'fisheye': [0.05, -0.01, 0.002, -0.0005],
}
CALIBRATION = {
    'image_width': 640,
    'image_height': 480,
    'camera_name': 'event_camera',
    'camera_matrix': {'rows': 3, 'cols': 3, 'data': K},
    'distortion_model': 'plumb_bob',
    'distortion_coefficients': {'rows': 1, 'cols': 5, 'data': LENSES['plumb_bob']},
    'rectification_matrix': {'rows': 3, 'cols': 3, 'data': [1, 0, 0, 0, 1, 0, 0, 0, 1]},
    'projection_matrix': {'rows': 3, 'cols': 4, 'data': [500.0, 0, 320, 0, 0, 500, 240, 0, 0, 0, 1, 0]},
}


def camera(distortion_model: str = 'plumb_bob', d: list[float] | None = None) -> CameraModel:
    return CameraModel(640, 480, distortion_model, LENSES[distortion_model] if d is None else d, K)


def project(model: CameraModel, vectors: np.ndarray) -> np.ndarray:
    """Return the pixels ``(n, 2)`` of vectors ``(n, 3)`` by OpenCV's projection."""
    points = np.ascontiguousarray(vectors / vectors[:, 2:]).reshape(-1, 1, 3)
    if model.distortion_model in ('equidistant', 'fisheye'):
        return cv2.fisheye.projectPoints(points, np.zeros(3), np.zeros(3), model.k, model.d)[0].reshape(-1, 2)
    return cv2.projectPoints(points, np.zeros(3), np.zeros(3), model.k, model.d)[0].reshape(-1, 2)


@pytest.mark.parametrize('distortion_model', LENSES)
@settings(max_examples=50, deadline=None)
@given(azimuth=st.floats(-0.5, 0.5), elevation=st.floats(-0.4, 0.4))
def test_a_bearing_is_the_inverse_of_projection(distortion_model: str, azimuth: float, elevation: float) -> None:
    model = camera(distortion_model)
    vector = np.array(
        [[math.sin(azimuth) * math.cos(elevation), -math.sin(elevation), math.cos(azimuth) * math.cos(elevation)]]
    )
    bearing = model.bearings(project(model, vector))
    np.testing.assert_allclose(bearing, vector, atol=1e-9)
    assert azimuth_elevation(bearing[0]) == pytest.approx((azimuth, elevation), abs=1e-9)


@pytest.mark.parametrize('distortion_model', LENSES)
def test_every_pixel_of_the_sensor_has_a_bearing(distortion_model: str) -> None:
    model = camera(distortion_model)
    xy = np.stack(np.meshgrid(np.arange(0, 640, 20.0), np.arange(0, 480, 20.0)), axis=-1).reshape(-1, 2)
    bearings = model.bearings(xy)
    assert bearings.dtype == np.float64
    np.testing.assert_allclose(np.linalg.norm(bearings, axis=1), 1.0, atol=1e-12)
    np.testing.assert_allclose(project(model, bearings), xy, atol=1e-3)


def test_axes_and_signs() -> None:
    model = camera(d=[0.0] * 5)
    (ahead,), (right,), (below,) = (model.bearings([xy]) for xy in [(322.4, 236.1), (600, 236.1), (322.4, 400)])
    np.testing.assert_allclose(ahead, [0, 0, 1], atol=1e-12)
    assert right[0] > 0 and azimuth_elevation(right)[0] == pytest.approx(math.atan((600 - 322.4) / 531.2))
    assert below[1] > 0 and azimuth_elevation(below)[1] == pytest.approx(-math.atan((400 - 236.1) / 529.8))


def test_a_fisheye_lens_sees_beyond_a_right_angle() -> None:
    model = CameraModel(640, 480, 'equidistant', [0.0] * 4, [100, 0, 320, 0, 100, 240, 0, 0, 1])
    (vector,) = model.bearings([(320 + 100 * math.radians(110), 240)])
    np.testing.assert_allclose(vector, [math.sin(math.radians(110)), 0, math.cos(math.radians(110))], atol=1e-9)


def test_a_pixel_without_a_direction_is_not_a_number() -> None:
    model = camera(d=[-0.31, 0.0, 0.0, 0.0])
    vectors = model.bearings([(320, 240), (5000, 240)])
    assert np.all(np.isfinite(vectors[0])) and np.all(np.isnan(vectors[1]))


def test_no_pixels_no_bearings() -> None:
    assert camera().bearings(np.empty((0, 2))).shape == (0, 3)


@pytest.mark.parametrize('distortion_model', LENSES)
def test_covariance_is_the_spread_of_noisy_pixels(distortion_model: str) -> None:
    model, centre, covariance = camera(distortion_model), (560.0, 90.0), np.array([[0.09, 0.03], [0.03, 0.25]])
    pixels = np.random.default_rng(1).multivariate_normal(centre, covariance, 4000)
    angles = np.array([azimuth_elevation(vector) for vector in model.bearings(pixels)])
    propagated = model.angle_covariance(centre, covariance)
    np.testing.assert_allclose(np.cov(angles.T), propagated, rtol=0.1, atol=3e-8)
    np.testing.assert_allclose(propagated, propagated.T)


def test_covariance_on_the_axis_is_the_pixel_over_the_focal_length() -> None:
    covariance = camera().angle_covariance((322.4, 236.1), np.diag([0.25, 1.0]))
    np.testing.assert_allclose(covariance, np.diag([0.25 / 531.2**2, 1.0 / 529.8**2]), rtol=1e-6, atol=1e-15)


def test_yaml_and_camera_info_agree(tmp_path: Path) -> None:
    path = tmp_path / 'camera.yaml'
    path.write_text(yaml.safe_dump(CALIBRATION))
    read = CameraModel.from_yaml(path)
    told = CameraModel.from_camera_info(640, 480, 'plumb_bob', LENSES['plumb_bob'], K)
    assert (read.width, read.height, read.distortion_model) == (640, 480, 'plumb_bob')
    np.testing.assert_array_equal(read.bearings([(10, 20), (600, 400)]), told.bearings([(10, 20), (600, 400)]))


def without(name: str) -> dict:
    return {key: value for key, value in CALIBRATION.items() if key != name}


def with_data(name: str, data: list[float], cols: int | None = None) -> dict:
    return {name: CALIBRATION[name] | {'data': data, 'cols': cols or CALIBRATION[name]['cols']}}


NO_DIRECTION = "pixels in the image's middle have no direction"


@pytest.mark.parametrize(
    ('content', 'named'),
    [
        (without('image_width'), 'image_width: missing'),
        (without('camera_matrix'), 'camera_matrix: missing'),
        (without('distortion_coefficients'), 'distortion_coefficients: missing'),
        (CALIBRATION | {'image_height': 480.5}, 'image_height = 480.5'),
        (CALIBRATION | {'distortion_model': 'thin_prism'}, "distortion_model = 'thin_prism': must be one of plumb_bob"),
        (CALIBRATION | {'distortion_model': 'equidistant'}, 'distortion_coefficients: equidistant has 4 numbers'),
        (CALIBRATION | {'camera_matrix': {'rows': 3, 'cols': 3, 'data': K[:8]}}, 'camera_matrix.data: must have 9'),
        (CALIBRATION | {'camera_matrix': {'rows': 3, 'cols': 3, 'data': [0.0] * 9}}, 'camera_matrix: focal lengths'),
        (CALIBRATION | {'camera_matrix': {'rows': 3, 'cols': 3, 'data': [*K[:8], 2.0]}}, 'camera_matrix: must read'),
        (CALIBRATION | {'camera_matrix': {'rows': 3, 'cols': 3, 'data': ['a'] * 9}}, 'camera_matrix.data: must be num'),
        (CALIBRATION | {'camera_matrix': K}, 'camera_matrix: must have the fields rows'),
        (
            CALIBRATION | {'distortion_coefficients': {'rows': 1, 'cols': 5, 'data': [math.nan] * 5}},
            'distortion_coefficients.data: must be finite',
        ),
        (CALIBRATION | {'distortion_model': 4_000_000 * 'x'}, f"distortion_model = '{38 * 'x'}…: must be one of"),
        (CALIBRATION | with_data('distortion_coefficients', [1e300] * 5), NO_DIRECTION),
        (CALIBRATION | with_data('distortion_coefficients', [0.0, 1e9, 0.0, 0.0, 0.0]), NO_DIRECTION),
        (CALIBRATION | {'distortion_model': 'fisheye'} | with_data('distortion_coefficients', [1e300] * 4, 4), NO_DIRECTION),
        (CALIBRATION | with_data('camera_matrix', [1e-320, *K[1:]]), NO_DIRECTION),
        (CALIBRATION | with_data('camera_matrix', [*K[:5], 1e300, *K[6:]]), NO_DIRECTION),
        ('only text', 'not a calibration file'),
    ],
)
def test_a_wrong_calibration_is_refused_by_name(tmp_path: Path, content: object, named: str) -> None:
    path = tmp_path / 'camera.yaml'
    path.write_text(yaml.safe_dump(content))
    with pytest.raises(CalibrationError) as caught:
        CameraModel.from_yaml(path)
    assert named in str(caught.value) and str(path) in str(caught.value)


def test_a_missing_or_broken_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(CalibrationError, match='nowhere.yaml'):
        CameraModel.from_yaml(tmp_path / 'nowhere.yaml')
    (tmp_path / 'broken.yaml').write_text('a: [1,')
    with pytest.raises(CalibrationError, match='broken.yaml'):
        CameraModel.from_yaml(tmp_path / 'broken.yaml')


def test_another_sensor_is_refused() -> None:
    camera().check_size((640, 480))
    with pytest.raises(CalibrationError, match='640 × 480.*346 × 260'):
        camera().check_size((346, 260))


def test_an_uncalibrated_camera_info_is_refused() -> None:
    with pytest.raises(CalibrationError, match='not calibrated'):
        CameraModel.from_camera_info(640, 480, 'plumb_bob', [], [0.0] * 9)
