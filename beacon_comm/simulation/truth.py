"""What a scene holds, whether it was simulated or merged from recordings: where each beacon is, when it shows, what it
sends.

All times are event times (``sensor_time_ns``): ns since scene time 0.  A distractor is nothing that sends: it is listed,
and is never among the beacons; a reflection of a beacon is one, too.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike, NDArray

from beacon_comm.core.bearing import CameraModel
from beacon_comm.simulation.trajectory import Floats, Times, Trajectory

Levels = NDArray[np.uint8]
NEVER_NS = 2**62


def _no_times() -> Times:
    return np.empty(0, np.int64)


def _no_spans() -> Times:
    return np.empty((0, 2), np.int64)


def _no_levels() -> Levels:
    return np.empty(0, np.uint8)


@dataclass(frozen=True, slots=True)
class Camera:
    """The camera that sees a scene.

    Attributes:
        width, height: of the sensor (px).
        fx, fy, cx, cy: focal lengths and principal point (px).
        model: its distortion model, see :class:`~beacon_comm.core.bearing.CameraModel`.
        d: the distortion coefficients; none: no distortion.
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    model: str = 'plumb_bob'
    d: tuple[float, ...] = ()

    def calibration(self) -> CameraModel:
        """Return it as the receiver takes it.

        Raises:
            CalibrationError: numbers that are no camera's.
        """
        k = (self.fx, 0.0, self.cx, 0.0, self.fy, self.cy, 0.0, 0.0, 1.0)
        return CameraModel(self.width, self.height, self.model, self.d, k)

    def angles(self, x_px: ArrayLike, y_px: ArrayLike) -> tuple[Floats, Floats]:
        """Return ``(azimuth, elevation)`` (rad) of pixels of any shape; axes and signs as in ``core.bearing``."""
        x, y = np.broadcast_arrays(np.asarray(x_px, np.float64), np.asarray(y_px, np.float64))
        vectors = self.calibration().bearings(np.column_stack((x.ravel(), y.ravel())))
        azimuth = np.arctan2(vectors[:, 0], vectors[:, 2])
        elevation = np.arctan2(-vectors[:, 1], np.hypot(vectors[:, 0], vectors[:, 2]))
        return azimuth.reshape(x.shape), elevation.reshape(x.shape)


@dataclass(frozen=True, slots=True, eq=False)
class BeaconTruth:
    """One beacon.

    Attributes:
        name: what it is called.
        kind: ``mat`` for a recording, ``simulated``.
        trajectory: of its centre.
        radii: of its disc or spot: knots (ns) ``(k,)`` int64 and radius (px) ``(k,)`` float64.  A simulated spot's is
            the distance from its centre within which a pixel's swing passes the sensor's ON threshold.
        width, height: of the sensor (px).
        shown_ns: when it is there at all, ``(begin, end)`` (ns).
        hidden_ns: when something is before it, ``(n, 2)`` int64, ``[begin, end)``.
        text: what it sends, over and over; None: unknown.
        bit_rate_bps: at what rate it really does (bit/s); None: unknown.
        sendings_ns: begin of the first start bit of each sending, ``(n,)`` int64.
        changes_ns, levels: when the line changes, ``(k,)`` int64, and to what, ``(k,)`` uint8; empty: unknown.
        camera: for bearings; None: none.
        events: how many the source has, where it was counted.
        characters_ns, codes: begin of every character's start bit, ``(n,)`` int64, and what it is, ``(n,)`` uint8; empty:
            unknown.  A sending that idle time cuts has only those that were sent.
    """

    name: str
    kind: str
    trajectory: Trajectory
    radii: tuple[Times, Floats]
    width: int
    height: int
    shown_ns: tuple[int, int] = (-NEVER_NS, NEVER_NS)
    hidden_ns: Times = field(default_factory=_no_spans)
    text: str | None = None
    bit_rate_bps: float | None = None
    sendings_ns: Times = field(default_factory=_no_times)
    changes_ns: Times = field(default_factory=_no_times)
    levels: Levels = field(default_factory=_no_levels)
    camera: Camera | None = None
    events: int | None = None
    characters_ns: Times = field(default_factory=_no_times)
    codes: Levels = field(default_factory=_no_levels)

    def centre(self, t_ns: ArrayLike) -> tuple[Floats, Floats]:
        """Return the true centre ``(x, y)`` (px) at event times (ns, any shape), float64 of that shape."""
        return self.trajectory.at(t_ns)

    def radius_px(self, t_ns: ArrayLike) -> Floats:
        """Return its radius (px) at event times (ns, any shape), float64 of that shape."""
        return np.interp(np.asarray(t_ns, np.float64), *self.radii)

    def visible(self, t_ns: ArrayLike) -> NDArray[np.bool_]:
        """Return whether its centre is on the sensor and nothing hides it, at event times (ns, any shape)."""
        t = np.asarray(t_ns, np.int64)
        x, y = self.centre(t)
        seen = (x >= -0.5) & (x < self.width - 0.5) & (y >= -0.5) & (y < self.height - 0.5)
        seen &= (t >= self.shown_ns[0]) & (t < self.shown_ns[1])
        for begin_ns, end_ns in self.hidden_ns:
            seen &= (t < begin_ns) | (t >= end_ns)
        return np.asarray(seen)

    def bearing(self, t_ns: ArrayLike) -> tuple[Floats, Floats] | None:
        """Return the true ``(azimuth, elevation)`` (rad) at event times (ns, any shape); None without a camera."""
        return None if self.camera is None else self.camera.angles(*self.centre(t_ns))


@dataclass(frozen=True, slots=True, eq=False)
class DistractorTruth:
    """What blinks or moves and is no beacon: its name, its kind and the path of its centre."""

    name: str
    kind: str
    trajectory: Trajectory


@dataclass(frozen=True, slots=True, eq=False)
class SceneTruth:
    """What a scene holds.

    Attributes:
        width, height: of the sensor (px).
        start_s: scene time of the first packet (s).
        duration_s: how long it is (s).
        stamp_start_ns: ROS time at scene time 0 (ns).
        camera: None without calibration.
        beacons, distractors: see there.
        camera_path: by how much the camera's motion moves the image (px); None: it stands still.
        seed: of the random numbers.
    """

    width: int
    height: int
    start_s: float
    duration_s: float
    stamp_start_ns: int
    camera: Camera | None
    beacons: tuple[BeaconTruth, ...]
    distractors: tuple[DistractorTruth, ...] = ()
    camera_path: Trajectory | None = None
    seed: int = 0
