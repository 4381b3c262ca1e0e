"""A described scene as events and truth: everything that :func:`simulate` puts together.

Lights go through lens and pixels, everything through the readout::

    lights ──► LitPixels, Scan ───┐
    texture ─► MovingTexture ─────┤
               SensorNoise ───────┼─► Readout ─► EventBatch of piece_s
               a bag's events ────┘
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from beacon_comm.core.errors import ParameterError
from beacon_comm.core.events import NS_PER_S, EventBatch
from beacon_comm.simulation.description import BeaconKeys, CameraKeys, Reflection, SceneDescription, Sensor
from beacon_comm.simulation.lights import Light, beacon_light, lamp_lights, reflection_light, strength_of
from beacon_comm.simulation.line import Line, line_of
from beacon_comm.simulation.noise import SensorNoise
from beacon_comm.simulation.paths import Still
from beacon_comm.simulation.pixels import BLOCK_NS, LitPixels, Mismatch, RawEvents, threshold_radius
from beacon_comm.simulation.readout import Readout
from beacon_comm.simulation.scan import Scan
from beacon_comm.simulation.texture import MovingTexture
from beacon_comm.simulation.trajectory import Trajectory
from beacon_comm.simulation.truth import NEVER_NS, BeaconTruth, Camera, DistractorTruth, SceneTruth

PIECE_S = 0.01
STAMP_START_NS = 1_700_000_000 * NS_PER_S  # as merged scenes', so that the same scene gives the same bytes


class SimulatedScene:
    """A scene, its truth, and its events.

    Attributes:
        truth: what it holds.
        readout: the sensor's bus; ``readout.lost`` counts what it lost so far.
    """

    def __init__(self, description: SceneDescription, seed: int = 0, background: Iterator[EventBatch] | None = None) -> None:
        """Prepare a scene; nothing is simulated yet.

        Args:
            description: of the scene.
            seed: the same description and seed give the same events.
            background: recorded events to mix in, from scene time 0 on, in order; of the same sensor size.

        Raises:
            ParameterError: paths that do not fit on the sensor.
        """
        self.description = description
        sensor = description.sensor
        streams = np.random.default_rng(seed).spawn(6)
        self.readout = Readout(sensor)
        shake = description.shake.trajectory(description.duration_s, seed)
        lights, self.truth = _lights_and_truth(description, shake, seed, streams[0])
        mismatch = Mismatch(sensor, streams[1])
        self._scan = Scan(sensor, streams[5])
        self._pixels = LitPixels(lights, description, mismatch, self._scan, streams[2])
        self._noise = SensorNoise(sensor, streams[3])
        texture = description.background.texture
        self._texture = None
        if texture is not None:
            path = shake if shake is not None else Trajectory.still(0.0, 0.0)
            self._texture = MovingTexture(texture, path, description, mismatch, streams[4])
        self._background = None if background is None else _Recorded(background, sensor)

    def batches(self, piece_s: float = PIECE_S) -> Iterator[EventBatch]:
        """Yield the events in pieces of ``piece_s`` (s, whole milliseconds), in order; once."""
        piece_ns = max(round(piece_s * 1000), 1) * BLOCK_NS
        end_ns = round(self.description.duration_s * 1e6) * 1000
        for begin_ns in range(0, end_ns, piece_ns):
            until_ns = min(begin_ns + piece_ns, end_ns)
            requests: list[RawEvents] = []
            for block_ns in range(begin_ns, until_ns, BLOCK_NS):
                block_end_ns = min(block_ns + BLOCK_NS, end_ns)  # by blocks, so that the pieces' length changes nothing
                requests.append(self._pixels.block(block_ns))
                others = [self._noise.piece(block_ns, block_end_ns)]
                if self._texture is not None:
                    others.append(self._texture.piece(block_end_ns))
                for t_ns, x, y, polarity in others:
                    requests.append((self._scan.seen_ns(t_ns, y, block_ns), x, y, polarity))
            if self._background is not None:
                requests.append(self._background.piece(until_ns))
            yield self.readout.read(requests, until_ns)


def simulate(
    description: SceneDescription,
    seed: int = 0,
    background: Iterator[EventBatch] | None = None,
    piece_s: float = PIECE_S,
) -> tuple[Iterator[EventBatch], SceneTruth]:
    """Return a scene's events and its truth.

    Args:
        description: of the scene; see :func:`~beacon_comm.simulation.description.make_description`.
        seed: the same description and seed give the same events, whatever ``piece_s``.
        background: recorded events to mix in, from scene time 0 on, in order.
        piece_s: length of a batch (s, whole milliseconds).

    Returns:
        The batches, simulated as they are asked for: event times in ns from 0, whole microseconds, in order; and the truth.

    Raises:
        ParameterError: paths that do not fit on the sensor.
    """
    scene = SimulatedScene(description, seed, background)
    return scene.batches(piece_s), scene.truth


def _lights_and_truth(
    description: SceneDescription, shake: Trajectory | None, seed: int, random: np.random.Generator
) -> tuple[list[Light], SceneTruth]:
    sensor = description.sensor
    camera = None if description.camera is None else _camera(description.camera, sensor)

    def shaken(path: Trajectory) -> Trajectory:
        return path if shake is None else path.plus(shake)

    by_name: dict[str, Light] = {}
    beacons = []
    for index, keys in enumerate(description.beacons):
        line = line_of(keys, description.duration_s)
        path = keys.path or Still((0.5 * (sensor.width - 1), 0.5 * (sensor.height - 1)))
        try:
            trajectory = shaken(path.trajectory(description.duration_s, sensor.width, sensor.height))
        except ParameterError as error:
            raise ParameterError(f'beacons[{index}].path.{error}') from error
        light = beacon_light(keys, line, trajectory, description)
        by_name[keys.name] = light
        beacons.append(_beacon_truth(keys, line, light, description, camera))
    lights = list(by_name.values())
    distractors = []
    for index, one in enumerate(description.distractors):
        if isinstance(one, Reflection) and one.shift_px is not None:
            trajectory = by_name[one.of].trajectory.plus(Trajectory.still(*one.shift_px))
        else:
            assert one.path is not None  # checked when it was described
            try:
                trajectory = shaken(one.path.trajectory(description.duration_s, sensor.width, sensor.height))
            except ParameterError as error:
                raise ParameterError(f'distractors[{index}].path.{error}') from error
        if isinstance(one, Reflection):
            parts = [reflection_light(one, by_name[one.of], trajectory)]
        else:
            parts = lamp_lights(one, trajectory, description, random)
        lights += parts
        distractors.append(DistractorTruth(parts[0].name, parts[0].kind, trajectory))
    truth = SceneTruth(
        sensor.width,
        sensor.height,
        0.0,
        description.duration_s,
        STAMP_START_NS,
        camera,
        tuple(beacons),
        tuple(distractors),
        shake,
        seed,
    )
    return lights, truth


def _camera(keys: CameraKeys, sensor: Sensor) -> Camera:
    cx, cy = keys.centre_px or (0.5 * (sensor.width - 1), 0.5 * (sensor.height - 1))
    return Camera(sensor.width, sensor.height, keys.focal_px[0], keys.focal_px[-1], cx, cy, d=keys.distortion)


def _beacon_truth(
    keys: BeaconKeys, line: Line, light: Light, description: SceneDescription, camera: Camera | None
) -> BeaconTruth:
    # As if nothing hid it: the spot's size, not what is seen of it.
    strength = strength_of(replace(keys, occluded_s=(), shown_s=None), description)
    radius_px = threshold_radius(replace(light, strength=strength), description.sensor)
    shown = (-NEVER_NS, NEVER_NS) if keys.shown_s is None else tuple(round(one * NS_PER_S) for one in keys.shown_s)
    return BeaconTruth(
        keys.name,
        'simulated',
        light.trajectory,
        (strength[0], radius_px),
        description.sensor.width,
        description.sensor.height,
        (shown[0], shown[1]),
        np.rint(np.array(keys.occluded_s, np.float64).reshape(-1, 2) * NS_PER_S).astype(np.int64),
        keys.text,
        line.bit_rate_bps,
        line.sendings_ns,
        line.changes_ns,
        line.levels,
        camera,
        characters_ns=line.characters_ns,
        codes=line.codes,
    )


class _Recorded:
    """A recording's events, taken piece by piece."""

    def __init__(self, batches: Iterator[EventBatch], sensor: Sensor) -> None:
        self._batches = batches
        self._size = sensor.width, sensor.height
        self._waiting: list[RawEvents] = []
        self._known_ns = -1

    def piece(self, end_ns: int) -> RawEvents:
        """Return the next events before ``end_ns`` (ns)."""
        while self._known_ns < end_ns:
            batch = next(self._batches, None)
            if batch is None:
                break
            if len(batch):
                self._waiting.append((batch.t_ns, batch.x, batch.y, batch.polarity))
                self._known_ns = int(batch.t_ns[-1])
        empty = np.empty(0, np.int64), np.empty(0, np.uint16), np.empty(0, np.uint16), np.empty(0, np.int8)
        columns = [np.concatenate(parts) for parts in zip(empty, *self._waiting, strict=True)]
        split = int(np.searchsorted(columns[0], end_ns))
        self._waiting = [tuple(column[split:] for column in columns)]  # type: ignore[list-item]
        t_ns, x, y, polarity = (column[:split] for column in columns)
        return t_ns, x, y, polarity
