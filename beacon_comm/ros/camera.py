"""The camera's calibration, from where ROS keeps it: a YAML file by path or URL, or a CameraInfo message."""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path
from urllib.parse import unquote, urlparse

from ament_index_python.packages import PackageNotFoundError, get_package_share_directory
from sensor_msgs.msg import CameraInfo

from beacon_comm.core.bearing import CameraModel
from beacon_comm.core.errors import CalibrationError


def resolve_url(url: str) -> Path:
    """Return the file of a path, a ``file://`` URL or a ``package://name/path`` URL.

    Raises:
        CalibrationError: no URL, another scheme, or a package that is not installed.
    """
    try:
        parts = urlparse(url)
    except ValueError as error:
        raise CalibrationError(f'{url}: {error}') from error
    if parts.scheme == '':
        return Path(url).expanduser()
    if parts.scheme == 'file':
        return Path(unquote(parts.path))
    if parts.scheme == 'package':
        try:
            return Path(get_package_share_directory(parts.netloc)) / unquote(parts.path).lstrip('/')
        except (PackageNotFoundError, ValueError) as error:
            raise CalibrationError(f'{url}: no package {parts.netloc!r} is installed') from error
    raise CalibrationError(f'{url}: not a path, a file:// or a package:// URL')


def load_camera(url: str) -> CameraModel | None:
    """Return the camera of the parameter ``camera_info_file``, None for the empty string.

    Raises:
        CalibrationError: the file cannot be read, or is no calibration.
    """
    if not url:
        return None
    return CameraModel.from_yaml(resolve_url(url))


def camera_of_message(message: CameraInfo) -> CameraModel | None:
    """Return the camera of a CameraInfo message, None where its driver says that it is not calibrated (K = 0).

    Raises:
        CalibrationError: the message contradicts itself.
    """
    if message.k[0] == 0.0:
        return None
    return _camera(message.width, message.height, message.distortion_model, tuple(message.d), tuple(message.k))


@lru_cache(maxsize=1)  # drivers send the same with every packet
def _camera(width: int, height: int, distortion_model: str, d: tuple[float, ...], k: tuple[float, ...]) -> CameraModel:
    return CameraModel.from_camera_info(width, height, distortion_model, d, k)
