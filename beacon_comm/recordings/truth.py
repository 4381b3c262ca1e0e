"""The truth beside a written scene: ``truth.json``, what was put where and when.

Schema 1, a scene merged from recordings::

    {"schema": 1, "sensor": [width, height], "packet_period_s", "stamp_start_ns", "seed",
     "start_s": scene time of the first packet, "duration_s",
     "background": null or {"file", "topic"},
     "beacons": [{"name", "kind": "mat" | "simulated", "clip": {"start_s", "duration_s" or null, "count"},
                  "disc": {"x_px", "y_px", "radius_px", "vx_px_per_s", "vy_px_per_s"},
                  "first_event_s", "end_s", "events", "text" or null, "bit_rate_bps" or null}, …]}

Schema 2, a simulated scene; its long arrays stand in ``truth.npz`` beside it, by names that begin with the key there::

    {"schema": 2, "sensor": [width, height], "stamp_start_ns", "seed", "start_s", "duration_s",
     "camera": null or {"fx", "fy", "cx", "cy", "model", "d"},
     "camera_path": null or key            → key_t_ns (k,), key_x_px (k,), key_y_px (k,): shift of the image
     "beacons": [{"name", "kind", "key", "shown_ns": [begin, end], "text", "bit_rate_bps", "events"}, …],
                                           → key_t_ns, key_x_px, key_y_px: knots of the path, straight between them
                                             key_radius_t_ns (m,), key_radius_px (m,)
                                             key_azimuth_rad, key_elevation_rad (k,): bearings at the knots, with a camera
                                             key_hidden_ns (n, 2), key_sendings_ns (s,), key_changes_ns (c,), key_levels (c,)
                                             key_characters_ns (m,), key_codes (m,): each character's begin and code
     "distractors": [{"name", "kind", "key"}, …]     → key_t_ns, key_x_px, key_y_px
     "description": the scene as its file describes it}

Scene times count from scene time 0, which the event clock (``sensor_time_ns``) shares.
"""

from __future__ import annotations

import json
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from beacon_comm.core.errors import RecordingError
from beacon_comm.core.events import NS_PER_S
from beacon_comm.recordings.disc import Disc
from beacon_comm.recordings.scene import Scene
from beacon_comm.simulation.trajectory import Trajectory
from beacon_comm.simulation.truth import BeaconTruth, Camera, DistractorTruth, SceneTruth

TRUTH_NAME = 'truth.json'
ARRAYS_NAME = 'truth.npz'
_SCHEMA = 1
_SIMULATED_SCHEMA = 2

Arrays = dict[str, NDArray[Any]]


def write_truth(path: str | Path, scene: Scene, start_s: float = 0.0, duration_s: float | None = None) -> None:
    """Write a scene's truth.

    Args:
        path: the JSON file.
        scene: the scene.
        start_s, duration_s: what was written of it, as in :meth:`Scene.packets`.

    Raises:
        RecordingError: the file cannot be written.
    """
    content = {
        'schema': _SCHEMA,
        'sensor': [scene.width, scene.height],
        'packet_period_s': scene.packet_period_ns / NS_PER_S,
        'stamp_start_ns': scene.stamp_start_ns,
        'seed': scene.seed,
        'start_s': start_s,
        'duration_s': scene.end_ns / NS_PER_S - start_s if duration_s is None else duration_s,
        'background': scene.background and {'file': scene.background.name, 'topic': scene.background.topic},
        'beacons': [
            {
                'name': beacon.name,
                'kind': beacon.kind,
                'clip': {
                    'start_s': beacon.clip.start_s,
                    'duration_s': beacon.clip.duration_s,
                    'count': beacon.clip.count,
                },
                'disc': {
                    'x_px': beacon.disc.x_px,
                    'y_px': beacon.disc.y_px,
                    'radius_px': beacon.disc.radius_px,
                    'vx_px_per_s': beacon.disc.vx_px_per_s,
                    'vy_px_per_s': beacon.disc.vy_px_per_s,
                },
                'first_event_s': int(beacon.t_ns[0]) / NS_PER_S,
                'end_s': beacon.end_ns / NS_PER_S,
                'events': len(beacon.t_ns),
                'text': beacon.text,
                'bit_rate_bps': beacon.bit_rate_bps,
            }
            for beacon in scene.beacons
        ],
    }
    _write_json(Path(path), content)


def write_simulated_truth(folder: str | Path, truth: SceneTruth, description: Mapping[str, object] | None = None) -> None:
    """Write a simulated scene's truth, ``truth.json`` and ``truth.npz``, into a folder.

    Args:
        folder: of the bag.
        truth: of the scene.
        description: the scene as its file describes it, kept as it is.

    Raises:
        RecordingError: a file cannot be written.
    """
    arrays: Arrays = {}
    camera = truth.camera
    content = {
        'schema': _SIMULATED_SCHEMA,
        'sensor': [truth.width, truth.height],
        'stamp_start_ns': truth.stamp_start_ns,
        'seed': truth.seed,
        'start_s': truth.start_s,
        'duration_s': truth.duration_s,
        'camera': camera
        and {'fx': camera.fx, 'fy': camera.fy, 'cx': camera.cx, 'cy': camera.cy, 'model': camera.model, 'd': camera.d},
        'camera_path': truth.camera_path and _path_arrays(arrays, 'camera', truth.camera_path),
        'beacons': [
            {
                'name': beacon.name,
                'kind': beacon.kind,
                'key': _beacon_arrays(arrays, f'beacon{index}', beacon),
                'shown_ns': beacon.shown_ns,
                'text': beacon.text,
                'bit_rate_bps': beacon.bit_rate_bps,
                'events': beacon.events,
            }
            for index, beacon in enumerate(truth.beacons)
        ],
        'distractors': [
            {'name': one.name, 'kind': one.kind, 'key': _path_arrays(arrays, f'distractor{index}', one.trajectory)}
            for index, one in enumerate(truth.distractors)
        ],
        'description': description,
    }
    file = Path(folder) / ARRAYS_NAME
    try:
        np.savez_compressed(file, **arrays)  # type: ignore[arg-type]
    except OSError as error:
        raise RecordingError(f'{file}: cannot be written ({error.strerror})') from error
    _write_json(Path(folder) / TRUTH_NAME, content)


def _write_json(path: Path, content: Mapping[str, object]) -> None:
    try:
        path.write_text(json.dumps(content, indent=2, ensure_ascii=False) + '\n', encoding='utf-8')
    except OSError as error:
        raise RecordingError(f'{path}: cannot be written ({error.strerror})') from error


def _path_arrays(arrays: Arrays, key: str, path: Trajectory) -> str:
    arrays |= {f'{key}_t_ns': path.t_ns, f'{key}_x_px': path.x_px, f'{key}_y_px': path.y_px}
    return key


def _beacon_arrays(arrays: Arrays, key: str, beacon: BeaconTruth) -> str:
    for name in ('hidden_ns', 'sendings_ns', 'changes_ns', 'levels', 'characters_ns', 'codes'):
        arrays[f'{key}_{name}'] = getattr(beacon, name)
    arrays[f'{key}_radius_t_ns'], arrays[f'{key}_radius_px'] = beacon.radii
    bearings = beacon.bearing(beacon.trajectory.t_ns)
    if bearings is not None:
        arrays[f'{key}_azimuth_rad'], arrays[f'{key}_elevation_rad'] = bearings
    return _path_arrays(arrays, key, beacon.trajectory)


def read_truth(path: str | Path) -> SceneTruth:
    """Read what :func:`write_truth` or :func:`write_simulated_truth` wrote.

    Args:
        path: the JSON file, or the bag's folder that holds it.

    Raises:
        RecordingError: missing, no JSON, or of another schema.
    """
    path = Path(path)
    file = path / TRUTH_NAME if path.is_dir() else path
    try:
        content = json.loads(file.read_text(encoding='utf-8'))
    except (OSError, ValueError, RecursionError) as error:
        raise RecordingError(f'{file}: cannot be read ({error})') from error
    try:
        if content['schema'] == _SCHEMA:
            return _merged_scene(content)
        if content['schema'] == _SIMULATED_SCHEMA:
            return _simulated_scene(content, _read_arrays(file.parent / ARRAYS_NAME))
        raise ValueError(f'schema {content["schema"]}, not {_SCHEMA} or {_SIMULATED_SCHEMA}')
    except (ValueError, KeyError, TypeError) as error:
        raise RecordingError(f'{file}: not the truth of a scene ({error!r})') from error


def _read_arrays(file: Path) -> Arrays:
    try:
        with np.load(file, allow_pickle=False) as stored:
            return dict(stored)
    except (OSError, ValueError, EOFError, zipfile.BadZipFile) as error:
        raise RecordingError(f'{file}: cannot be read ({error})') from error


def _merged_scene(content: Mapping[str, Any]) -> SceneTruth:
    width, height = content['sensor']
    until_s = content['start_s'] + content['duration_s']
    return SceneTruth(
        width,
        height,
        content['start_s'],
        content['duration_s'],
        content['stamp_start_ns'],
        None,
        tuple(_merged_beacon(entry, width, height, until_s) for entry in content['beacons']),
        seed=content.get('seed', 0),
    )


def _merged_beacon(entry: Mapping[str, Any], width: int, height: int, until_s: float) -> BeaconTruth:
    disc = Disc(**entry['disc'], width=width, height=height)
    return BeaconTruth(
        entry['name'],
        entry['kind'],
        disc.trajectory(max(until_s, entry['end_s'])),
        (np.zeros(1, np.int64), np.array([disc.radius_px])),
        width,
        height,
        (round(entry['first_event_s'] * NS_PER_S), round(entry['end_s'] * NS_PER_S)),
        text=entry['text'],
        bit_rate_bps=entry['bit_rate_bps'],
        events=entry['events'],
    )


def _simulated_scene(content: Mapping[str, Any], arrays: Arrays) -> SceneTruth:
    width, height = content['sensor']
    camera = None
    if content['camera'] is not None:
        camera = Camera(width, height, **{**content['camera'], 'd': tuple(content['camera']['d'])})
    key = content['camera_path']
    return SceneTruth(
        width,
        height,
        content['start_s'],
        content['duration_s'],
        content['stamp_start_ns'],
        camera,
        tuple(_simulated_beacon(entry, arrays, width, height, camera) for entry in content['beacons']),
        tuple(DistractorTruth(one['name'], one['kind'], _path(arrays, one['key'])) for one in content['distractors']),
        None if key is None else _path(arrays, key),
        content['seed'],
    )


def _simulated_beacon(entry: Mapping[str, Any], arrays: Arrays, width: int, height: int, camera: Camera | None) -> BeaconTruth:
    key = entry['key']
    begin_ns, end_ns = entry['shown_ns']
    return BeaconTruth(
        entry['name'],
        entry['kind'],
        _path(arrays, key),
        (arrays[f'{key}_radius_t_ns'], arrays[f'{key}_radius_px']),
        width,
        height,
        (begin_ns, end_ns),
        arrays[f'{key}_hidden_ns'],
        entry['text'],
        entry['bit_rate_bps'],
        arrays[f'{key}_sendings_ns'],
        arrays[f'{key}_changes_ns'],
        arrays[f'{key}_levels'],
        camera,
        entry['events'],
        arrays[f'{key}_characters_ns'],
        arrays[f'{key}_codes'],
    )


def _path(arrays: Arrays, key: str) -> Trajectory:
    return Trajectory(arrays[f'{key}_t_ns'], arrays[f'{key}_x_px'], arrays[f'{key}_y_px'])
