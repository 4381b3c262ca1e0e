"""Results as tables for a terminal, and the paper's figures beside ours."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import PurePath

import numpy as np

from beacon_comm.core.events import NS_PER_S
from beacon_comm.evaluation.intervals import bootstrap_interval, mean_interval
from beacon_comm.evaluation.result import BeaconResult, RecordingResult
from beacon_comm.evaluation.scene_score import BeaconScore, Count, PositionScore, SceneScore
from beacon_comm.evaluation.scoring import Interval, Transmission

SCORE_COLUMNS = (
    'recording', 'receiver', 'track', 'start', 'bit/s', 'characters', 'wrong', 'missing', 'inserted', 'wrong ok', 'repaired',
    'message accuracy', 'bit accuracy',
)  # fmt: skip
PUBLISHED_COLUMNS = ('recording', 'receiver', 'paper: message', 'ours: message', 'right', 'paper: bits', 'ours: bits')
TEXT_COLUMNS = ('recording', 'receiver', 'track', 'state', 'bit/s', 'confirmed', 'bearing', 'characters', 'ok', 'end of text')
RECORDING_COLUMNS = (
    'recording', 'receiver', 'events', 'seconds', 'Mev/s', 'lost packets', 'skipped words', 'beacons', 'other tracks',
)  # fmt: skip
BEACON_COLUMNS = (
    'recording', 'receiver', 'beacon', 'bit/s', 'tracks', 'characters', 'wrong', 'wrong ok', 'message accuracy', 'bit accuracy',
    'locked', 'confirmed', 'px/s', 'error rms', 'p95', 'lag', 'NEES',
)  # fmt: skip
TRACKING_COLUMNS = (
    'recording', 'receiver', 'reports', 'MOTA', 'MOTP', 'IDF1', 'HOTA', 'ID switches', 'swaps', 'fragmentations', 'missed',
    'false positives', 'false confirmations',
)  # fmt: skip
SUMMARY_COLUMNS = (
    'receiver', 'scenes', 'beacons', 'characters', 'message accuracy', 'bit accuracy', 'MOTA', 'MOTP', 'IDF1', 'HOTA', 'swaps',
    'false confirmations', 'locked', 'confirmed', 'error rms', 'NEES',
)  # fmt: skip
LEFT = ('recording', 'receiver', 'beacon', 'reports', 'state', 'end of text')
# Characters of a text that a table shows.
SHOWN_TEXT = 48


@dataclass(frozen=True, slots=True)
class PublishedFigure:
    """Message and bit accuracy of the paper's section IV, table "Outdoor Experiment"."""

    message_accuracy: float
    bit_accuracy: float


# By the name that the published recording has.
PUBLISHED = {
    '504hz_30m': PublishedFigure(1.0, 1.0),
    '504hz_100m': PublishedFigure(1.0, 1.0),
    '3125hz_30m': PublishedFigure(0.877, 0.987),
    '3125hz_100m': PublishedFigure(0.435, 0.906),
}


def table(columns: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Return a table with aligned columns, numbers right, texts left; the receiver's only where there are several."""
    columns, rows = without_sole_receiver(columns, rows)
    cells = [tuple(columns), *(tuple(row) for row in rows)]
    widths = [max(len(row[column]) for row in cells) for column in range(len(columns))]
    left = {column for column, name in enumerate(columns) if name in LEFT}
    lines = [
        '  '.join(
            cell.ljust(width) if column in left else cell.rjust(width)
            for column, (cell, width) in enumerate(zip(row, widths, strict=True))
        ).rstrip()
        for row in cells
    ]
    lines.insert(1, '  '.join('-' * width for width in widths))
    return '\n'.join(lines)


def without_sole_receiver(
    columns: Sequence[str], rows: Sequence[Sequence[str]]
) -> tuple[Sequence[str], Sequence[Sequence[str]]]:
    """Leave out the column of the receivers where all rows have the same."""
    if 'receiver' not in columns or len({row[columns.index('receiver')] for row in rows}) > 1:
        return columns, rows
    kept = [n for n, name in enumerate(columns) if name != 'receiver']
    return [columns[n] for n in kept], [[row[n] for n in kept] for row in rows]


def recordings_table(results: Sequence[RecordingResult]) -> str:
    """Return one row a recording: size, speed, losses, number of beacons."""
    return table(RECORDING_COLUMNS, recording_rows(results))


def recording_rows(results: Sequence[RecordingResult]) -> list[tuple[str, ...]]:
    """Return the rows of :func:`recordings_table`."""
    return [
        (
            name_of(result),
            result.receiver,
            f'{result.events:,}',
            f'{result.duration_ns / NS_PER_S:.3f}',
            f'{result.mev_per_s:.2f}',
            str(result.lost_packets),
            str(result.skipped_words),
            str(sum(beacon.confirmed_at_ns is not None for beacon in result.beacons)),
            str(result.silent_tracks + sum(beacon.confirmed_at_ns is None for beacon in result.beacons)),
        )
        for result in results
    ]


def scores_table(results: Sequence[RecordingResult]) -> str:
    """Return one row a transmission: its fitted start and rate, counts, accuracies with 95 % confidence intervals."""
    return table(SCORE_COLUMNS, score_rows(results))


def score_rows(results: Sequence[RecordingResult]) -> list[tuple[str, ...]]:
    """Return the rows of :func:`scores_table`."""
    return [
        _score_row(result, beacon, transmission)
        for result in results
        for beacon in result.beacons
        for transmission in beacon.transmissions
    ]


def beacons_table(results: Sequence[RecordingResult]) -> str:
    """Return one row a true beacon of a scene: characters, times, errors, with 95 % confidence intervals."""
    return table(BEACON_COLUMNS, beacon_rows(results))


def beacon_rows(results: Sequence[RecordingResult]) -> list[tuple[str, ...]]:
    """Return the rows of :func:`beacons_table`."""
    rows = []
    for result in results:
        for beacon in () if result.scene is None else result.scene.beacons:
            count = beacon.sent
            known = bool(beacon.transmissions)
            rows.append(
                (
                    name_of(result),
                    result.receiver,
                    beacon.name,
                    '-' if beacon.bit_rate_bps is None else f'{beacon.bit_rate_bps:g}',
                    ', '.join(map(str, beacon.tracks)) or 'none',
                    str(count.characters) if known else '-',
                    str(count.wrong) if known else '-',
                    str(count.wrong_ok) if known else '-',
                    _share(count.message_accuracy, count.message_interval, 3) if known else '-',
                    _share(count.bit_accuracy, count.bit_interval, 4) if known else '-',
                    _milliseconds(beacon.locks[0].lock_s) if beacon.locks else '-',
                    _milliseconds(beacon.confirm_s),
                    *_position_cells(beacon.position),
                )
            )
    return rows


def summary_table(results: Sequence[RecordingResult]) -> str | None:
    """Return one row a receiver over all scenes, None with less than two; intervals are from scene to scene."""
    rows = summary_rows(results)
    return table(SUMMARY_COLUMNS, rows) if rows else None


def summary_rows(results: Sequence[RecordingResult]) -> list[tuple[str, ...]]:
    """Return the rows of :func:`summary_table`; none with less than two scenes."""
    rows: list[tuple[str, ...]] = []
    for receiver in dict.fromkeys(result.receiver for result in results):
        scenes = [result.scene for result in results if result.receiver == receiver and result.scene is not None]
        if len(scenes) < 2:
            continue
        beacons = [beacon for scene in scenes for beacon in scene.beacons]
        sent = Count.of([one for beacon in beacons for one in beacon.transmissions])
        known = sent.characters > 0
        rows.append(
            (
                receiver,
                str(len(scenes)),
                f'{sum(bool(beacon.tracks) for beacon in beacons)} of {len(beacons)}',
                str(sent.characters) if known else '-',
                _share(sent.message_accuracy, sent.message_interval, 3) if known else '-',
                _share(sent.bit_accuracy, sent.bit_interval, 4) if known else '-',
                _mean([scene.confirmed.mota for scene in scenes], 3),
                _mean([scene.confirmed.motp_px for scene in scenes], 2, ' px'),
                _mean([scene.confirmed.idf1 for scene in scenes], 3),
                _mean([scene.confirmed.hota for scene in scenes], 3),
                str(sum(scene.confirmed.swaps for scene in scenes)),
                str(sum(len(scene.false_confirmations) for scene in scenes)),
                _mean([_of_beacons(scene, _first_lock_ms) for scene in scenes], 0, ' ms'),
                _mean([_of_beacons(scene, _confirm_ms) for scene in scenes], 0, ' ms'),
                _rms(scenes),
                _mean([_of_beacons(scene, _nees) for scene in scenes], 2),
            )
        )
    return rows


def _first_lock_ms(beacon: BeaconScore) -> float | None:
    lock_s = beacon.locks[0].lock_s if beacon.locks else None
    return None if lock_s is None else 1e3 * lock_s


def _confirm_ms(beacon: BeaconScore) -> float | None:
    return None if beacon.confirm_s is None else 1e3 * beacon.confirm_s


def _nees(beacon: BeaconScore) -> float | None:
    return None if beacon.position is None else beacon.position.nees


def _of_beacons(scene: SceneScore, value_of: Callable[[BeaconScore], float | None]) -> float | None:
    """Return the mean over a scene's beacons, None where none has a value."""
    values = [value for beacon in scene.beacons if (value := value_of(beacon)) is not None]
    return float(np.mean(values)) if values else None


def _mean(values: Sequence[float | None], digits: int, unit: str = '') -> str:
    """Return the mean over scenes, with its interval from five scenes on."""
    found = np.array([value for value in values if value is not None], np.float64)
    return _share(float(found.mean()), mean_interval(found), digits) + unit if len(found) else '-'


def _rms(scenes: Sequence[SceneScore]) -> str:
    squares = [
        [float(np.sum(beacon.position.error_px**2)), float(len(beacon.position.t_ns))]
        for scene in scenes
        for beacon in scene.beacons
        if beacon.position is not None
    ]
    if not squares:
        return '-'
    blocks = np.array(squares)
    interval = bootstrap_interval(blocks, lambda sums: np.sqrt(sums[:, 0] / sums[:, 1]))
    return _share(float(np.sqrt(blocks[:, 0].sum() / blocks[:, 1].sum())), interval, 2) + ' px'


def tracking_table(results: Sequence[RecordingResult]) -> str:
    """Return two rows a scene, the confirmed tracks and all: the field's measures, with 95 % confidence intervals."""
    return table(TRACKING_COLUMNS, tracking_rows(results))


def tracking_rows(results: Sequence[RecordingResult]) -> list[tuple[str, ...]]:
    """Return the rows of :func:`tracking_table`."""
    rows = []
    for result in results:
        scene = result.scene
        if scene is None:
            continue
        for name, score in (('confirmed', scene.confirmed), ('all tracks', scene.tracks)):
            of_confirmed = score is scene.confirmed
            mota, motp = (scene.mota_interval, scene.motp_interval) if of_confirmed else (None, None)
            rows.append(
                (
                    name_of(result),
                    result.receiver,
                    name,
                    '-' if score.mota is None else _share(score.mota, mota, 3),
                    '-' if score.motp_px is None else _share(score.motp_px, motp, 2) + ' px',
                    *('-' if value is None else f'{value:.3f}' for value in (score.idf1, score.hota)),
                    str(score.id_switches),
                    str(score.swaps),
                    str(score.fragmentations),
                    f'{score.misses} of {score.objects}',
                    str(score.false_positives),
                    str(len(scene.false_confirmations)) if of_confirmed else '-',
                )
            )
    return rows


def _position_cells(position: PositionScore | None) -> tuple[str, ...]:
    if position is None:
        return ('-',) * 5
    return (
        f'{position.speed_px_per_s:.0f}',
        _share(position.rms_px, position.interval_px, 2) + ' px',
        f'{position.p95_px:.2f} px',
        _milliseconds(position.lag_s, 2),
        '-' if position.nees is None else _share(position.nees, position.nees_interval, 2),
    )


def _milliseconds(value_s: float | None, digits: int = 0) -> str:
    return '-' if value_s is None else f'{1e3 * value_s:.{digits}f} ms'


def texts_table(results: Sequence[RecordingResult]) -> str:
    """Return one row a listed beacon: state, bearing and the end of its text."""
    return table(TEXT_COLUMNS, text_rows(results))


def text_rows(results: Sequence[RecordingResult]) -> list[tuple[str, ...]]:
    """Return the rows of :func:`texts_table`."""
    rows: list[tuple[str, ...]] = []
    for result in results:
        for beacon in listed(result):
            ok = sum(character.status.name == 'OK' for character in beacon.characters)
            shown = repr(beacon.text[-SHOWN_TEXT:])[1:-1]
            rows.append(
                (
                    name_of(result),
                    result.receiver,
                    str(beacon.track_id),
                    beacon.state.name.lower(),
                    '-' if beacon.bit_rate_bps is None else f'{beacon.bit_rate_bps:g}',
                    '-' if beacon.confirmed_at_ns is None else f'{beacon.confirmed_at_ns / NS_PER_S:.3f} s',
                    _bearing(beacon),
                    str(len(beacon.characters)),
                    str(ok),
                    shown,
                )
            )
    return rows


def listed(result: RecordingResult) -> tuple[BeaconResult, ...]:
    """Return the beacons worth a row: confirmed or scored ones, and the only one of a recording."""
    if len(result.beacons) == 1:
        return result.beacons
    return tuple(beacon for beacon in result.beacons if beacon.confirmed_at_ns is not None or beacon.transmissions)


def published_table(results: Sequence[RecordingResult]) -> str | None:
    """Return the paper's figures beside ours, None where no published recording is among the results.

    The paper counts one sonnet a recording, the second one, whose start it detects: so the last transmission.
    """
    rows = published_rows(results)
    return table(PUBLISHED_COLUMNS, rows) if rows else None


def published_rows(results: Sequence[RecordingResult]) -> list[tuple[str, ...]]:
    """Return the rows of :func:`published_table`."""
    rows: list[tuple[str, ...]] = []
    for result in results:
        paper = PUBLISHED.get(PurePath(result.recording).stem)
        transmissions = [transmission for beacon in result.beacons for transmission in beacon.transmissions]
        if paper is None or not transmissions:
            continue
        ours = transmissions[-1]
        right = max(0, ours.characters - ours.wrong) if ours.found else 0
        rows.append(
            (
                PurePath(result.recording).stem,
                result.receiver,
                f'{paper.message_accuracy:.3f}',
                f'{ours.message_accuracy:.3f}',
                f'{right} of {ours.characters}',
                f'{paper.bit_accuracy:.3f}',
                f'{ours.bit_accuracy:.4f}',
            )
        )
    return rows


def name_of(result: RecordingResult) -> str:
    """Return a recording's name for tables."""
    return PurePath(result.recording).name or result.recording


def _score_row(result: RecordingResult, beacon: BeaconResult, transmission: Transmission) -> tuple[str, ...]:
    return (
        name_of(result),
        result.receiver,
        str(beacon.track_id),
        'not found' if transmission.start_ns is None else f'{transmission.start_ns / NS_PER_S:.3f} s',
        '-' if transmission.bit_rate_bps is None else f'{transmission.bit_rate_bps:.2f}',
        str(transmission.characters),
        str(transmission.wrong),
        str(transmission.missing),
        str(transmission.inserted),
        str(transmission.wrong_ok),
        str(transmission.repaired),
        _share(transmission.message_accuracy, transmission.message_interval if transmission.found else None, 3),
        _share(transmission.bit_accuracy, transmission.bit_interval if transmission.found else None, 4),
    )


def _share(share: float, interval: Interval | None, digits: int) -> str:
    if interval is None:
        return f'{share:.{digits}f}'
    return f'{share:.{digits}f} [{interval.low:.{digits}f}, {interval.high:.{digits}f}]'


def _bearing(beacon: BeaconResult) -> str:
    if beacon.azimuth_rad is None or beacon.elevation_rad is None:
        return '-'
    return f'{math.degrees(beacon.azimuth_rad):+.2f}° {math.degrees(beacon.elevation_rad):+.2f}°'
