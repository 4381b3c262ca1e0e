#!/usr/bin/env python3
"""Measure tracking on simulated scenes: speed, crossings, many beacons, occlusion, a shaken camera, and the errors' truth.

    python docs/tracking.py --write            # docs/tracking.md and its figure; some minutes
    python docs/tracking.py --full --write     # at least 1000 characters a point and 100 runs; over an hour
    python docs/tracking.py --only crossings --runs 100

::

    scene, seed ──► simulate ──► Receiver (tracker: motion, or nearest) ──► characters, tracks ──► against the truth

A character is right if one with its code begins within 0.3 of a character of where it was sent.  Every scene has its
seed, so that the same command gives the same numbers.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

from beacon_comm.core.candidates import BeaconState, ReceivedCharacter
from beacon_comm.core.detection import Detector
from beacon_comm.core.events import NS_PER_S, EventBatch
from beacon_comm.core.index_image import hop_length_ns
from beacon_comm.core.parameters import Parameters
from beacon_comm.core.receiver import Receiver
from beacon_comm.core.tracks import Track
from beacon_comm.evaluation.scoring import wilson_interval
from beacon_comm.simulation.description import make_description
from beacon_comm.simulation.scene import simulate
from beacon_comm.simulation.truth import BeaconTruth, SceneTruth

DOCS = Path(__file__).resolve().parent
SIZE = (640, 480)
BIT_RATE = 1000.0
BITS = 11
SLACK = 0.3
TEXTS = ("Shall I compare thee to a summer's day? ", 'And summers lease hath all too short a date: ')
SLOW, HOLD_S, RAMP_END_S = 80.0, 0.3, 0.6
BEGIN_S = 0.8
RADIUS_PX = 5.1
ERRORS_S = 1.3
TRACKERS = ('nearest', 'motion')
Simulated = tuple[Iterator[EventBatch], SceneTruth]


def parameters(**changes: Any) -> Parameters:
    """Return the defaults with the scenes' bit rate listed, but for the changes."""
    return Parameters(**{'bit_rates': (BIT_RATE,), **changes})


def scene(
    paths: list[dict[str, Any]], duration_s: float, seed: int, starts_s: Sequence[float] = (0.05, 0.05), **content: Any
) -> Simulated:
    """Return a scene of one beacon a path."""
    beacons = [
        {'bit_rate_bps': BIT_RATE, 'text': TEXTS[k % 2], 'path': path, 'start_s': starts_s[k % len(starts_s)]}
        for k, path in enumerate(paths)
    ]
    return simulate(make_description({'duration_s': duration_s, 'beacons': beacons, **content}), seed=seed)


def moving(kind: str, speed: float, seed: int) -> dict[str, Any]:
    """Return a path that is slow until it is locked and then ramped up."""
    random = np.random.default_rng(seed)
    place = [float(value) for value in random.uniform(100.0, 300.0, 2)]
    if kind == 'still' or speed == 0.0:
        return {'kind': 'still', 'at_px': place}
    ramp = {'speed_px_per_s': [min(SLOW, speed), speed], 'ramp_s': [HOLD_S, RAMP_END_S]}
    if kind == 'circle':
        return {'kind': 'circle', 'centre_px': [320, 240], 'radius_px': 200, 'from_deg': float(random.uniform(0, 360)), **ramp}
    return {'kind': 'line', 'from_px': place, 'direction_deg': float(random.uniform(15, 40)), **ramp}


def turns_s(truth: BeaconTruth, duration_s: float) -> np.ndarray:
    """Return when a beacon turned back at a border (s)."""
    t_ns = np.arange(0, round(duration_s * NS_PER_S), 200_000)
    found = []
    for path in truth.centre(t_ns):
        step = np.diff(path)
        found.append(t_ns[1:-1][(step[1:] * step[:-1] < 0) & (np.abs(step[1:]) > 1e-3)])
    return np.sort(np.concatenate(found)) / NS_PER_S


@dataclass(slots=True)
class Score:
    """Characters right, of how many, and by how many labels."""

    right: int = 0
    sent: int = 0
    labels: int = 0

    def add(self, other: Score) -> None:
        self.right, self.sent, self.labels = self.right + other.right, self.sent + other.sent, max(self.labels, other.labels)

    def text(self) -> str:
        share = self.right / max(self.sent, 1)
        interval = wilson_interval(share, self.sent)
        return f'{share:.1%} of {self.sent} ({interval.low:.1%} – {interval.high:.1%})'


def score(
    characters: list[ReceivedCharacter], truth: BeaconTruth, begin_s: float, end_s: float, left_out_s: np.ndarray | None = None
) -> Score:
    """Score the characters sent within a time, but for those in the 10 ms from each of ``left_out_s`` on (s)."""
    period_ns = BITS * NS_PER_S / BIT_RATE
    received = sorted((c.character.t_ns, c.character.code, c.track_id) for c in characters)
    times = np.array([entry[0] for entry in received])
    result, labels = Score(), set()
    out_ns = np.empty(0) if left_out_s is None else left_out_s * NS_PER_S
    for t_ns, code in zip(truth.characters_ns, truth.codes, strict=True):
        if t_ns < begin_s * NS_PER_S or t_ns + period_ns > end_s * NS_PER_S:
            continue
        if np.any((t_ns < out_ns + 10_000_000) & (t_ns + period_ns > out_ns)):
            continue
        result.sent += 1
        near = np.flatnonzero(np.abs(times - t_ns) < SLACK * period_ns)
        found = [received[k] for k in near if received[k][1] == code]
        if found:
            result.right += 1
            labels.add(found[0][2])
    result.labels = len(labels)
    return result


def receive(simulated: Simulated, **changes: Any) -> tuple[Receiver, list[ReceivedCharacter], SceneTruth]:
    """Run the receiver on a scene."""
    batches, truth = simulated
    receiver = Receiver(parameters(**changes), (truth.width, truth.height))
    characters: list[ReceivedCharacter] = []
    for batch in batches:
        characters += receiver.push(batch).characters
    characters += receiver.flush().characters
    return receiver, characters, truth


def follow(simulated: Simulated, at_hop: Callable[[Detector, SceneTruth, int], None], **changes: Any) -> None:
    """Run detection alone on a scene."""
    batches, truth = simulated
    p = parameters(receiver='threshold', **changes)
    detector, hop_ns = Detector(p, (truth.width, truth.height)), hop_length_ns(p)
    for batch in batches:
        detector.route(batch)
        t_hop_ns = batch.t_end_ns // hop_ns * hop_ns
        detector.hop(t_hop_ns)
        at_hop(detector, truth, t_hop_ns)


def nearest(tracks: Iterable[Track], truth: BeaconTruth, t_ns: int) -> tuple[Track | None, float]:
    """Return the track nearest to a beacon, and how far it is (px)."""
    x, y = (float(value) for value in truth.centre(t_ns))
    best, least = None, math.inf
    for track in tracks:
        distance = math.hypot(*np.subtract(track.light_at(t_ns), (x, y)))
        if distance < least and not track.quiet:
            best, least = track, distance
    return best, least


def speeds(full: bool) -> dict[str, Any]:
    """Characters right against image speed."""
    found: dict[str, Any] = {}
    characters = 1000 if full else 100
    points = (100, 500, 1000, 2000, 3000, 5000, 8000, 11000) if full else (500, 2000, 5000, 11000)
    for kind in ('line', 'circle'):
        for speed in tqdm(points, desc=kind):
            for tracker in TRACKERS:
                total, seed = Score(), 0
                while total.sent < characters and seed < 60:
                    duration_s = 2.0 if speed <= 5000 else 3.0
                    receiver, received, truth = receive(scene([moving(kind, speed, seed)], duration_s, seed), tracker=tracker)
                    (beacon,) = truth.beacons
                    out_s = turns_s(beacon, duration_s) if kind == 'line' else None
                    total.add(score(received, beacon, BEGIN_S, duration_s - 0.1, out_s))
                    seed += 1
                    if tracker == 'nearest' and not full:
                        break
                found[f'{kind} {speed} {tracker}'] = [total.right, total.sent, total.labels]
    return found


def crossing(seed: int, near: bool, speed: float = 500.0) -> tuple[Simulated, float, float]:
    """Return a scene of two beacons that pass one another, when they begin to, and its duration (s).

    They come at ``speed`` relative to one another from any direction, shared between them in any way, past one another by
    0 to 3 radii; ``near``: they stood 3 radii apart before, else 20.  Each begins to send at a time of its own, as beacons that
    know nothing of one another do.
    """
    random = np.random.default_rng(seed)
    angle, share = random.uniform(0, 2 * math.pi), random.uniform(0.2, 0.8)
    along, across = np.array([math.cos(angle), math.sin(angle)]), np.array([-math.sin(angle), math.cos(angle)])
    apart = (3.0 if near else 20.0) * RADIUS_PX
    past = random.uniform(0.0, (2.0 if near else 3.0) * RADIUS_PX)
    length = math.sqrt(apart**2 - past**2)
    hold_s, moving_s = 0.35, max(2.0 * length / speed, 0.12)
    paths = []
    for sign, part in ((1.0, share), (-1.0, 1.0 - share)):
        begin = np.array([320.0, 240.0]) + sign * (across * past / 2 - along * length * part)
        end = begin + sign * along * speed * part * moving_s
        points = [[0.0, *begin], [hold_s, *begin], [hold_s + moving_s, *end], [hold_s + moving_s + 0.15, *end]]
        paths.append({'kind': 'waypoints', 'points': [[float(value) for value in point] for point in points]})
    duration_s = hold_s + moving_s + 0.12
    starts_s = [float(start_s) for start_s in random.uniform(0.0, BITS / BIT_RATE, 2)]
    return scene(paths, duration_s, seed, starts_s), hold_s, duration_s


def labels_of(receiver: Receiver, truth: SceneTruth, t_ns: int) -> list[int | None]:
    """Return the label of each beacon, None where no track that is read, or better confirmed, is within a radius."""
    found: list[int | None] = []
    for beacon in truth.beacons:
        x, y = (float(value) for value in beacon.centre(t_ns))
        here = [
            (one.state is not BeaconState.CONFIRMED, math.hypot(one.x_px - x, one.y_px - y), one.track_id)
            for one in receiver.beacons(t_ns)
            if one.bit_rate_bps is not None and not one.quiet and math.hypot(one.x_px - x, one.y_px - y) < RADIUS_PX
        ]
        found.append(min(here)[2] if here else None)
    return found


def cross(seed: int, near: bool, tracker: str) -> str:
    """Return how a crossing ended: kept, swapped, or lost (a label that is gone)."""
    (batches, truth), hold_s, _ = crossing(seed, near)
    receiver = Receiver(parameters(tracker=tracker), (truth.width, truth.height))
    before: list[int | None] = []
    after = before
    for batch in batches:
        receiver.push(batch)
        after = labels_of(receiver, truth, batch.t_end_ns)
        if not before and batch.t_end_ns >= (hold_s - 0.02) * NS_PER_S:
            before = after
    return 'kept' if before == after and None not in before else 'swapped' if before == after[::-1] else 'lost'


def crossings(full: bool, runs: int | None = None) -> dict[str, Any]:
    """Labels kept where two beacons pass one another."""
    found: dict[str, Any] = {}
    for tracker in TRACKERS:
        for near in (False, True):
            count = runs or ((1000 if near else 100) if full else 20)
            seeds = range(count if tracker == 'motion' else max(min(count, 100) // 5, 5))
            ends = [cross(seed, near, tracker) for seed in tqdm(seeds, desc=f'crossings, {tracker}')]
            counts = {end: ends.count(end) for end in ('kept', 'swapped', 'lost')}
            found[f'{"3 radii" if near else "20 radii"} {tracker}'] = counts
    return found


def many(full: bool) -> dict[str, Any]:
    """Beacons at once, with a camera that is shaken a little."""
    found: dict[str, Any] = {}
    for count in (8, 32, 64) if full else (8, 32):
        duration_s = 2.5
        description = {
            'duration_s': duration_s,
            'beacons': [{'bit_rate_bps': BIT_RATE, 'text': TEXTS[0], 'count': count}],
            'shake': {'amplitude_px': 5, 'frequency_hz': 4},
        }
        for tracker in TRACKERS if count == 32 else ('motion',):
            receiver, received, truth = receive(simulate(make_description(description), seed=count), tracker=tracker)
            scores = [score(received, beacon, 1.2, duration_s - 0.1) for beacon in truth.beacons]
            shares = sorted(one.right / one.sent for one in scores)
            found[f'{count} {tracker}'] = {
                'least': shares[0], 'mean': float(np.mean(shares)), 'at least 99 %': sum(share >= 0.99 for share in shares),
                'confirmed': len(receiver.confirmed), 'sent each': scores[0].sent,
            }  # fmt: skip
    return found


def hidden(full: bool) -> dict[str, Any]:
    """A beacon that is hidden for 100 ms and 20 ms, at rest and moving: its label, and characters until one is right."""
    found: dict[str, Any] = {}
    for length_s in (0.1, 0.02):
        for speed in (0.0, 500.0):
            kept, waits = 0, []
            seeds = range(20 if full else 4)
            for seed in tqdm(seeds, desc=f'hidden for {length_s * 1e3:.0f} ms'):
                begin_s, duration_s = 1.2, 2.0
                place = {'from_px': [60, 60 + 10 * seed]} if speed else {}  # it turns back at no border while it is hidden
                beacon = {
                    'bit_rate_bps': BIT_RATE, 'text': TEXTS[0], 'path': {**moving('line', speed, seed), **place},
                    'occluded_s': [[begin_s, begin_s + length_s]],
                }  # fmt: skip
                content = make_description({'duration_s': duration_s, 'beacons': [beacon]})
                receiver, received, truth = receive(simulate(content, seed=seed))
                one = truth.beacons[0]
                before = {c.track_id for c in received if c.character.t_ns < begin_s * NS_PER_S}
                after = [c for c in received if c.character.t_ns > (begin_s + length_s) * NS_PER_S]
                kept += len(before) == 1 and {c.track_id for c in after} == before
                whole = one.characters_ns[one.characters_ns >= (begin_s + length_s) * NS_PER_S]
                for k in range(len(whole) - 2):
                    run = score(after, one, whole[k] / NS_PER_S, (whole[k] + 3.5 * BITS * NS_PER_S / BIT_RATE) / NS_PER_S)
                    if run.right == run.sent == 3:
                        waits.append(k)
                        break
            found[f'{length_s * 1e3:.0f} ms, {speed:.0f} px/s'] = {
                'runs': len(seeds), 'same label': kept, 're-locked': len(waits),
                'characters missed, most': max(waits, default=-1),
            }  # fmt: skip
    return found


def confirmed(full: bool) -> dict[str, Any]:
    """How long it takes from the beginning of the first character in sight until a beacon is confirmed."""
    found: dict[str, Any] = {}
    for name, changes in (('rate listed', {}), ('blind', {'rate_search': 'blind'})):
        waits, never = [], 0
        for seed in tqdm(range(20 if full else 5), desc=f'confirmed, {name}'):
            path, start_s = moving('still', 0.0, seed), float(np.random.default_rng(seed).uniform(0.05, 0.15))
            batches, truth = scene([path], 0.6, seed, (start_s,))
            receiver = Receiver(parameters(**changes), (truth.width, truth.height))
            for batch in batches:
                receiver.push(batch)
                if receiver.confirmed:
                    waits.append(batch.t_end_ns - int(truth.beacons[0].characters_ns[0]))
                    break
            else:
                never += 1
        times_s = np.array(waits) / NS_PER_S
        found[name] = {
            'runs': len(waits) + never, 'never': never,
            'median (s)': float(np.median(times_s)), 'longest (s)': float(times_s.max()),
        }  # fmt: skip
    return found


def shaken(full: bool) -> dict[str, Any]:
    """A camera shaken over a texture, at so many background events a second."""
    found: dict[str, Any] = {}
    for mev in (2, 10, 20) if full else (2, 10):
        for threshold in (0.6, 2.0):
            duration_s = 1.8
            content = {
                'duration_s': duration_s,
                'beacons': [{'bit_rate_bps': BIT_RATE, 'text': TEXTS[0], 'path': {'kind': 'still', 'at_px': [300, 200]}}],
                'shake': {'amplitude_px': 10, 'frequency_hz': 4},
                'background': {'texture': {'events_per_s': mev * 1e6}},
                'sensor': {'width': 1280, 'height': 720},
            }
            receiver, received, truth = receive(simulate(make_description(content), seed=mev), index_threshold=threshold)
            one = score(received, truth.beacons[0], 0.8, duration_s - 0.1)
            found[f'{mev} Mev/s, index_threshold {threshold:g}'] = [one.right, one.sent, len(receiver.beacons())]
    return found


def looked_at(simulated: Simulated, kind: str) -> np.ndarray:
    """Return errors (px), normalised error squared and trace of the covariance (px²) of the track of one beacon, ``(n, 4)``."""
    rows: list[list[float]] = []
    (beacon,) = simulated[1].beacons
    out_s = turns_s(beacon, ERRORS_S) if kind == 'line' else np.empty(0)

    def look(detector: Detector, truth: SceneTruth, t_hop_ns: int) -> None:
        for t_ns in (t_hop_ns, t_hop_ns + 4_000_000):
            t_s = t_ns / NS_PER_S
            if not BEGIN_S <= t_s < ERRORS_S or np.any((t_s > out_s) & (t_s < out_s + 0.02)):
                continue
            track, distance = nearest(detector.tracks.values(), beacon, t_ns)
            if track is None or distance > 5 * RADIUS_PX:
                rows.append([math.nan] * 4)
                continue
            error = np.subtract(track.light_at(t_ns), [float(value) for value in beacon.centre(t_ns)])
            covariance = np.array(track.covariance_at(t_ns))
            rows.append([*error, float(error @ np.linalg.solve(covariance, error)), float(np.trace(covariance))])

    follow(simulated, look)
    return np.array(rows)


def errors(full: bool) -> dict[str, Any]:
    """Pixel error and the normalised error squared, on the hop grid and between."""
    found: dict[str, Any] = {}
    for name, kind, speed in (
        ('still', 'still', 0.0), ('line, 300 px/s', 'line', 300.0), ('line, 1000 px/s', 'line', 1000.0),
        ('line, 2000 px/s', 'line', 2000.0), ('circle, 1000 px/s', 'circle', 1000.0),
    ):  # fmt: skip
        seeds = tqdm(range(40 if full else 8), desc=name)
        table = np.concatenate([looked_at(scene([moving(kind, speed, seed)], ERRORS_S, 1000 + seed), kind) for seed in seeds])
        lost = float(np.isnan(table[:, 0]).mean())
        table = table[~np.isnan(table[:, 0])]
        found[name] = {
            'rms error (px)': float(np.sqrt((table[:, :2] ** 2).sum(axis=1).mean())),
            'expected (px)': float(np.sqrt(table[:, 3].mean())),
            'NEES over its expectation': float(table[:, 2].mean() / 2.0),
            'not followed': lost, 'looks': len(table),
        }  # fmt: skip
    return found


PARTS: dict[str, Callable[[bool], dict[str, Any]]] = {
    'speeds': speeds, 'crossings': crossings, 'many': many, 'hidden': hidden, 'confirmed': confirmed, 'shaken': shaken,
    'errors': errors,
}  # fmt: skip


def table(columns: list[str], rows: list[list[Any]]) -> str:
    """Return a Markdown table."""
    lines = [columns, ['---'] * len(columns), *rows]
    return '\n'.join('| ' + ' | '.join(str(entry) for entry in line) + ' |' for line in lines) + '\n'


def page(found: dict[str, Any]) -> str:
    """Return ``docs/tracking.md``."""
    parts, commands = [HEAD], found.get('commands', {})
    if all(name in found for name in PARTS):
        parts += ['## What was asked for\n', reached(found), LIMITS]
    if 'speeds' in found:
        keys = dict.fromkeys(key.rsplit(' ', 1)[0] for key in found['speeds'])
        rows = [[key, *(Score(*found['speeds'][f'{key} {tracker}']).text() for tracker in TRACKERS)] for key in keys]
        parts.append(f'## Characters right against image speed\n\n`{commands["speeds"]}`\n\n{SPEEDS}')
        parts.append(table(['path, px/s', *(f'`tracker: {tracker}`' for tracker in TRACKERS)], rows))
        parts.append('![Characters right against image speed](figures/tracking.png)\n')
    for name, title, text in SECTIONS:
        if name not in found:
            continue
        first = next(iter(found[name].values()))
        columns = list(first) if isinstance(first, dict) else ['right', 'sent', 'tracks at the end']
        values = {key: value.values() if isinstance(value, dict) else value for key, value in found[name].items()}
        rows = [[key, *(_shown(entry) for entry in entries)] for key, entries in values.items()]
        parts.append(f'## {title}\n\n`{commands[name]}`\n\n{text}')
        parts.append(table(['', *columns], rows))
    return '\n'.join(parts)


def reached(found: dict[str, Any]) -> str:
    """Return the table of what was asked for, and what the parts say of it."""

    def fastest(kind: str) -> str:
        points = {k: v for k, v in found['speeds'].items() if k.startswith(kind) and 'motion' in k}
        shares = {int(k.split()[1]): v[0] / max(v[1], 1) for k, v in points.items()}
        below = [speed for speed, share in sorted(shares.items()) if share < 0.99]
        best = max((speed for speed in shares if not below or speed < below[0]), default=0)
        return f'{kind} {best:,} px/s'

    crossed = found['crossings']['3 radii motion']
    at_once = [int(key.split()[0]) for key, value in found['many'].items() if 'motion' in key and value['least'] >= 0.99]
    waits = found['confirmed']
    errors = {name: value['rms error (px)'] for name, value in found['errors'].items()}
    consistency = [value['NEES over its expectation'] for value in found['errors'].values()]
    rows = [
        ['characters ≥ 99 % right up to', '2,000 px/s', '5,000 px/s', f'{fastest("line")}, {fastest("circle")}'],
        ['beacons at once, each ≥ 99 %', '32', '64', str(max(at_once))],
        ['crossings from 3 radii, labels kept', '100 of 100', '1,000 of 1,000',
         f'{crossed["kept"]} of {sum(crossed.values())}'],
        ['hidden for 100 ms (aim: 20 ms): characters missed at most', '3', '3',
         ', '.join(f'{value["characters missed, most"]} ({key})' for key, value in found['hidden'].items())],
        ['shaken texture, right of sent', '≥ 99 % at 10 Mev/s', '20 Mev/s',
         '; '.join(f'{key}: {value[0]} of {value[1]}' for key, value in found['shaken'].items() if not key.startswith('2 '))],
        ['rms error at rest and at 1,000 px/s', '0.2 and 0.5 px', '0.1 and 0.3 px',
         ', '.join(f'{name}: {value:.2g} px' for name, value in errors.items() if 'still' in name or '1000' in name)],
        ['NEES over its expectation', '0.9 to 1.1', '', f'{min(consistency):.3g} to {max(consistency):.3g}'],
        ['first character to confirmed', '0.2 s listed, 0.3 s blind', '',
         ', '.join(f'{name}: {value["longest (s)"]:.3g} s at most' for name, value in waits.items())],
    ]  # fmt: skip
    return table(['', 'asked for', 'aim', 'measured'], rows)


def _shown(value: Any) -> str:
    return f'{value:.3g}' if isinstance(value, float) else str(value)


HEAD = """# Tracking

Written by `python docs/tracking.py --write` (each part by the command below its title; all take over an hour with `--full`)
on simulated scenes ([docs/simulator.md](simulator.md)): 640 × 480, beacons of 1 kbps, default parameters with the rate listed.
`motion` follows tracks by their own events ([following.py](../beacon_comm/core/following.py),
[motion.py](../beacon_comm/core/motion.py), [motion_tracks.py](../beacon_comm/core/motion_tracks.py)) and is the default;
`nearest` is the paper's.
"""
LIMITS = """Two beacons, or a beacon and a lamp, whose middles are nearer than some 2.7 radii are one blob and one track, and
nothing is read while they are.  A light that moves before or behind a beacon may take its track along; if the beacon is
to be seen again within 0.1 s where it would be, it gets its label back, else a new one.
"""
SPEEDS = """Slow until locked, then ramped up to the speed; a straight line that turns back at the borders, scored from 10 ms
after each turn, and a circle of 200 px radius. In parentheses: 95 % intervals (Wilson).
"""
SECTIONS = (
    ('crossings', 'Two beacons that pass one another',
     'At 500 px/s relative to one another, past one another by 0 to 3 radii, from 20 radii apart, or after standing 3 radii\n'
     'apart; the whole receiver, which tells them by their signals when they are apart again\n'
     '([meetings.py](../beacon_comm/core/meetings.py)).  Each began to send at a time of its own: beacons whose bits lie\n'
     'alike cannot be told so.  *kept*: the labels 20 ms before are those at the end, 120 ms after the last motion.\n'),
    ('many', 'Beacons at once', 'On a grid, the camera shaken by 5 px; shares of characters right.\n'),
    ('hidden', 'Hidden for a moment', 'Characters missed: sent after it is back, before three in a row are right.\n'),
    ('confirmed', 'Until a beacon is confirmed',
     'From the start of the first character on, a beacon at rest that begins to send at a time of its own. It takes\n'
     '15 characters (165 ms), the decision delay of 22 bits, and the rest of a bit and of a packet; blind the lock, at the\n'
     '19th character or so, comes last, and what was said before is read at once.\n'),
    ('shaken', 'A camera shaken over texture', 'On 1280 × 720; `index_threshold` at its default and raised.\n'),
    ('errors', 'Pixel error and covariance',
     'In two dimensions, at hops and 4 ms behind them; from 0.8 s on, but for 20 ms from each turn at a border on.\n'),
)  # fmt: skip


def draw(found: dict[str, Any], path: Path) -> None:
    """Draw characters right against speed."""
    import matplotlib

    matplotlib.use('Agg')
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(1, 2, figsize=(10, 3.6), sharey=True)
    for axis, kind in zip(axes, ('line', 'circle'), strict=True):
        for tracker, colour in zip(TRACKERS, ('tab:orange', 'tab:blue'), strict=True):
            points = [(int(k.split()[1]), v) for k, v in found['speeds'].items() if k.startswith(kind) and k.endswith(tracker)]
            speed = [point[0] for point in points]
            share = np.array([v[0] / max(v[1], 1) for _, v in points])
            bounds = [wilson_interval(one, v[1]) for one, (_, v) in zip(share, points, strict=True)]
            below = np.maximum(share - [one.low for one in bounds], 0)
            above = np.maximum([one.high for one in bounds] - share, 0)
            bars = 100 * np.stack((below, above))
            axis.errorbar(speed, 100 * share, bars, marker='o', capsize=3, color=colour, label=tracker)
        axis.axhline(99, color='grey', linewidth=0.8, linestyle=':')
        axis.set(xscale='log', xlabel='image speed (px/s)', title=kind)
        axis.grid(alpha=0.3)
    axes[0].set_ylabel('characters right (%)')
    axes[0].legend(title='tracker')
    figure.tight_layout()
    figure.savefig(path, dpi=110)


def command_of(name: str, options: argparse.Namespace) -> str:
    """Return the command that measures a part in the same way."""
    command = f'python docs/tracking.py --only {name}' + ' --full' * options.full
    return command + (f' --runs {options.runs}' if name == 'crossings' and options.runs else '') + ' --write'


def main() -> int:
    """Measure, print, and write the page."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else '')
    parser.add_argument('--full', action='store_true', help='at least 1000 characters a point and 100 runs')
    parser.add_argument('--only', choices=list(PARTS), action='append', help='only this part (may be given again)')
    parser.add_argument('--runs', type=int, help='crossings: so many')
    parser.add_argument('--write', action='store_true', help='write tracking.md, .json, the figure; other parts stay')
    options = parser.parse_args()
    stored = DOCS / 'tracking.json'
    found: dict[str, Any] = json.loads(stored.read_text()) if options.write and stored.exists() else {}
    for name in options.only or PARTS:
        found[name] = crossings(options.full, options.runs) if name == 'crossings' else PARTS[name](options.full)
        print(json.dumps({name: found[name]}, indent=1), flush=True)
        if options.write:
            found.setdefault('commands', {})[name] = command_of(name, options)
            stored.write_text(json.dumps(found, indent=1) + '\n')
    if options.write:
        (DOCS / 'tracking.md').write_text(page(found))
        if 'speeds' in found:
            draw(found, DOCS / 'figures' / 'tracking.png')
    return 0


if __name__ == '__main__':
    sys.exit(main())
