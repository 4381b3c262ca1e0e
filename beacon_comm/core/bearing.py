"""Bearing: a pixel of a calibrated camera as a unit vector in its optical frame (section III, "Detection algorithm").

Axes, signs and pixels, as in ROS's optical frames (REP 103)::

          z forward (optical axis)
         /
        +---- x right             azimuth   = atan2(x, z)             positive to the right
        |                         elevation = atan2(-y, hypot(x, z))  positive upwards
        y down                    pixel (0, 0): middle of the first pixel

Calibrations are ROS's: the YAML file that camera_calibration writes, or the fields of a CameraInfo message.  Both
give the camera matrix K and the coefficients D of one distortion model; R and P are rectification's, and a pixel
of the raw image needs none of them.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from beacon_comm.core.errors import CalibrationError, quoted
from beacon_comm.core.yaml_text import load_yaml

Floats = NDArray[np.float64]

_COEFFICIENTS = {'plumb_bob': (0, 4, 5), 'rational_polynomial': (8, 12, 14), 'equidistant': (4,), 'fisheye': (4,)}
_STEP_PX = 0.01  # of the Jacobian's central difference: far above rounding, far below any curvature of a lens
_NEWTON_STEPS = 8
_SOLVED_PX = 1e-3  # a solution projects back this close
_EXACT_PX = 1e-9
_AROUND = np.array([(1, 0), (-1, 0), (0, 1), (0, -1)])
_NEAR = 0.05 * _AROUND  # of the width, around the principal point
_PLANE_STEP = 1e-6
_PLANE_STEPS = _AROUND * _PLANE_STEP


class CameraModel:
    """Intrinsics and distortion of one camera.

    Attributes:
        width, height: size of the sensor the calibration is for (px).
        distortion_model: 'plumb_bob', 'rational_polynomial', 'equidistant' or 'fisheye' (the last two are one).
        k: camera matrix (px), ``(3, 3)`` float64.
        d: distortion coefficients in OpenCV's order, ``(n,)`` float64; none given (plumb_bob only): no distortion.

    Raises:
        CalibrationError: a field is wrong, or there are no directions behind pixels in the middle of the image.
    """

    def __init__(self, width: int, height: int, distortion_model: str, d: ArrayLike, k: ArrayLike) -> None:
        self.width = _size('image_width', width)
        self.height = _size('image_height', height)
        self.k = _numbers('camera_matrix', k, 9).reshape(3, 3)
        if self.k[0, 0] <= 0 or self.k[1, 1] <= 0:
            raise CalibrationError(
                f'camera_matrix: focal lengths {self.k[0, 0]:g}, {self.k[1, 1]:g} must be positive (not calibrated?)'
            )
        if not np.array_equal(self.k[[1, 2, 2, 2], [0, 0, 1, 2]], [0, 0, 0, 1]):
            raise CalibrationError('camera_matrix: must read [fx s cx; 0 fy cy; 0 0 1]')
        self.distortion_model = distortion_model
        self.d = _coefficients(distortion_model, d)
        middle, centre = (self.width / 2, self.height / 2), self.k[:2, 2]
        with np.errstate(all='ignore'):
            directions = self.bearings(np.vstack((middle, centre + _NEAR * self.width)))
        if not np.all(np.isfinite(directions)):
            raise CalibrationError("camera_matrix, distortion_coefficients: pixels in the image's middle have no direction")

    @classmethod
    def from_yaml(cls, path: Path | str) -> CameraModel:
        """Read a calibration file as ROS's camera_calibration writes it.

        Raises:
            CalibrationError: the file cannot be read, or a field is missing or wrong; the text names file and field.
        """
        try:
            content = load_yaml(Path(path).read_text(encoding='utf-8'))
        except (OSError, ValueError) as error:
            raise CalibrationError(f'{path}: {error}') from error
        try:
            if not isinstance(content, Mapping):
                raise CalibrationError('not a calibration file: no fields')
            return cls(
                _field(content, 'image_width'),
                _field(content, 'image_height'),
                _field(content, 'distortion_model'),
                _matrix(content, 'distortion_coefficients'),
                _matrix(content, 'camera_matrix'),
            )
        except CalibrationError as error:
            raise CalibrationError(f'{path}: {error}') from error

    @classmethod
    def from_camera_info(
        cls, width: int, height: int, distortion_model: str, d: Sequence[float], k: Sequence[float]
    ) -> CameraModel:
        """Take the fields of a ``sensor_msgs/msg/CameraInfo``.

        Raises:
            CalibrationError: a field is missing or wrong (all zero: the camera is not calibrated).
        """
        return cls(width, height, distortion_model, d, k)

    def check_size(self, sensor_size: tuple[int, int]) -> None:
        """Refuse a sensor ``(width, height)`` (px) other than the calibrated one.

        Raises:
            CalibrationError: naming both sizes.
        """
        if sensor_size != (self.width, self.height):
            raise CalibrationError(
                f'image_width × image_height = {self.width} × {self.height}: the sensor has'
                f' {sensor_size[0]} × {sensor_size[1]} pixels'
            )

    def bearings(self, xy: ArrayLike) -> Floats:
        """Return the directions of pixels.

        Args:
            xy: columns and rows (px), ``(n, 2)`` float64; parts of pixels are meant.

        Returns:
            Unit vectors in the optical frame, ``(n, 3)`` float64.  NaN where the distortion model has no direction
            for the pixel (far outside of the image).
        """
        pixels = np.asarray(xy, np.float64).reshape(-1, 2)
        if len(pixels) == 0:
            return np.empty((0, 3))
        if self.distortion_model in ('equidistant', 'fisheye'):
            return _fisheye_vectors(pixels, self.k, self.d)
        plane, found = self._undistorted(pixels)
        vectors = np.column_stack((plane, np.where(found, 1.0, np.nan)))
        return np.asarray(vectors / np.linalg.norm(vectors, axis=1, keepdims=True))

    def _undistorted(self, pixels: Floats) -> tuple[Floats, NDArray[np.bool_]]:
        """Return the points of the plane z = 1 behind pixels ``(n, 2)``, and which of them are solutions ``(n,)``.

        OpenCV's own undistortion stops after five steps; Newton's method goes on from there to the end.
        """
        plane = cv2.undistortPoints(pixels.reshape(-1, 1, 2), self.k, self.d).reshape(-1, 2)
        for _ in range(_NEWTON_STEPS):
            error = pixels - self._projected(plane)
            if np.all(np.abs(error) < _EXACT_PX):  # at once where there is no distortion
                break
            right, left, below, above = (self._projected(plane + step) for step in _PLANE_STEPS)
            jacobian = np.stack((right - left, below - above), axis=2) / (2 * _PLANE_STEP)
            determinant = np.linalg.det(jacobian)
            solvable = np.isfinite(determinant) & (determinant > 0)
            plane[solvable] += np.linalg.solve(jacobian[solvable], error[solvable, :, None])[:, :, 0]
        found = np.all(np.abs(pixels - self._projected(plane)) < _SOLVED_PX, axis=1)
        return plane, found

    def _projected(self, plane: Floats) -> Floats:
        points = np.column_stack((plane, np.ones(len(plane))))
        return np.asarray(cv2.projectPoints(points, np.zeros(3), np.zeros(3), self.k, self.d)[0].reshape(-1, 2))

    def angle_covariance(self, xy: ArrayLike, pixel_covariance: ArrayLike) -> Floats:
        """Return the covariance of azimuth and elevation (rad²), ``(2, 2)`` float64, to first order.

        Args:
            xy: column and row (px), ``(2,)``.
            pixel_covariance: of column and row (px²), ``(2, 2)``.
        """
        x_px, y_px = np.asarray(xy, np.float64)
        h = _STEP_PX
        around = self.bearings([(x_px - h, y_px), (x_px + h, y_px), (x_px, y_px - h), (x_px, y_px + h)])
        angles = np.array([azimuth_elevation(vector) for vector in around])
        steps = angles[1::2] - angles[0::2]
        steps[:, 0] = np.remainder(steps[:, 0] + math.pi, 2 * math.pi) - math.pi
        jacobian = (steps / (2 * h)).T
        return np.asarray(jacobian @ np.asarray(pixel_covariance, np.float64) @ jacobian.T)


def azimuth_elevation(vector: ArrayLike) -> tuple[float, float]:
    """Return azimuth and elevation (rad) of a vector ``(3,)`` in the optical frame; see the module's head."""
    x, y, z = np.asarray(vector, np.float64)
    return math.atan2(x, z), math.atan2(-y, math.hypot(x, z))


def _fisheye_vectors(pixels: Floats, k: Floats, d: Floats) -> Floats:
    """Return unit vectors ``(n, 3)`` of pixels ``(n, 2)`` by the equidistant model.

    theta_d = theta (1 + d0 theta² + d1 theta⁴ + d2 theta⁶ + d3 theta⁸) is the distance from the centre over the focal
    length; theta, the angle off the axis, may pass 90°, where OpenCV's undistortion to a plane has to end.
    """
    y = (pixels[:, 1] - k[1, 2]) / k[1, 1]
    x = (pixels[:, 0] - k[0, 2] - k[0, 1] * y) / k[0, 0]
    theta_d = np.hypot(x, y)
    polynomial = np.polynomial.Polynomial([0, 1, 0, d[0], 0, d[1], 0, d[2], 0, d[3]])
    slope = polynomial.deriv()
    theta = np.minimum(theta_d, math.pi / 2)
    for _ in range(4 * _NEWTON_STEPS):
        theta = np.clip(theta + (theta_d - polynomial(theta)) / np.maximum(slope(theta), 0.1), 0.0, math.pi)
    theta[np.abs(theta_d - polynomial(theta)) * k[0, 0] > _SOLVED_PX] = np.nan
    direction = np.arctan2(y, x)
    return np.column_stack((np.sin(theta) * np.cos(direction), np.sin(theta) * np.sin(direction), np.cos(theta)))


def _coefficients(distortion_model: object, d: ArrayLike) -> Floats:
    if not isinstance(distortion_model, str) or distortion_model not in _COEFFICIENTS:
        raise CalibrationError(f'distortion_model = {quoted(distortion_model)}: must be one of {", ".join(_COEFFICIENTS)}')
    counts = _COEFFICIENTS[distortion_model]
    coefficients = _numbers('distortion_coefficients', d, None)
    if len(coefficients) not in counts:
        raise CalibrationError(
            f'distortion_coefficients: {distortion_model} has {" or ".join(map(str, counts))} numbers,'
            f' not {len(coefficients)}'
        )
    return coefficients if len(coefficients) else np.zeros(5)


def _size(name: str, value: object) -> int:
    if isinstance(value, bool) or not isinstance(value, int) or value <= 0:
        raise CalibrationError(f'{name} = {quoted(value)}: must be a positive whole number')
    return value


def _numbers(name: str, values: ArrayLike, count: int | None) -> Floats:
    try:
        numbers = np.array(values, np.float64).ravel()
    except (TypeError, ValueError):
        raise CalibrationError(f'{name}: must be numbers') from None
    if count is not None and len(numbers) != count:
        raise CalibrationError(f'{name}: must have {count} numbers, not {len(numbers)}')
    if not np.all(np.isfinite(numbers)):
        raise CalibrationError(f'{name}: must be finite numbers')
    return numbers


def _field(content: Mapping[object, object], name: str) -> Any:
    if name not in content:
        raise CalibrationError(f'{name}: missing')
    return content[name]


def _matrix(content: Mapping[object, object], name: str) -> Floats:
    matrix = _field(content, name)
    if not isinstance(matrix, Mapping):
        raise CalibrationError(f'{name}: must have the fields rows, cols and data')
    rows, cols = (_size(f'{name}.{side}', matrix.get(side)) for side in ('rows', 'cols'))
    return _numbers(f'{name}.data', matrix.get('data', []), rows * cols)
