"""The lights of a scene as flat arrays, for the pixels' compiled loop: where, how strong, what shape, and what drives them.

    drive     LEVELS   0 / 1 at given times, through the driver's slew and the LED's rise and fall      beacons, reflections
              SINE     1 + depth · sin(2π f t + φ)                                                 lamps
              PULSES   on for a share of the period, with rise and fall                            PWM
              FLASHES  1 at each refresh, then exp(−t / fade)                                      a line of a screen
    strength  irradiance in the middle of the image over the background: contrast · (30 m / distance)², times what an
              occluder lets through; a polyline in time
    shape     a disc seen through the point spread, as a table over the squared distance; or a rectangle

A point source's flux falls with the square of its distance (inverse square law); the image's height falls besides where
the LED's disc is wider than the point spread, because the same flux is spread over more pixels.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from beacon_comm.core.events import NS_PER_S
from beacon_comm.simulation.description import (
    REFERENCE_M,
    BeaconKeys,
    Lamp,
    Pwm,
    Reflection,
    SceneDescription,
    Screen,
)
from beacon_comm.simulation.line import Line
from beacon_comm.simulation.trajectory import Floats, Times, Trajectory
from beacon_comm.simulation.truth import NEVER_NS, Levels

LEVELS, SINE, PULSES, FLASHES = range(4)
PROFILE_STEPS = 512
NEGLIGIBLE = 0.03  # contrast of the outermost pixels that are simulated: far below any threshold
STRIP_PX = 4  # a screen's lines are driven in strips of so many
DEFAULT_FOCAL_PX = 4667.0  # the paper's 70 mm lens over 15 µm pixels


@dataclass(frozen=True, slots=True, eq=False)
class Light:
    """One light.

    Attributes:
        name, kind: for the truth.
        trajectory: of its middle (px).
        strength: knots (ns), and the irradiance over the background in the middle.
        profile: share of that at squared distances ``k · reach_px² / PROFILE_STEPS``, ``(PROFILE_STEPS + 1,)``.
        reach_px: beyond it there is nothing.
        half_px: half width and height of a rectangle; (0, 0): round.
        drive: LEVELS, SINE, PULSES or FLASHES.
        numbers: the drive's six: LEVELS: delay, rise, fall and both slews (ns); SINE: f (1/ns), φ (turns), depth;
            PULSES: f, φ, duty, edge (ns); FLASHES: f, φ, fade (ns).
        changes_ns, levels: of LEVELS.
    """

    name: str
    kind: str
    trajectory: Trajectory
    strength: tuple[Times, Floats]
    profile: Floats
    reach_px: float
    half_px: tuple[float, float]
    drive: int
    numbers: Floats
    changes_ns: Times
    levels: Levels


def spot_profile(radius_px: float, psf_px: float, reach_px: float) -> Floats:
    """Return a disc of uniform light convolved with a Gaussian point spread, over the squared distance.

    Args:
        radius_px: of the disc; 0: a point.
        psf_px: standard deviation of the point spread.
        reach_px: the table's last entry is at this distance.

    Returns:
        Share of a point source's peak of the same flux, ``(PROFILE_STEPS + 1,)``: at most 1, less where the disc is wide.
    """
    distance = np.sqrt(np.linspace(0.0, reach_px**2, PROFILE_STEPS + 1))
    if radius_px < 0.05 * psf_px:
        return np.asarray(np.exp(-0.5 * (distance / psf_px) ** 2))
    rings = (np.arange(24) + 0.5) / 24 * radius_px  # mean over the disc of a Gaussian around each of its points
    angles = (np.arange(32) + 0.5) / 32 * 2 * math.pi
    rho, phi = np.meshgrid(rings, angles)
    weight = rho / rho.sum()
    square = (distance[:, None, None] - rho * np.cos(phi)) ** 2 + (rho * np.sin(phi)) ** 2
    return np.asarray(np.sum(weight * np.exp(-0.5 * square / psf_px**2), axis=(1, 2)))


def _reach(peak: float, radius_px: float, psf_px: float) -> float:
    """Return the distance at which a spot's contrast is negligible (px)."""
    return radius_px + psf_px * math.sqrt(2.0 * max(math.log(max(peak, 1e-9) / NEGLIGIBLE), 0.5))


def strength_of(beacon: BeaconKeys, description: SceneDescription) -> tuple[Times, Floats]:
    """Return a beacon's strength over time: inverse square of the distance, over the background, cut by occluders."""
    duration_s, brightness = description.duration_s, description.background.brightness
    knots = np.linspace(0.0, duration_s, 33 if len(beacon.distance_m) == 2 else 1)
    spans = [tuple(span) for span in beacon.occluded_s]
    if beacon.shown_s is not None:
        begin, end = beacon.shown_s
        spans += [(-1.0, begin)] if begin > 0 else []
        spans += [(end, duration_s + 1.0)] if end < duration_s else []
    edge = beacon.occlusion_edge_s
    for begin, end in spans:
        knots = np.concatenate((knots, [begin - edge, begin, end, end + edge]))
    t_s = np.unique(knots)
    metres = np.interp(t_s, (0.0, duration_s), (beacon.distance_m[0], beacon.distance_m[-1]))
    strength = beacon.led.contrast / brightness * (REFERENCE_M / metres) ** 2
    for begin, end in spans:
        covered = np.minimum(np.clip((t_s - (begin - edge)) / edge, 0, 1), np.clip((end + edge - t_s) / edge, 0, 1))
        strength = strength * (1.0 - covered)
    return np.rint(t_s * NS_PER_S).astype(np.int64), strength


def beacon_light(beacon: BeaconKeys, line: Line, trajectory: Trajectory, description: SceneDescription) -> Light:
    """Return a beacon's light."""
    camera, psf_px = description.camera, description.sensor.psf_px
    focal_px = camera.focal_px[0] if camera is not None else DEFAULT_FOCAL_PX
    nearest_m = min(beacon.distance_m)
    radius_px = 0.5e-3 * beacon.led.size_mm / nearest_m * focal_px
    strength = strength_of(beacon, description)
    reach_px = _reach(float(strength[1].max()), radius_px, psf_px)
    led = beacon.led
    return Light(
        beacon.name,
        'simulated',
        trajectory,
        strength,
        spot_profile(radius_px, psf_px, reach_px),
        reach_px,
        (0.0, 0.0),
        LEVELS,
        np.array([led.delay_us, led.rise_us, led.fall_us, led.rise_slew_us, led.fall_slew_us, 0.0]) * 1e3,
        line.changes_ns,
        line.levels,
    )


def reflection_light(keys: Reflection, of: Light, trajectory: Trajectory) -> Light:
    """Return a reflection of a beacon's light."""
    t_ns, strength = of.strength
    name = keys.name or f'reflection of {keys.of}'
    return replace(of, name=name, kind='reflection', trajectory=trajectory, strength=(t_ns, strength * keys.share))


def lamp_lights(
    keys: Lamp | Pwm | Screen, trajectory: Trajectory, description: SceneDescription, random: np.random.Generator
) -> list[Light]:
    """Return a lamp's or PWM LED's light, or a screen's strips from top to bottom; the phase is drawn."""
    psf_px = description.sensor.psf_px
    contrast = keys.contrast / description.background.brightness
    strength = (np.zeros(1, np.int64), np.array([contrast]))
    phase = float(random.random())
    none = np.empty(0, np.int64), np.empty(0, np.uint8)
    if isinstance(keys, Screen):
        count = max(math.ceil(keys.height_px / STRIP_PX), 1)
        height_px = keys.height_px / count
        lights = []
        for index in range(count):
            shift = Trajectory.still(0.0, (index + 0.5) * height_px - 0.5 * keys.height_px)
            numbers = np.array([keys.refresh_hz / NS_PER_S, phase - index / count, keys.fade_us * 1e3, 0.0, 0.0, 0.0])
            half = (0.5 * keys.width_px, 0.5 * height_px)
            lights.append(
                Light(
                    keys.name or 'screen',
                    'screen',
                    trajectory.plus(shift),
                    strength,
                    np.ones(PROFILE_STEPS + 1),
                    max(half) + 1.0,
                    half,
                    FLASHES,
                    numbers,
                    *none,
                )
            )
        return lights
    reach_px = _reach(contrast, keys.radius_px, psf_px)
    profile = spot_profile(keys.radius_px, psf_px, reach_px)
    if isinstance(keys, Lamp):
        kind, drive = 'lamp', SINE
        numbers = np.array([keys.frequency_hz / NS_PER_S, phase, keys.depth, 0.0, 0.0, 0.0])
    else:
        kind, drive = 'pwm', PULSES
        numbers = np.array([keys.frequency_hz / NS_PER_S, phase, keys.duty, keys.edge_us * 1e3, 0.0, 0.0])
    # The contrast of a lamp is that of its middle, however wide it is.
    return [
        Light(keys.name or kind, kind, trajectory, strength, profile / profile[0], reach_px, (0.0, 0.0), drive, numbers, *none)
    ]


@dataclass(frozen=True, slots=True, eq=False)
class FlatLights:
    """All lights of a scene, one after the other in flat arrays; ``*_at[s]`` to ``*_at[s + 1]`` are those of light s."""

    path_at: NDArray[np.int64]
    path_ns: Times
    path_x: Floats
    path_y: Floats
    strength_at: NDArray[np.int64]
    strength_ns: Times
    strength: Floats
    profile: Floats
    reach_px: Floats
    half_px: Floats
    drive: NDArray[np.int64]
    numbers: Floats
    changes_at: NDArray[np.int64]
    changes_ns: Times
    levels: Levels

    @classmethod
    def of(cls, lights: list[Light]) -> FlatLights:
        """Return the arrays of some lights; a path's first and last knot are repeated in the far past and future."""
        paths = [_held(one.trajectory.t_ns, one.trajectory.x_px, one.trajectory.y_px) for one in lights]
        strengths = [_held(*one.strength) for one in lights]
        return cls(
            _offsets([path[0] for path in paths]),
            _joined([path[0] for path in paths]).astype(np.int64),
            _joined([path[1] for path in paths]),
            _joined([path[2] for path in paths]),
            _offsets([one[0] for one in strengths]),
            _joined([one[0] for one in strengths]).astype(np.int64),
            _joined([one[1] for one in strengths]),
            np.array([one.profile for one in lights]).reshape(-1, PROFILE_STEPS + 1),
            np.array([one.reach_px for one in lights], np.float64),
            np.array([one.half_px for one in lights], np.float64).reshape(-1, 2),
            np.array([one.drive for one in lights], np.int64),
            np.array([one.numbers for one in lights], np.float64).reshape(-1, 6),
            _offsets([one.changes_ns for one in lights]),
            _joined([one.changes_ns for one in lights]).astype(np.int64),
            _joined([one.levels for one in lights]).astype(np.uint8),
        )


def _held(t_ns: Times, *values: Floats) -> tuple[np.ndarray, ...]:
    ends = [-NEVER_NS // 2], [NEVER_NS // 2]
    return (
        np.concatenate((ends[0], t_ns, ends[1])),
        *(np.concatenate(([value[0]], value, [value[-1]])).astype(np.float64) for value in values),
    )


def _offsets(parts: list[np.ndarray]) -> NDArray[np.int64]:
    return np.concatenate(([0], np.cumsum([len(one) for one in parts]))).astype(np.int64)


def _joined(parts: list[np.ndarray]) -> np.ndarray:
    return np.concatenate([np.empty(0), *parts]) if not parts or parts[0].dtype.kind == 'f' else np.concatenate(parts)
