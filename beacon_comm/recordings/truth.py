"""The truth beside a written scene: ``truth.json``, what was put where and when.

    {"schema": 1, "sensor": [width, height], "packet_period_s", "stamp_start_ns", "seed",
     "start_s": scene time of the first packet, "duration_s",
     "background": null or {"file", "topic"},
     "beacons": [{"name", "kind": "mat" | "simulated", "clip": {"start_s", "duration_s" or null, "count"},
                  "disc": {"x_px", "y_px", "radius_px", "vx_px_per_s", "vy_px_per_s"},
                  "first_event_s", "end_s", "events", "text" or null, "bit_rate_bps" or null}, …]}

Scene times count from scene time 0, which the event clock (``sensor_time_ns``) shares.  A disc's path follows from
its numbers and the sensor's size, see :class:`~beacon_comm.recordings.disc.Disc`.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from beacon_comm.core.errors import RecordingError
from beacon_comm.core.events import NS_PER_S
from beacon_comm.recordings.disc import Disc
from beacon_comm.recordings.scene import Scene

TRUTH_NAME = 'truth.json'
_SCHEMA = 1


@dataclass(frozen=True, slots=True)
class BeaconTruth:
    """One beacon of a written scene; ``disc.centre(t_s)`` is its true path in scene time."""

    name: str
    kind: str
    disc: Disc
    first_event_s: float
    end_s: float
    events: int
    text: str | None
    bit_rate_bps: float | None


@dataclass(frozen=True, slots=True)
class SceneTruth:
    """What a written scene holds."""

    width: int
    height: int
    start_s: float
    duration_s: float
    stamp_start_ns: int
    beacons: tuple[BeaconTruth, ...]


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
    try:
        Path(path).write_text(json.dumps(content, indent=2, ensure_ascii=False) + '\n', encoding='utf-8')
    except OSError as error:
        raise RecordingError(f'{path}: cannot be written ({error.strerror})') from error


def read_truth(path: str | Path) -> SceneTruth:
    """Read what :func:`write_truth` wrote; ``path`` is the file, or the bag's folder that holds it.

    Raises:
        RecordingError: missing, no JSON, or of another schema.
    """
    path = Path(path)
    file = path / TRUTH_NAME if path.is_dir() else path
    try:
        content = json.loads(file.read_text(encoding='utf-8'))
    except (OSError, ValueError) as error:
        raise RecordingError(f'{file}: cannot be read ({error})') from error
    try:
        if content['schema'] != _SCHEMA:
            raise ValueError(f'schema {content["schema"]}, not {_SCHEMA}')
        width, height = content['sensor']
        return SceneTruth(
            width,
            height,
            content['start_s'],
            content['duration_s'],
            content['stamp_start_ns'],
            tuple(_beacon(entry, width, height) for entry in content['beacons']),
        )
    except (ValueError, KeyError, TypeError) as error:
        raise RecordingError(f'{file}: not the truth of a scene ({error!r})') from error


def _beacon(entry: dict[str, Any], width: int, height: int) -> BeaconTruth:
    return BeaconTruth(
        entry['name'],
        entry['kind'],
        Disc(**entry['disc'], width=width, height=height),
        entry['first_event_s'],
        entry['end_s'],
        entry['events'],
        entry['text'],
        entry['bit_rate_bps'],
    )
