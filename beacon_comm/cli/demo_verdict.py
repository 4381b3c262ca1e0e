"""The demo's verdict: what the node said, held against what is known to have been sent.

The truth is used for judging only; nothing of it reaches the node.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from beacon_comm.core.character import Character
from beacon_comm.core.events import NS_PER_S
from beacon_comm.evaluation.scoring import score
from beacon_comm.recordings.sources import Beacon

# The published demodulator reads 542 of 618 characters of the 3125 bps recording.
LEAST_RIGHT_SHARE = 0.8
FARTHEST_PX = 3.0


@dataclass
class Heard:
    """What was heard of one track.

    Attributes:
        track_id: its label.
        characters: its characters, in order of arrival.
        path: ``(sensor_time_ns, x_px, y_px)`` while it was confirmed; empty: it never was.
    """

    track_id: int
    characters: list[Character] = field(default_factory=list)
    path: list[tuple[int, float, float]] = field(default_factory=list)


@dataclass(frozen=True, slots=True)
class Verdict:
    """How it went: passed or not, and one line that says why."""

    passed: bool
    line: str


def judge(tracks: Sequence[Heard], beacons: Sequence[Beacon], lost_packets: int | None) -> Verdict:
    """Judge what was heard.

    Args:
        tracks: all tracks, confirmed or not.
        beacons: the scene's sources; those without a text are no beacons, and may not be confirmed.
        lost_packets: as the node counted them, None if it did not say.
    """
    senders = [beacon for beacon in beacons if beacon.text is not None]
    confirmed = [track for track in tracks if track.path]
    found: dict[int, list[tuple[Heard, float]]] = {index: [] for index in range(len(senders))}
    false = 0
    for track in confirmed:
        errors = [_path_error_px(track, beacon) for beacon in senders]
        nearest = int(np.argmin(errors))
        if errors[nearest] <= FARTHEST_PX:
            found[nearest].append((track, errors[nearest]))
        else:
            false += 1
    right = sent = 0
    shares = []
    for index, beacon in enumerate(senders):
        beacon_right, beacon_sent = _right_characters([track for track, _ in found[index]], beacon)
        right, sent = right + beacon_right, sent + beacon_sent
        shares.append(beacon_right / beacon_sent if beacon_sent else 0.0)
    number = sum(bool(tracks_of_it) for tracks_of_it in found.values())
    passed = number == len(senders) and false == 0 and min(shares) >= LEAST_RIGHT_SHARE
    distance_px = max((error for each in found.values() for _, error in each), default=float('nan'))
    share = f'{right} of {sent} characters right ({100 * right / sent:.1f} %)' if sent else 'no character right'
    lost = 'loss of packets unknown' if lost_packets is None else f'{lost_packets} packets lost'
    line = (
        f'demo {"passed" if passed else "FAILED"}: {number} of {len(senders)} beacons confirmed, {false} false; '
        f'{share}; {distance_px:.1f} px from the true paths; {lost}'
    )
    return Verdict(passed, line)


def _path_error_px(track: Heard, beacon: Beacon) -> float:
    t_ns, x_px, y_px = (np.array(column, np.float64) for column in zip(*track.path, strict=True))
    true_x, true_y = beacon.disc.centre(t_ns / NS_PER_S)
    return float(np.median(np.hypot(x_px - true_x, y_px - true_y)))


def _right_characters(tracks: Sequence[Heard], beacon: Beacon) -> tuple[int, int]:
    """Return how many characters of the truth were right, and how many there were."""
    assert beacon.text is not None
    characters = [character for track in tracks for character in track.characters]
    transmissions = score(characters, beacon.text, (int(beacon.t_ns[0]), beacon.end_ns))
    sent = sum(transmission.characters for transmission in transmissions)
    return sent - sum(transmission.wrong for transmission in transmissions), sent
