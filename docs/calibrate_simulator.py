#!/usr/bin/env python3
"""Hold the simulator against the real 30 m recordings: edges, counts, bursts, and both receivers' error rates.

    python docs/calibrate_simulator.py --output docs                # writes calibration.md and figures/simulator_calibration.png
    python docs/calibrate_simulator.py --fit 504hz_30m --steps 200  # search better values for one recording, and print them

What was sent when is known for the real recordings (the times of ``test_truth.py``), so that every event has a time since
the last edge of the line.  The recordings hold the events of a region that never gives more than 49 events in a burst:
taken to be 7 × 7 pixels.  From the simulation the same region around the beacon is taken.
"""

from __future__ import annotations

import argparse
import os
import sys
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from beacon_comm.core.events import NS_PER_S
from beacon_comm.core.framing import CharacterFrame, transitions
from beacon_comm.evaluation.truth import SONNET18
from beacon_comm.recordings.mat import read_mat
from beacon_comm.simulation.description import BeaconKeys, Led, SceneDescription, Sensor
from beacon_comm.simulation.scene import simulate

PROJECT = Path(__file__).resolve().parents[1]
REGION_PX = 3  # 7 × 7 pixels
SIDE_PX = 40
BIN_US = 40.0
LONGEST_US = 1600.0


@dataclass(frozen=True, slots=True)
class Recorded:
    """A recording and its best-known sending: begin (s), rate (bit/s), how many characters of the sonnet."""

    start_s: float
    bit_rate_bps: float
    characters: int


RECORDINGS = {'504hz_30m': Recorded(12.3804, 503.83, 264), '3125hz_30m': Recorded(1.07076, 3123.74, 618)}


@dataclass(frozen=True, slots=True, eq=False)
class Signal:
    """Events of the region, and the line: levels from each change on, until the end (ns)."""

    t_ns: NDArray[np.int64]
    polarity: NDArray[np.int8]
    changes_ns: NDArray[np.int64]
    levels: NDArray[np.uint8]
    end_ns: int
    bit_ns: float


def data_folder() -> Path:
    """Return the folder of the real recordings."""
    return Path(os.environ.get('BEACON_COMM_DATA', PROJECT.parent / 'shared' / 'data'))


def real_signal(name: str) -> Signal:
    """Return a recording from the begin of its last sending on."""
    recorded = RECORDINGS[name]
    t_ns, polarity = read_mat(data_folder() / f'{name}.mat')
    start_ns = round(recorded.start_s * NS_PER_S)
    bits = CharacterFrame().encode_bits(SONNET18[: recorded.characters])
    changes_ns, levels = transitions(bits, recorded.bit_rate_bps, start_ns)
    end_ns = start_ns + round(len(bits) / recorded.bit_rate_bps * NS_PER_S)
    return Signal(t_ns, polarity, changes_ns, levels, end_ns, NS_PER_S / recorded.bit_rate_bps)


def simulated_signal(name: str, sensor: Sensor, led: Led, characters: int, seed: int) -> Signal:
    """Return what the same region sees of a simulated beacon that sends the same."""
    recorded = RECORDINGS[name]
    duration_s = 0.06 + characters * 11 / recorded.bit_rate_bps
    scene = SceneDescription(
        duration_s=round(duration_s, 3),
        beacons=(BeaconKeys(text=SONNET18[:characters], bit_rate_bps=(recorded.bit_rate_bps,), led=led),),
        sensor=replace(sensor, width=SIDE_PX, height=SIDE_PX),
    )
    batches, truth = simulate(scene, seed)
    events = list(batches)
    t_ns, x, y = (np.concatenate([getattr(batch, column) for batch in events]) for column in ('t_ns', 'x', 'y'))
    polarity = np.concatenate([batch.polarity for batch in events])
    (beacon,) = truth.beacons
    middle = round(0.5 * (SIDE_PX - 1))
    inside = (np.abs(x.astype(int) - middle) <= REGION_PX) & (np.abs(y.astype(int) - middle) <= REGION_PX)
    bit_ns = NS_PER_S / recorded.bit_rate_bps
    end_ns = int(beacon.sendings_ns[0]) + round(characters * 11 * bit_ns)
    return Signal(t_ns[inside], polarity[inside], beacon.changes_ns, beacon.levels, end_ns, bit_ns)


def profiles(signal: Signal, shift_us: float = 0.0) -> dict[tuple[int, int, int], tuple[NDArray[np.float64], int]]:
    """Return the mean events since an edge, by kind of edge.

    Args:
        signal: events and line.
        shift_us: how much later the line is taken to be: the recordings' clock has no zero.

    Returns:
        For (level, bits held before: 1, 2 or 3 for more, bits held: the same) the mean number of ON and OFF events an edge
        in bins of ``BIN_US``, ``(2, bins)``, and how many edges there were.
    """
    changes = signal.changes_ns + round(shift_us * 1e3)
    ends = np.append(changes[1:], signal.end_ns + round(shift_us * 1e3))
    held = np.rint((ends - changes) / signal.bit_ns).astype(int)
    before = np.concatenate(([9], held[:-1]))
    part = slice(*np.searchsorted(signal.t_ns, (changes[0], ends[-1])))
    t_ns, polarity = signal.t_ns[part], signal.polarity[part]
    edge = np.searchsorted(changes, t_ns, side='right') - 1
    since = ((t_ns - changes[edge]) * 1e-3 // BIN_US).astype(int)
    bins = int(LONGEST_US // BIN_US)
    found = {}
    for level in (0, 1):
        for was in (1, 2, 3):
            for now in (1, 2, 3):
                chosen = (signal.levels == level) & (np.minimum(before, 3) == was) & (np.minimum(held, 3) == now)
                if chosen.sum() < 10:
                    continue
                mine = chosen[edge] & (since < bins)
                table = np.zeros((2, bins))
                np.add.at(table, ((polarity[mine] < 0).astype(int), since[mine]), 1.0)
                found[level, was, now] = (table / chosen.sum(), int(chosen.sum()))
    return found


def misfit(real: Signal, simulated: Signal, shift_us: float) -> float:
    """Return how far two signals are apart: squared differences of root counts, a kind of edge by its number of edges."""
    theirs, ours = profiles(real, shift_us), profiles(simulated)
    total, weight = 0.0, 0.0
    for kind, (table, edges) in theirs.items():
        if kind not in ours:
            continue
        mine = ours[kind][0]
        kernel = np.array([0.25, 0.5, 0.25])  # the bursts' exact phase is not what is fitted
        for a, b in zip(table, mine, strict=True):
            smooth = [np.sqrt(np.convolve(one, kernel, mode='same')) for one in (a, b)]
            total += edges * float(np.sum((smooth[0] - smooth[1]) ** 2))
        total += edges * 0.5 * float(np.sum((np.sqrt(table.sum(axis=1)) - np.sqrt(mine.sum(axis=1))) ** 2))
        weight += edges
    return total / weight


FITTED = {
    'sensor': ('threshold_on', 'threshold_off', 'photoreceptor_us', 'follower_us', 'refractory_us', 'psf_px', 'photon_noise'),
    'led': ('contrast', 'rise_us', 'fall_us', 'rise_slew_us', 'fall_slew_us'),
}


def fit(names: list[str], sensor: Sensor, leds: dict[str, Led], steps: int, seed: int, fixed: set[str]) -> None:
    """Search by random steps that shrink when they fail: one sensor, one LED each; print what is better."""
    random = np.random.default_rng(seed)
    keys = [('sensor', '', name) for name in FITTED['sensor'] if name not in fixed]
    keys += [('led', one, name) for one in names for name in (*FITTED['led'], 'shift_us') if name not in fixed]
    values = np.array(
        [
            getattr(sensor, name) if part == 'sensor' else 100.0 if name == 'shift_us' else getattr(leds[one], name)
            for part, one, name in keys
        ]
    )
    real = {name: real_signal(name) for name in names}
    characters = {'504hz_30m': 30, '3125hz_30m': 80}

    def cost(logs: NDArray[np.float64]) -> float:
        changed = np.exp(logs)
        mine = replace(sensor, **{key[2]: float(v) for key, v in zip(keys, changed, strict=True) if key[0] == 'sensor'})
        total = 0.0
        for name in names:
            own = {key[2]: float(v) for key, v in zip(keys, changed, strict=True) if key[1] == name}
            shift_us = own.pop('shift_us') - 100.0
            led = replace(leds[name], **own)
            total += misfit(real[name], simulated_signal(name, mine, led, characters[name], 1), shift_us)
        return total

    best = np.log(np.maximum(values, 1e-6))
    least = cost(best)
    print(f'start: {least:.3f}', flush=True)
    size = 0.25
    for step in range(steps):
        chosen = random.random(len(keys)) < max(0.25, 2.0 / len(keys))
        trial = best + size * random.normal(size=len(keys)) * chosen
        now = cost(trial)
        if now < least:
            best, least = trial, now
            size = min(size * 1.3, 0.5)
            shown = ', '.join(f'{key[1] and key[1][:4] + "."}{key[2]}={v:.4g}' for key, v in zip(keys, np.exp(best), strict=True))
            print(f'{step}: {least:.3f}  {shown}', flush=True)
        else:
            size = max(size * 0.96, 0.03)
