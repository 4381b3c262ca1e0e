"""The demo's recording: two beacons over a background, real ones where the recordings are, else simulated."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from beacon_comm.core.events import NS_PER_S
from beacon_comm.evaluation.truth import SONNET18
from beacon_comm.recordings.disc import Disc
from beacon_comm.recordings.scene import Scene
from beacon_comm.recordings.sources import Background, Beacon, Clip, mat_beacon
from beacon_comm.simulation.led import simulate_text, square_wave

DURATION_S = 6.0
LEAD_S = 0.1
SIZE = (640, 480)
STILL = Disc.parse('200,160', *SIZE)
MOVING = Disc.parse('380,320,4,50,-20', *SIZE)
LAMP = Disc.parse('520,100,6', *SIZE)
SIMULATED_TEXT = 'North pier light: depth 4.2 m, wind WSW 12 kn, berth 7 is free.\n'
REAL_FILES = ('3125hz_30m.mat', '504hz_30m.mat', 'evt3_static')


def real_scene(folder: Path) -> Scene:
    """Return both outdoor recordings from where their sonnet begins, over the real indoor background.

    Raises:
        RecordingError: a recording is missing or unreadable.
    """
    fast = mat_beacon(folder / REAL_FILES[0], STILL, Clip(1.0))
    slow = mat_beacon(folder / REAL_FILES[1], MOVING, Clip(12.2, DURATION_S))
    beacons = tuple(replace(beacon, text=SONNET18) for beacon in (fast, slow))
    return Scene(beacons, *SIZE, Background(folder / REAL_FILES[2]))


def simulated_scene() -> Scene:
    """Return two simulated beacons and a lamp that flickers at 100 Hz, which is none."""
    beacons = [
        _simulated(3125.0, DURATION_S / 2, STILL, seed=1),
        _simulated(504.0, DURATION_S, MOVING, seed=2),
    ]
    t_ns, polarity = square_wave(100.0, 0.5, DURATION_S, seed=3)
    beacons.append(Beacon('lamp, 100 Hz', 'simulated', t_ns, polarity, round(DURATION_S * NS_PER_S), LAMP))
    return Scene(tuple(beacons), *SIZE)


def _simulated(bit_rate_bps: float, duration_s: float, disc: Disc, seed: int) -> Beacon:
    seconds_a_text = len(SIMULATED_TEXT) * 11 / bit_rate_bps
    text = SIMULATED_TEXT * max(int((duration_s - 2 * LEAD_S) / seconds_a_text), 1)
    t_ns, polarity = simulate_text(
        text, bit_rate_bps, t0_ns=round(LEAD_S * NS_PER_S), lead_s=LEAD_S, tail_s=LEAD_S, seed=seed
    )
    end_ns = round((2 * LEAD_S + len(text) * 11 / bit_rate_bps) * NS_PER_S)
    name = f'LED model, {bit_rate_bps:g} bps'
    return Beacon(name, 'simulated', t_ns, polarity, end_ns, disc, text=SIMULATED_TEXT, bit_rate_bps=bit_rate_bps)
