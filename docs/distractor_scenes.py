#!/usr/bin/env python3
"""Show the whole receiver an hour of scenes without a beacon and count what it confirms; print docs/distractor_scenes.md.

    python docs/distractor_scenes.py                                    # a minute or two
    python docs/distractor_scenes.py --full --output docs/distractor_scenes.md   # an hour of scenes

::

    family, number ─► lamps, PWM LEDs, screens, texture, a real bag ─► simulate ─► Receiver ─► tracks, characters, confirmed?

:mod:`false_alarms` draws single blobs; here the images are whole, so that blobs merge, move, overlap and take turns at the
candidate slots.  Seed, family and number determine a scene; those with a confirmed track are named at the end.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import astuple, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import chi2
from tqdm import tqdm

from beacon_comm.core.character import Status
from beacon_comm.core.detection import Detector
from beacon_comm.core.parameters import Parameters
from beacon_comm.core.receiver import Receiver
from beacon_comm.recordings.folder import recordings_folder
from beacon_comm.recordings.sources import Background
from beacon_comm.simulation.description import make_description
from beacon_comm.simulation.scene import simulate

Random = np.random.Generator
Content = dict[str, Any]

WIDTH, HEIGHT = 320, 240
SENSOR = {'width': WIDTH, 'height': HEIGHT, 'psf_px': 0.9}  # a sharp lens: fewer pixels to simulate
BAG_SENSOR = {**SENSOR, 'width': 640, 'height': 480}
SCENE_S = 10.0
BAG = 'evt3_static'
FULL_COUNT, DEFAULT_COUNT = 60, 1
CONTROL = 'control: a beacon among everything'
MARGIN_PX = 20.0


def logarithmic(random: Random, low: float, high: float) -> float:
    """Draw a number whose logarithm is uniform."""
    return float(np.exp(random.uniform(np.log(low), np.log(high))))


def somewhere(random: Random) -> list[float]:
    """Draw a place on the sensor (px)."""
    return [float(random.uniform(MARGIN_PX, size - MARGIN_PX)) for size in (WIDTH, HEIGHT)]


def path(random: Random) -> Content:
    """Draw a path: standing, or on a line that turns back at the borders."""
    if random.random() < 0.6:
        return {'kind': 'still', 'at_px': somewhere(random)}
    return {'kind': 'line', 'from_px': somewhere(random), 'speed_px_per_s': logarithmic(random, 10.0, 1000.0)}


def lamp(random: Random) -> Content:
    """A lamp on the mains: 100 or 120 Hz, 300 ppm off, near or far."""
    return {
        'kind': 'lamp', 'path': path(random), 'frequency_hz': float(random.choice([100.0, 120.0]) * random.normal(1.0, 3e-4)),
        'depth': float(random.uniform(0.1, 1.0)), 'contrast': logarithmic(random, 1.0, 30.0),
        'radius_px': logarithmic(random, 0.5, 4.0),
    }  # fmt: skip


def pwm(random: Random) -> Content:
    """An LED dimmed by its pulse width, 50 Hz to 5 kHz."""
    return {
        'kind': 'pwm', 'path': path(random), 'frequency_hz': logarithmic(random, 50.0, 5000.0),
        'duty': float(random.uniform(0.05, 0.95)), 'contrast': logarithmic(random, 1.0, 30.0),
        'radius_px': logarithmic(random, 0.5, 3.0), 'edge_us': logarithmic(random, 1.0, 300.0),
    }  # fmt: skip


def screen(random: Random) -> Content:
    """A screen that is refreshed 50 to 144 times a second."""
    return {
        'kind': 'screen', 'path': {'kind': 'still', 'at_px': somewhere(random)},
        'refresh_hz': float(random.choice([50.0, 59.94, 60.0, 75.0, 120.0, 144.0])),
        'width_px': float(random.uniform(8.0, 40.0)), 'height_px': float(random.uniform(5.0, 25.0)),
        'fade_us': logarithmic(random, 300.0, 8000.0), 'contrast': logarithmic(random, 1.0, 20.0),
    }  # fmt: skip


def some(random: Random, draw: Callable[[Random], Content], most: int) -> list[Content]:
    """Draw one to so many."""
    return [draw(random) for _ in range(random.integers(1, most + 1))]


def shake(random: Random) -> Content:
    """Draw how the camera is shaken."""
    return {'amplitude_px': logarithmic(random, 1.0, 20.0), 'frequency_hz': logarithmic(random, 0.5, 8.0)}


def texture(random: Random) -> Content:
    """A texture of 20,000 to 300,000 events a second, the camera shaken."""
    return {'background': {'texture': {'events_per_s': logarithmic(random, 2e4, 3e5)}}, 'shake': shake(random)}


def everything(random: Random) -> Content:
    """A lamp, an LED and a screen before a texture, the camera shaken."""
    distractors = [lamp(random), pwm(random), screen(random)]
    return {'distractors': distractors, **texture(random)}


FAMILIES: dict[str, Callable[[Random], Content]] = {
    'lamps': lambda random: {'distractors': some(random, lamp, 2)},
    'PWM LEDs': lambda random: {'distractors': some(random, pwm, 2)},
    'screens': lambda random: {'distractors': [screen(random)]},
    'shaken texture': texture,
    'recorded room with lamps, and LEDs': lambda random: {
        'distractors': [pwm(random)], 'background': {'bag': BAG},
        'sensor': BAG_SENSOR,
    },
    'everything': everything,
}  # fmt: skip


def control(random: Random) -> Content:
    """A beacon among everything: what is confirmed of it shows that the test can fail."""
    beacon = {'text': 'sonnet18', 'bit_rate_bps': float(random.choice(Parameters().bit_rates)), 'path': path(random)}
    return {**everything(random), 'beacons': [beacon]}


@dataclass(slots=True)
class Count:
    """What was counted in some scenes.

    Attributes:
        scenes, seconds: how many, and their time.
        events: million events.
        tracks: tracks that began.
        read: labels that gave a character.
        characters, ok: how many, and those that were ok.
        confirmed: labels that were ever confirmed.
        named: numbers of the scenes that had one.
    """

    scenes: int = 0
    seconds: float = 0.0
    events: float = 0.0
    tracks: int = 0
    read: int = 0
    characters: int = 0
    ok: int = 0
    confirmed: int = 0
    named: tuple[int, ...] = ()

    def __add__(self, other: Count) -> Count:
        return Count(*(a + b for a, b in zip(astuple(self), astuple(other), strict=True)))


def families(folder: Path) -> dict[str, Callable[[Random], Content]]:
    """Return the families of scenes by name; those with the real bag only if it is there."""
    found = {**FAMILIES, CONTROL: control}
    return found if (folder / BAG).is_dir() else {name: draw for name, draw in found.items() if 'recorded' not in name}


def watch(name: str, number: int, seed: int, seconds: float, folder: Path) -> Count:
    """Show one scene to a receiver with the default parameters."""
    random = np.random.default_rng([seed, *name.encode(), number])
    content = families(folder)[name](random)
    bag = content.get('background', {}).get('bag')
    batches, truth = simulate(
        make_description({'duration_s': seconds, 'sensor': SENSOR, **content}),
        int(random.integers(2**32)),
        None if bag is None else Background(folder / bag).batches(),
    )
    size, parameters = (truth.width, truth.height), Parameters()
    detector = Detector(parameters, size)
    receiver = Receiver(parameters, size, detection=detector)
    read: set[int] = set()
    confirmed: set[int] = set()
    count = Count(scenes=1, seconds=seconds)
    for batch in batches:
        count.events += len(batch) / 1e6
        characters = receiver.push(batch).characters
        read.update(one.track_id for one in characters)
        count.characters += len(characters)
        count.ok += sum(one.character.status == Status.OK for one in characters)
        confirmed.update(receiver.confirmed)
    count.tracks, count.read, count.confirmed = detector.stats.new_tracks, len(read), len(confirmed)
    count.named = (number,) if confirmed else ()
    return count


def text_of(found: dict[str, Count], command: str) -> str:
    """Return the page."""
    shown = {name: count for name, count in found.items() if name != CONTROL}
    total = sum(shown.values(), Count())
    low = chi2.ppf(0.025, 2 * total.confirmed) / 2 if total.confirmed else 0.0
    high = chi2.ppf(0.975, 2 * total.confirmed + 2) / 2
    hours = total.seconds / 3600.0
    rows = [
        f'| {name} | {c.scenes} | {c.seconds / 60:.3g} | {c.events / max(c.seconds, 1.0):.2f} | {c.tracks} | {c.read}'
        f' | {c.characters} | {c.ok} | {c.confirmed} |'
        for name, c in {**shown, '**all**': total, f'*{CONTROL}*': found[CONTROL]}.items()
    ]
    named = [f'{name}: {", ".join(map(str, c.named))}' for name, c in shown.items() if c.named]
    return f"""# Scenes without a beacon

What the whole receiver makes of images in which nothing is a beacon, with the default parameters (`rate_search: both`):
lamps on the mains, LEDs dimmed by pulse width, screens, a texture before which the camera is shaken, a recorded room with its
lamps (640 × 480), and all of these at once; simulated ([docs/simulator.md](simulator.md)), {WIDTH} × {HEIGHT}, through a sharp
lens. Everything about a scene is drawn anew for each: places, paths to 1,000 px/s, frequencies, duty,
brightness, size. [docs/false_alarms_sequence.md](false_alarms_sequence.md) counts single blobs.

```
{command}
```

| scenes of | scenes | minutes | Mev/s | tracks | labels that gave characters | characters | ok | labels confirmed |
|---|---|---|---|---|---|---|---|---|
{chr(10).join(rows)}

A label that gave characters was read as if it sent; only a confirmed one is called a beacon. In {hours:.2f} h of scenes
without one, {total.confirmed} were: {low / hours:.2g} to {high / hours:.2g} an hour (95 %, Poisson).
The control's beacon leaves the sensor and comes back, and passes before lamps: it may get several labels in a scene.
{'Confirmed in scenes of ' + '; '.join(named) + '.' if named else ''}
""".rstrip() + '\n'


def main() -> None:
    """Run the scenes; print the page or write it."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('--full', action='store_true', help=f'{FULL_COUNT} scenes a family, an hour in all')
    parser.add_argument('--count', type=int, help='so many scenes a family')
    parser.add_argument('--seconds', type=float, default=SCENE_S, help='length of a scene')
    parser.add_argument('--seed', type=int, default=0)
    parser.add_argument('--processes', type=int, default=1)
    parser.add_argument('--output', type=Path, help='write the page to this file')
    options = parser.parse_args()
    folder = recordings_folder()
    names = list(families(folder))
    if len(names) < len(FAMILIES) + 1:
        print(f'no recordings at {folder}: no recorded room; set BEACON_COMM_DATA', file=sys.stderr)
    count = options.count or (FULL_COUNT if options.full else DEFAULT_COUNT)
    jobs = [(name, number) for number in range(count) for name in names]
    found = dict.fromkeys(names, Count())
    interrupted = ''
    with ProcessPoolExecutor(options.processes) as pool:
        results = [(name, pool.submit(watch, name, number, options.seed, options.seconds, folder)) for name, number in jobs]
        try:
            bar = tqdm(results, desc='scenes')
            for name, result in bar:
                found[name] += result.result()
                bar.set_postfix(confirmed=sum(count.confirmed for name, count in found.items() if name != CONTROL))
        except KeyboardInterrupt:  # the page of what is counted so far
            pool.shutdown(wait=False, cancel_futures=True)
            interrupted = f'  # stopped after {sum(count.scenes for count in found.values())} of {len(jobs)} scenes'
    shown = ['--full'] if options.full else []
    for option in ('count', 'seconds', 'seed'):
        if getattr(options, option) != parser.get_default(option):
            shown.append(f'--{option} {getattr(options, option):g}')
    page = text_of(found, ' '.join(['python docs/distractor_scenes.py', *shown]) + interrupted)
    if options.output is not None:
        options.output.write_text(page)
    else:
        print(page)


if __name__ == '__main__':
    main()
