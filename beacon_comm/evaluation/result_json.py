"""Results as JSON; the schema is part of the interface and described in ``docs/evaluation.md``.

    {"recording", "receiver", "events", "seconds", "mev_per_s", "lost_packets", "skipped_words",
     "beacons": [{"track_id", "state", "confirmed_at_s", "bit_rate_bps", "text",
                  "path": [[t_s, x_px, y_px], …],
                  "characters": [{"t_s", "code", "status", "confidence"}, …],
                  "transmissions": [{"start_s", "characters", "wrong", "wrong_ok", "repaired", "inserted",
                                     "message_accuracy", "bit_accuracy"}, …]}, …]}

One recording is one object, several are a list of them.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from beacon_comm.core.errors import RecordingError
from beacon_comm.core.events import NS_PER_S
from beacon_comm.evaluation.result import BeaconResult, RecordingResult
from beacon_comm.evaluation.scoring import Transmission

# Digits behind the point that are kept: times to the ns, positions to a 10,000th of a pixel.
TIME_DIGITS = 9
POSITION_DIGITS = 4


def result_json(result: RecordingResult) -> dict[str, Any]:
    """Return a recording's result in the schema of the module's head."""
    return {
        'recording': result.recording,
        'receiver': result.receiver,
        'events': result.events,
        'seconds': _seconds(result.duration_ns),
        'mev_per_s': result.mev_per_s,
        'lost_packets': result.lost_packets,
        'skipped_words': result.skipped_words,
        'beacons': [_beacon(beacon) for beacon in result.beacons],
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


def _seconds(t_ns: int) -> float:
    return round(t_ns / NS_PER_S, TIME_DIGITS)
