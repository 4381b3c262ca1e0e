"""``beacon_evaluate --report DIR``: one HTML page of everything that was evaluated, with its figures."""

from __future__ import annotations

import html
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path

import numpy as np

from beacon_comm.cli.offline import Options
from beacon_comm.cli.progress import progress
from beacon_comm.cli.report_views import MOST_SIGNALS, RecordingView, Subject, view_recording
from beacon_comm.core.character import Status
from beacon_comm.core.events import NS_PER_S
from beacon_comm.core.framing import CharacterFrame
from beacon_comm.core.parameters import Parameters
from beacon_comm.evaluation.figures import (
    RatePoint,
    Series,
    image_figure,
    over_time_figure,
    rate_figure,
    reliability_figure,
    rolling_share,
    signal_figure,
)
from beacon_comm.evaluation.page import STYLE, Page, parameters_table
from beacon_comm.evaluation.reliability import Bin, Due, expected_calibration_error, judged, reliability_bins
from beacon_comm.evaluation.report import (
    BEACON_COLUMNS,
    PUBLISHED_COLUMNS,
    RECORDING_COLUMNS,
    SCORE_COLUMNS,
    SUMMARY_COLUMNS,
    TEXT_COLUMNS,
    TRACKING_COLUMNS,
    beacon_rows,
    name_of,
    published_rows,
    recording_rows,
    score_rows,
    summary_rows,
    text_rows,
    tracking_rows,
)
from beacon_comm.evaluation.result import RecordingResult
from beacon_comm.evaluation.scene_score import Count
from beacon_comm.evaluation.scene_truth import dues
from beacon_comm.evaluation.scoring import Transmission

PAGE_NAME = 'index.html'
# So many judged characters tell whether a confidence is true.
FEWEST_JUDGED = 50


def write_report(
    folder: Path, groups: Sequence[Sequence[RecordingResult]], options: Mapping[str, Options], command: str, comparable: bool
) -> Path:
    """Write the page; return its file.

    Args:
        folder: where; it exists.
        groups: the results of each recording, one a receiver.
        options: by receiver.
        command: that made it, for the page.
        comparable: whether the results can stand beside the paper's figures.

    Raises:
        BeaconCommError: a recording cannot be read again, or the page cannot be written.
    """
    import matplotlib

    with matplotlib.rc_context(STYLE):
        page = _page(groups, options, command, comparable)
    path = folder / PAGE_NAME
    page.write(path)
    return path


def _page(
    groups: Sequence[Sequence[RecordingResult]], options: Mapping[str, Options], command: str, comparable: bool
) -> Page:
    results = [result for group in groups for result in group]
    frames = {receiver: CharacterFrame.from_parameters(one.parameters) for receiver, one in options.items()}
    frame = next(iter(frames.values()))
    names = list(dict.fromkeys(name_of(result) for result in results))
    said = names[0] if len(names) == 1 else f'{len(names)} recordings'
    receivers = ' and '.join(options)
    page = Page(
        f'{said}: what the receiver read',
        f'Receiver: {html.escape(receivers)}. Brackets are 95 % confidence intervals.'
        + (f' The numbers below are of {html.escape(results[0].receiver)}.' if len(options) > 1 else ''),
    )
    page.tiles(_tiles(results))
    page.raw(f'<pre>{html.escape(command)}</pre>')
    page.section('Results')
    page.table(RECORDING_COLUMNS, recording_rows(results))
    if any(result.scene is not None for result in results):
        page.heading('Beacons, against the truth')
        page.table(BEACON_COLUMNS, beacon_rows(results))
        page.paragraph(
            'Times from the beginning of the first complete character in sight; <em>error</em>: distance of confirmed tracks'
            ' from the true centre; <em>lag</em> along the motion; <em>NEES</em>: 1 where the stated covariance is true, a dash'
            ' where none is stated.',
            note=True,
        )
        page.heading('Tracking')
        page.table(TRACKING_COLUMNS, tracking_rows(results))
        page.paragraph(
            '<em>confirmed</em>: what the receiver says is a beacon, while it says so. <em>all tracks</em>: what detection'
            ' finds, beacon or not; its false positives are other blobs.',
            note=True,
        )
        summary = summary_rows(results)
        if summary:
            page.heading('All scenes together')
            page.table(SUMMARY_COLUMNS, summary)
            page.paragraph(
                'Means over the scenes; from five on with their interval from scene to scene, so from seed to seed.', note=True
            )
    if any(beacon.transmissions for result in results for beacon in result.beacons):
        page.heading('Transmissions')
        page.table(SCORE_COLUMNS, score_rows(results))
    published = published_rows(results) if comparable else []
    if published:
        page.heading("The last transmission beside the paper's figures (section IV, outdoor)")
        page.table(PUBLISHED_COLUMNS, published)
    page.heading('Texts')
    page.table(TEXT_COLUMNS, text_rows(results))
    points = _rate_points(groups)
    if len({point.bit_rate_bps for point in points}) > 1:
        page.figure(
            rate_figure(points),
            'Message accuracy (characters) and bit accuracy of every beacon at its bit rate; bars: 95 % intervals (Wilson).',
            'accuracy against bit rate',
        )
    judged_bins = _reliability(groups, frames)
    for group in progress(groups, 'report', len(groups)):
        view = view_recording(group, options[group[0].receiver])
        _recording(page, view, frame)
    if judged_bins:
        page.section('Is the confidence true?')
        errors = ', '.join(f'{name} {expected_calibration_error(bins):.4f}' for name, bins in judged_bins.items())
        page.figure(
            reliability_figure(judged_bins),
            'Share of right characters against the confidence that they were given with, both by their nines; the larger a'
            ' ring the more characters, hollow where none was wrong. On the dotted line a confidence is true; bars: 95 %'
            f' intervals. Mean distance from it: {errors}.',
            'reliability of the confidence',
        )
    page.section('How this was made')
    page.paragraph(
        'What is counted and how stands in <code>docs/evaluation.md</code>. No truth enters a decoder; intervals take errors'
        ' for independent (Wilson) or stretches of half a second (bootstrap).'
    )
    for receiver, one in options.items():
        page.folded(f'Parameters of {receiver}', parameters_table(_shown_parameters(one.parameters)))
    return page


def _shown_parameters(parameters: Parameters) -> dict[str, object]:
    defaults = asdict(Parameters())
    return {
        name: f'{value}   (default {defaults[name]})' if value != defaults[name] else value
        for name, value in asdict(parameters).items()
    }


def _tiles(results: Sequence[RecordingResult]) -> list[tuple[str, str, str]]:
    """Return the first receiver's numbers that matter most."""
    own = [result for result in results if result.receiver == results[0].receiver]
    scenes = [result.scene for result in own if result.scene is not None]
    beacons = [beacon for result in own for beacon in result.beacons]
    confirmed = sum(beacon.confirmed_at_ns is not None for beacon in beacons)
    if not scenes:
        characters = [one for beacon in beacons for one in beacon.characters]
        tiles = [(str(confirmed), 'confirmed', ''), (f'{len(characters):,}', 'characters decoded', '')]
        transmissions = [one for beacon in beacons for one in beacon.transmissions if one.found]
        if transmissions:
            return tiles + _accuracy_tiles(Count.of(transmissions))
        ok = sum(one.status is Status.OK for one in characters)
        return [*tiles, (_percent(ok / len(characters)) if characters else '–', 'with status ok', '')]
    true = [beacon for scene in scenes for beacon in scene.beacons]
    found = sum(bool(beacon.tracks) for beacon in true)
    false = sum(len(scene.false_confirmations) for scene in scenes)
    swaps = sum(scene.confirmed.swaps for scene in scenes)
    tiles = [
        (f'{found} of {len(true)}', 'beacons confirmed', 'good' if found == len(true) else 'bad'),
        (str(false), 'false confirmations', 'bad' if false else 'good'),
        *_accuracy_tiles(Count.of([one for beacon in true for one in beacon.transmissions])),
        (str(swaps), 'swaps of identity', 'bad' if swaps else 'good'),
    ]
    motas = [scene.confirmed.mota for scene in scenes if scene.confirmed.mota is not None]
    squares = [np.mean(beacon.position.error_px**2) * 2.0 for beacon in true if beacon.position is not None]
    if motas:
        tiles.append((f'{np.mean(motas):.3f}', 'MOTA of confirmed tracks', ''))
    if squares:
        tiles.append((f'{np.sqrt(np.mean(squares)):.2f} px', 'rms error', ''))
    return tiles


def _accuracy_tiles(count: Count) -> list[tuple[str, str, str]]:
    if not count.characters:
        return []
    right = max(0, count.characters - count.wrong)
    return [
        (_percent(count.message_accuracy), f'characters right: {right:,} of {count.characters:,}', ''),
        (_percent(count.bit_accuracy), 'bits right', ''),
    ]


def _percent(share: float) -> str:
    digits = 2 if 0.99 <= share < 1.0 else 1
    return f'{100.0 * share:.{digits}f} %'


def _rate_points(groups: Sequence[Sequence[RecordingResult]]) -> list[RatePoint]:
    points = []
    for result in (result for group in groups for result in group):
        if result.scene is not None:
            sent = [(beacon.bit_rate_bps, beacon.transmissions) for beacon in result.scene.beacons]
        else:
            sent = [(None, beacon.transmissions) for beacon in result.beacons]
        for bit_rate_bps, transmissions in sent:
            found = [one for one in transmissions if one.bit_rate_bps is not None]
            if found:
                count = Count.of(found)
                points.append(
                    RatePoint(
                        result.receiver,
                        bit_rate_bps or found[0].bit_rate_bps or 0.0,
                        count.message_accuracy,
                        count.bit_accuracy,
                        count.message_interval,
                        count.bit_interval,
                    )
                )
    return points


def _reliability(
    groups: Sequence[Sequence[RecordingResult]], frames: Mapping[str, CharacterFrame]
) -> dict[str, tuple[Bin, ...]]:
    """Return the bins of every receiver with enough judged characters."""
    claimed: dict[str, list[tuple[float, bool]]] = {}
    for result in (result for group in groups for result in group):
        own = claimed.setdefault(result.receiver, [])
        for beacon in result.scene.beacons if result.scene is not None else ():
            own += [(one.confidence, v == 1) for one, v in zip(beacon.characters, beacon.verdicts, strict=True) if v >= 0]
        for track in result.beacons if result.scene is None else ():
            found = _dues_of_found(track.transmissions, result, frames[result.receiver])
            verdicts = judged(track.characters, found)
            own += [(one.confidence, v == 1) for one, v in zip(track.characters, verdicts, strict=True) if v >= 0]
    return {
        receiver: reliability_bins(np.array([c for c, _ in own]), np.array([right for _, right in own], np.bool_))
        for receiver, own in claimed.items()
        if len(own) >= FEWEST_JUDGED
    }


def _dues_of_found(transmissions: Sequence[Transmission], result: RecordingResult, frame: CharacterFrame) -> list[Due]:
    return dues([one for one in transmissions if one.found], result.truth or '', frame)


def _recording(page: Page, view: RecordingView, frame: CharacterFrame) -> None:
    """Add what is drawn of one recording."""
    page.section(name_of(view.results[0]))
    if view.image is not None:
        image = view.image
        page.figure(
            image_figure(image),
            f'The index image at {image.t_ns / NS_PER_S:.3f} s (window {1e3 * image.window_s:g} ms); the receiver finds'
            f' {len(image.blobs) or "no"} blob{"s" * (len(image.blobs) != 1)} then (white rings). Coloured lines: confirmed'
            ' tracks over the whole recording, with their labels and where they are at this instant; grey: other tracks'
            + ('; broad pale lines: the true paths.' if any(path.true for path in image.paths) else '.'),
            'index image with blobs and paths',
        )
    errors, accuracies = _over_time(view, frame)
    if errors or accuracies:
        seen = ['how far confirmed tracks are from the true centre'] if errors else []
        seen += ['the share of right ones among the last characters that were sent, missing ones wrong'] if accuracies else []
        page.figure(over_time_figure(errors, accuracies), 'Over time: ' + '; '.join(seen) + '.', 'errors over time')
    for signal in view.signals:
        page.heading(f'{signal.name}: the received signal')
        why = _code(signal.stretch.why[0].upper() + signal.stretch.why[1:])
        page.figure(
            signal_figure(signal, frame),
            f"{why}, at {signal.stretch.bit_rate_bps:.1f} bit/s. From the top: the paper's high-pass filtered signal with its"
            ' high (red) and low level (blue); the events themselves; the binarised line; for the sequence receiver the'
            ' log-likelihood ratio of every bit; the bits and characters that were read, wrong bits red'
            + ('; what was sent.' if signal.sent else '.'),
            f'received signal of {signal.name}',
        )
    left = len(view.subjects) - len(view.signals)
    if left > 0 and len(view.subjects) > MOST_SIGNALS:
        page.paragraph(f'The signals of {left} more beacons are left out: those with most errors are shown.', note=True)
    for subject in view.subjects:
        for receiver, transmissions in subject.scores.items():
            if transmissions:
                title = f'{subject.name}: text as {receiver} read it'
                page.folded(title, _text_html(subject, transmissions))


def _code(text: str) -> str:
    parts = html.escape(text).split('`')
    return ''.join(f'<code>{part}</code>' if n % 2 else part for n, part in enumerate(parts))


def _over_time(view: RecordingView, frame: CharacterFrame) -> tuple[list[Series], list[Series]]:
    errors, accuracies = [], []
    for result in view.results:
        for beacon in result.scene.beacons if result.scene is not None else ():
            if beacon.position is not None:
                distance = np.hypot(*beacon.position.error_px.T)
                errors.append(Series(beacon.name, beacon.position.t_ns / NS_PER_S, distance, result.receiver))
    for subject in view.subjects:
        for receiver, transmissions in subject.scores.items():
            t_s, right = _right_over_time(transmissions, frame)
            if len(t_s):
                accuracies.append(Series(subject.name, t_s, rolling_share(right), receiver))
    return errors, accuracies


def _right_over_time(
    transmissions: Sequence[Transmission], frame: CharacterFrame
) -> tuple[np.ndarray[tuple[int], np.dtype[np.float64]], np.ndarray[tuple[int], np.dtype[np.bool_]]]:
    """Return when each character was due (s), and whether it was read right."""
    found = []
    for one in transmissions:
        if one.start_ns is None or one.bit_rate_bps is None:
            continue
        wrong = {error.k for error in one.errors}
        length_ns = frame.duration_ns(one.bit_rate_bps)
        found += [
            ((one.start_ns + k * length_ns) / NS_PER_S, k not in wrong) for k in range(one.first, one.first + one.characters)
        ]
    found.sort()
    return np.array([t for t, _ in found], np.float64), np.array([right for _, right in found], np.bool_)


def _text_html(subject: Subject, transmissions: Sequence[Transmission]) -> str:
    """Return what was read, what was wrong marked; a missing character is an empty box."""
    parts = []
    text = subject.text or ''
    for one in transmissions:
        if not one.found:
            parts.append('<p class=note>No sending of the text was found.</p>')
            continue
        errors = {error.k: error for error in one.errors}
        letters = []
        for k in range(one.first, one.first + one.characters):
            error = errors.get(k)
            if error is None:
                letters.append(_letter(ord(text[k])))
            else:
                read = '□' if error.received is None else _letter(error.received.code)
                said = 'nothing read' if error.received is None else f'read {chr(error.received.code)!r}'
                hint = f'sent {text[k]!r}, {said}'
                letters.append(f'<span class=w title="{html.escape(hint, quote=True)}">{read.rstrip()}</span>')
                letters += ['\n'] if text[k] == '\n' else []  # the lines stay those of the text
        inserted = f', {one.inserted} inserted' if one.inserted else ''
        begins = f'from {(one.start_ns or 0) / NS_PER_S:.3f} s' if one.first == 0 else f'from character {one.first + 1} on'
        parts.append(
            f'<p class=note>{begins}: {one.characters} characters, {len(one.errors)} wrong{inserted}</p>'
            f'<div class=text>{"".join(letters)}</div>'
        )
    return ''.join(parts)


def _letter(code: int) -> str:
    if code == 0x0A:
        return '<span class=feed>↵</span>\n'
    symbol = chr(code)
    return html.escape(symbol) if symbol.isprintable() else '·'
