"""Results as JSON; the schema is part of the interface and described in ``docs/evaluation.md``.

    {"schema": 2, "recording", "receiver", "events", "seconds", "mev_per_s", "lost_packets", "skipped_words",
     "beacons": [{"track_id", "state", "confirmed_at_s", "bit_rate_bps", "text",
                  "path": [[t_s, x_px, y_px], …],
                  "characters": [{"t_s", "code", "status", "confidence"}, …],
                  "transmissions": [{"start_s", "characters", "wrong", "wrong_ok", "repaired", "inserted",
                                     "message_accuracy", "bit_accuracy"}, …]}, …],
     "scene": null or {"beacons": […], "confirmed": {…}, "tracks": {…}, …}}

One recording is one object, several are a list of them.
"""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from beacon_comm.core.errors import RecordingError
from beacon_comm.core.events import NS_PER_S
from beacon_comm.evaluation.result import BeaconResult, RecordingResult
from beacon_comm.evaluation.scene_score import BeaconScore, Count, PositionScore, SceneScore
from beacon_comm.evaluation.scoring import Interval, Transmission

SCHEMA = 2
# Digits behind the point that are kept: times to the ns, positions to a 10,000th of a pixel.
TIME_DIGITS = 9
POSITION_DIGITS = 4


def result_json(result: RecordingResult) -> dict[str, Any]:
    """Return a recording's result in the schema of the module's head."""
    return {
        'schema': SCHEMA,
        'recording': result.recording,
        'receiver': result.receiver,
        'events': result.events,
        'seconds': _seconds(result.duration_ns),
        'mev_per_s': result.mev_per_s,
        'lost_packets': result.lost_packets,
        'skipped_words': result.skipped_words,
        'beacons': [_beacon(beacon) for beacon in result.beacons],
        'scene': None if result.scene is None else _scene(result.scene),
    }


def write_json(path: str | Path, results: Sequence[RecordingResult]) -> None:
    """Write the results of one or several recordings.

    Raises:
        RecordingError: the file cannot be written.
    """
    content = [result_json(result) for result in results]
    try:
        with Path(path).open('w', encoding='utf-8') as file:
            json.dump(content[0] if len(content) == 1 else content, file)
            file.write('\n')
    except OSError as error:
        raise RecordingError(f'{path}: cannot be written ({error.strerror})') from error


def _beacon(beacon: BeaconResult) -> dict[str, Any]:
    return {
        'track_id': beacon.track_id,
        'state': beacon.state.name.lower(),
        'confirmed_at_s': None if beacon.confirmed_at_ns is None else _seconds(beacon.confirmed_at_ns),
        'bit_rate_bps': beacon.bit_rate_bps,
        'text': beacon.text,
        'path': [
            [_seconds(point.t_ns), round(point.x_px, POSITION_DIGITS), round(point.y_px, POSITION_DIGITS)]
            for point in beacon.path
        ],
        'characters': [
            {
                't_s': _seconds(character.t_ns),
                'code': character.code,
                'status': character.status.name.lower(),
                'confidence': character.confidence,
            }
            for character in beacon.characters
        ],
        'transmissions': [_transmission(transmission) for transmission in beacon.transmissions],
    }


def _transmission(transmission: Transmission) -> dict[str, Any]:
    return {
        'start_s': None if transmission.start_ns is None else _seconds(transmission.start_ns),
        'characters': transmission.characters,
        'wrong': transmission.wrong,
        'wrong_ok': transmission.wrong_ok,
        'repaired': transmission.repaired,
        'inserted': transmission.inserted,
        'message_accuracy': transmission.message_accuracy,
        'bit_accuracy': transmission.bit_accuracy,
    }


def _scene(score: SceneScore) -> dict[str, Any]:
    return {
        'sent': _count(score.sent),
        'confirmed': {
            **asdict(score.confirmed),
            'mota_interval': _interval(score.mota_interval),
            'motp_interval_px': _interval(score.motp_interval),
        },
        'tracks': asdict(score.tracks),
        'false_confirmations': list(score.false_confirmations),
        'on_reflections': list(score.on_reflections),
        'stray_characters': score.stray_characters,
        'double_characters': score.double_characters,
        'beacons': [_true_beacon(beacon) for beacon in score.beacons],
    }


def _true_beacon(beacon: BeaconScore) -> dict[str, Any]:
    return {
        'name': beacon.name,
        'kind': beacon.kind,
        'bit_rate_bps': beacon.bit_rate_bps,
        'seen_s': beacon.seen_s,
        'tracks': list(beacon.tracks),
        'sent': _count(beacon.sent) if beacon.transmissions else None,
        'locks': [{'begin_s': _seconds(lock.begin_ns), 'lock_s': lock.lock_s, 'lost': lock.lost} for lock in beacon.locks],
        'confirm_s': beacon.confirm_s,
        'position': None if beacon.position is None else _position(beacon.position),
    }


def _count(count: Count) -> dict[str, Any]:
    def accuracy(share: float) -> float | None:
        return None if math.isnan(share) else share

    return {
        **asdict(count),
        'message_accuracy': accuracy(count.message_accuracy),
        'message_interval': _interval(count.message_interval),
        'bit_accuracy': accuracy(count.bit_accuracy),
        'bit_interval': _interval(count.bit_interval),
    }


def _position(position: PositionScore) -> dict[str, Any]:
    return {
        'instants': len(position.t_ns),
        'rms_px': position.rms_px,
        'rms_interval_px': _interval(position.interval_px),
        'median_px': position.median_px,
        'p95_px': position.p95_px,
        'speed_px_per_s': position.speed_px_per_s,
        'lag_s': position.lag_s,
        'nees': position.nees,
        'nees_interval': _interval(position.nees_interval),
        'bearing_rms_rad': position.bearing_rms_rad,
        'bearing_nees': position.bearing_nees,
        'bearing_nees_interval': _interval(position.bearing_nees_interval),
    }


def _interval(interval: Interval | None) -> list[float] | None:
    return None if interval is None else [interval.low, interval.high]


def _seconds(t_ns: int) -> float:
    return round(t_ns / NS_PER_S, TIME_DIGITS)
