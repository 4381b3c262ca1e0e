#!/usr/bin/env python3
"""Sweep cut-off and levels over the real 30 m recordings; print the tables of threshold_demodulator.md.

    python docs/sweep_threshold.py [--folder ../shared/data]            # some minutes
"""

from __future__ import annotations

import argparse
import math
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from beacon_comm.core.demodulator import ThresholdDemodulator, make_demodulator
from beacon_comm.core.events import NS_PER_S
from beacon_comm.core.parameters import Parameters
from beacon_comm.evaluation.held import Signal
from beacon_comm.evaluation.scoring import Transmission, score
from beacon_comm.evaluation.truth import SONNET18
from beacon_comm.recordings.disc import Disc
from beacon_comm.recordings.folder import recordings_folder
from beacon_comm.recordings.mat import read_mat
from beacon_comm.recordings.scene import Scene
from beacon_comm.recordings.sources import Background, Clip, mat_beacon

NAMES = ('504hz_30m.mat', '3125hz_30m.mat')
CUTOFFS = {'1/3': 1 / 3, '1': 1.0, '1.5': 1.5, '2π/3': 2 * math.pi / 3, '2.5': 2.5, '3': 3.0, '4': 4.0}
LOW_SHARES = (0.01, 0.02, 0.035, 0.05, 0.07, 0.09, 0.1, 0.15, 0.2, 0.3)
FIXED_LEVELS = ((4.0, -3.0), (6.0, -5.0), (10.0, -8.0), (20.0, -15.0), (30.0, -20.0), (50.0, -30.0))
NOISE_SHARES = (0.0, 0.01, 0.03, 0.1)
BATCH_NS = 4_000_000


def transmissions(t_ns: NDArray[np.int64], polarity: NDArray[np.int8], parameters: Parameters) -> list[Transmission]:
    """Decode a recording in packets, as the node would, and score it."""
    demodulator = make_demodulator(parameters)
    cuts = np.searchsorted(t_ns, np.arange(t_ns[0], t_ns[-1], BATCH_NS))
    characters = []
    for start, stop in zip(cuts, [*cuts[1:], len(t_ns)], strict=True):
        characters += demodulator.push(t_ns[start:stop], polarity[start:stop], int(t_ns[stop - 1]))
    characters += demodulator.push(t_ns[:0], polarity[:0], int(t_ns[-1]) + NS_PER_S)
    characters += demodulator.flush()
    return list(score(characters, SONNET18, (int(t_ns[0]), int(t_ns[-1])), Signal(t_ns, polarity)))


def cells(t_ns: NDArray[np.int64], polarity: NDArray[np.int8], parameters: Parameters) -> tuple[str, str, str]:
    """Return right characters and bit accuracy of the last sending, and right characters of the tail before it."""
    scores = transmissions(t_ns, polarity, parameters)
    last = [t for t in scores if t.start_ns is not None and t.start_ns > t_ns[0]]
    tail = [t for t in scores if t not in last]

    def right(found: Sequence[Transmission]) -> str:
        if not found:
            return 'not found'
        inserted = f' (+{found[-1].inserted})' if found[-1].inserted else ''
        return f'{found[-1].characters - found[-1].wrong + found[-1].inserted}{inserted} of {found[-1].characters}'

    return right(last), f'{last[-1].bit_accuracy:.4f}' if last else '0.5', right(tail)


def row(*columns: str) -> None:
    print('| ' + ' | '.join(columns) + ' |', flush=True)


def head(*columns: str) -> None:
    print()
    row(*columns)
    row(*('---' for _ in columns))


def with_noise(
    t_ns: NDArray[np.int64], polarity: NDArray[np.int8], share: float
) -> tuple[NDArray[np.int64], NDArray[np.int8]]:
    """Add events of random times and polarities, so many of the recording's own."""
    random = np.random.default_rng(0)
    count = round(share * len(t_ns))
    times = np.concatenate([t_ns, random.integers(t_ns[0], t_ns[-1], count)])
    signs = np.concatenate([polarity, random.choice(np.array([-1, 1], np.int8), count)])
    order = np.argsort(times, kind='stable')
    return times[order], signs[order]


def before_a_lamp(folder: Path) -> tuple[tuple[NDArray[np.int64], NDArray[np.int8]], ...]:
    """Return the events of a moving 504 bps beacon's routing circle, without and with lamps behind its path."""
    background = Background(folder / 'evt3_static')
    disc = Disc(250.0, 200.0, 4.0, 50.0, 0.0, background.width, background.height)
    scene = Scene(
        (mat_beacon(folder / NAMES[0], disc, Clip(12.3, 5.0)),), background.width, background.height, background
    )
    found = []
    for view in (replace(scene, background=None), scene):
        times, signs = [], []
        for batch in view.batches():
            x_px, y_px = disc.centre(batch.t_ns / NS_PER_S)
            inside = np.hypot(batch.x - x_px, batch.y - y_px) <= 1.5 * disc.radius_px + 2.0
            times.append(batch.t_ns[inside])
            signs.append(batch.polarity[inside])
        found.append((np.concatenate(times), np.concatenate(signs)))
    return tuple(found)


def nanoseconds_an_event(t_ns: NDArray[np.int64], polarity: NDArray[np.int8], bit_rate_bps: float) -> float:
    """Time the demodulator at one rate, the recording handed over at once."""
    ThresholdDemodulator(bit_rate_bps, Parameters()).push(t_ns[:100], polarity[:100], int(t_ns[-1]))  # compile
    demodulator = ThresholdDemodulator(bit_rate_bps, Parameters())
    started = time.process_time()
    demodulator.push(t_ns, polarity, int(t_ns[-1]))
    return (time.process_time() - started) * 1e9 / len(t_ns)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('--folder', type=Path, default=recordings_folder(), help='folder of the recordings')
    folder = Path(parser.parse_args().folder)
    events = {name: read_mat(folder / name) for name in NAMES}
    slow, fast = (events[name] for name in NAMES)
    defaults = Parameters()

    print('### Rules')
    head('rules', '504 bps', 'tail', '3125 bps', 'bits', 'tail')
    for name, rules in {
        'defaults': defaults,
        'no start trials': replace(defaults, start_trials=False, bit_rates=(504.0,)),
        'no start trials, no idle start (the paper to the letter)': replace(
            defaults, start_trials=False, idle_start=False, bit_rates=(504.0,)
        ),
    }.items():
        one = rules is not defaults
        at_504 = cells(*slow, replace(rules, bit_rates=(504.0,)) if one else rules)
        at_3125 = cells(*fast, replace(rules, bit_rates=(3125.0,)) if one else rules)
        row(name, at_504[0], at_504[2], *at_3125)

    for title, cell in (('characters right', 0), ('bit accuracy', 1)):
        print(f'\n### Adaptive levels × cut-off, 3125 bps, {title} (high share = 1.2 × low share)')
        head('low share', *(f'α = {name} f' for name in CUTOFFS))
        for share in LOW_SHARES:
            settings = [
                replace(defaults, cutoff_per_bit=cutoff, low_share=share, high_share=1.2 * share)
                for cutoff in CUTOFFS.values()
            ]
            row(f'{share:g}', *(cells(*fast, setting)[cell] for setting in settings))

    print('\n### Adaptive levels × cut-off, 504 bps, characters right')
    head('low share', *(f'α = {name} f' for name in CUTOFFS))
    for share in LOW_SHARES[::2]:
        settings = [
            replace(defaults, cutoff_per_bit=cutoff, low_share=share, high_share=1.2 * share)
            for cutoff in CUTOFFS.values()
        ]
        row(f'{share:g}', *(cells(*slow, setting)[0] for setting in settings))

    print('\n### Fixed levels, α = 2π/3 f')
    head('levels (events)', '504 bps', '3125 bps', 'bits')
    for high, low in FIXED_LEVELS:
        fixed = replace(defaults, levels='fixed', high_level=high, low_level=low)
        row(f'{high:g}, {low:g}', cells(*slow, fixed)[0], *cells(*fast, fixed)[:2])

    print('\n### Added noise (share of the recording’s own events), α = 2π/3 f')
    head('low share', *(f'{bps} bps, {100 * noise:g} %' for bps in (504, 3125) for noise in NOISE_SHARES))
    for share in LOW_SHARES[::2]:
        setting = replace(defaults, low_share=share, high_share=1.2 * share)
        row(
            f'{share:g}',
            *(cells(*with_noise(*signal, noise), setting)[0] for signal in (slow, fast) for noise in NOISE_SHARES),
        )

    print('\n### A 504 bps beacon that moves past the lamps of evt3_static, α = 2π/3 f')
    head('low share', 'without background', 'with')
    views = before_a_lamp(folder)
    for share in LOW_SHARES:
        setting = replace(defaults, low_share=share, high_share=1.2 * share)
        row(f'{share:g}', *(cells(*signal, setting)[0] for signal in views))

    print('\n### Cost')
    for (t_ns, polarity), bit_rate_bps in ((slow, 504.0), (fast, 3125.0)):
        print(f'{bit_rate_bps:g} bps: {nanoseconds_an_event(t_ns, polarity, bit_rate_bps):.0f} ns an event')


if __name__ == '__main__':
    main()
