#!/usr/bin/env python3
"""Let beacons come and go for an hour of events, faster than real time; print what happened to memory, labels, confirmations.

    python docs/endurance.py                     # an hour of events
    python docs/endurance.py --minutes 5 --seed 2

::

    every 5 s     1 or 2 beacons at 504 or 3125 bps, and now and then a lamp, appear anywhere, stay 2 to 4.5 s and go
    all the time  noise;  1 % of the packets is lost
    packets       10 ms of evt3 words, through the live receiver: reader, clocks, detection, demodulators

Held to: a label is given again only near where it was lost and within `reacquire_s`, what is confirmed lies where a beacon was
at that time, memory does not grow, and hardly a character that is OK is not what was sent.
"""

from __future__ import annotations

import argparse
import math
import sys
import time
from collections import Counter
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

sys.path.insert(0, str(Path(__file__).resolve().parent))  # PYTHONSAFEPATH leaves it out

from resident_memory import growth, resident_mib  # noqa: E402

from beacon_comm.core.candidates import BeaconState  # noqa: E402
from beacon_comm.core.character import Status  # noqa: E402
from beacon_comm.core.events import NS_PER_S, EventBatch  # noqa: E402
from beacon_comm.core.framing import CharacterFrame  # noqa: E402
from beacon_comm.core.parameters import Parameters  # noqa: E402
from beacon_comm.core.receiver import BeaconSnapshot  # noqa: E402
from beacon_comm.recordings.disc import Disc  # noqa: E402
from beacon_comm.ros.live import LiveReceiver, Step  # noqa: E402
from beacon_comm.simulation.led import OUTDOOR_30_M, sensor_noise, simulate_text, square_wave  # noqa: E402
from beacon_comm.wire.cdr import build_event_packet  # noqa: E402
from beacon_comm.wire.evt3_encoder import Evt3Encoder  # noqa: E402

WIDTH, HEIGHT = 320, 240
RATES = (504.0, 3125.0)
SCENE_S = 5.0
PACKET_NS = 10_000_000
NOISE_PER_S = 10_000.0
LOST_SHARE = 0.01
CLIPS = 6
FAINT = replace(
    OUTDOOR_30_M,
    rise=replace(OUTDOOR_30_M.rise, events=0.4 * OUTDOOR_30_M.rise.events, held_per_s=0.4 * OUTDOOR_30_M.rise.held_per_s),
    fall=replace(OUTDOOR_30_M.fall, events=0.4 * OUTDOOR_30_M.fall.events, held_per_s=0.4 * OUTDOOR_30_M.fall.held_per_s),
)
"""Clips of each kind that are made once; a scene takes some of them at other places."""
NEAR_PX = 8.0
MATCH_SHARE = 0.25
TOLERANCE_NS = 1_000_000
LAMP_HZ, LAMP_SHARE = 100.0, 0.3
STAMP_NS = 1_700_000_000 * NS_PER_S
TYPE = 'event_camera_msgs/msg/EventPacket'


@dataclass(frozen=True, slots=True)
class Clip:
    """Events of a beacon or of a lamp (text ''), from 0 on."""

    text: str
    bit_rate_bps: float
    t_ns: NDArray[np.int64]
    polarity: NDArray[np.int8]


@dataclass(frozen=True, slots=True)
class Shown:
    """A clip on the scene: where, and from when (ns)."""

    clip: Clip
    x_px: float
    y_px: float
    start_ns: int

    @property
    def stop_ns(self) -> int:
        """Its last event's time (ns)."""
        return self.start_ns + int(self.clip.t_ns[-1])


@dataclass
class Tally:
    """What the hour gave.

    Attributes:
        counts: of beacons, characters, confirmations.
        labels: labels that were seen.
        gone: of lost tracks, and when (ns) and where (px) they were last seen.
        read: beacons of which a confirmed track gave a right character, by when they began (ns).
        problems: broken promises, as text.
        sizes_mib: memory that the process held, minute by minute.
    """

    counts: Counter[str] = field(default_factory=Counter)
    labels: set[int] = field(default_factory=set)
    gone: dict[int, tuple[int, float, float]] = field(default_factory=dict)
    confirmed: set[int] = field(default_factory=set)
    read: set[int] = field(default_factory=set)
    problems: list[str] = field(default_factory=list)
    sizes_mib: list[float] = field(default_factory=list)


def make_clips(random: np.random.Generator) -> tuple[list[Clip], list[Clip]]:
    """Return beacons and lamps."""
    beacons = []
    for k in range(CLIPS):
        for bit_rate_bps in RATES:
            characters = int(random.uniform(2.0, 4.5) * bit_rate_bps / CharacterFrame().length)
            text = ''.join(map(chr, random.integers(32, 127, characters)))
            beacons.append(Clip(text, bit_rate_bps, *simulate_text(text, bit_rate_bps, lead_s=0.0, model=FAINT, seed=k)))
    lamps = [Clip('', 0.0, *square_wave(LAMP_HZ, 0.5, 4.0, model=FAINT, seed=k)) for k in range(CLIPS)]
    return beacons, lamps


def make_scene(
    start_ns: int, beacons: list[Clip], lamps: list[Clip], random: np.random.Generator
) -> tuple[list[Shown], EventBatch]:
    """Return what is shown in the scene that starts at a time (ns), and its events, times from 0 on."""
    chosen = [beacons[k] for k in random.choice(len(beacons), random.integers(1, 3), replace=False)]
    if random.random() < LAMP_SHARE:
        chosen.append(lamps[random.integers(len(lamps))])
    cells = random.choice(12, len(chosen), replace=False)  # 4 x 3 cells, so that none touches another
    shown, parts = [], [sensor_noise(NOISE_PER_S, SCENE_S, WIDTH, HEIGHT, seed=int(random.integers(1 << 31)))]
    for clip, cell in zip(chosen, cells, strict=True):
        x_px, y_px = 40.0 + 80.0 * (cell % 4) + random.uniform(-15, 15), 40.0 + 80.0 * (cell // 4) + random.uniform(-15, 15)
        begin_ns = int(random.uniform(0.0, SCENE_S * NS_PER_S - clip.t_ns[-1] - 1)) // 1000 * 1000
        x, y = Disc(x_px, y_px, 4.0, 0.0, 0.0, WIDTH, HEIGHT).pixels(clip.t_ns, int(random.integers(1 << 31)))
        parts.append(EventBatch(x, y, clip.polarity, clip.t_ns + begin_ns, 0))
        shown.append(Shown(clip, x_px, y_px, start_ns + begin_ns))
    order = np.argsort(np.concatenate([part.t_ns for part in parts]), kind='stable')
    columns = [np.concatenate([getattr(part, name) for part in parts])[order] for name in ('x', 'y', 'polarity', 't_ns')]
    return shown, EventBatch(*columns, round(SCENE_S * NS_PER_S))


class Hour:
    """The live receiver, the clock and the tally."""

    def __init__(self, seed: int) -> None:
        self._random = np.random.default_rng(seed)
        self._beacons, self._lamps = make_clips(self._random)
        self._encoder = Evt3Encoder(WIDTH, HEIGHT)
        self._parameters = Parameters(bit_rates=RATES, rate_search='listed')
        self._live = LiveReceiver(self._parameters, 50_000_000, 100_000_000)
        self._live.open(TYPE, STAMP_NS)
        self._seq = 0
        self._start_ns = 0
        self._shown: list[Shown] = []
        self._places: dict[int, tuple[float, float]] = {}  # of confirmed tracks
        self.tally = Tally()

    def scene(self) -> None:
        """Show the next scene."""
        shown, events = make_scene(self._start_ns, self._beacons, self._lamps, self._random)
        self._shown = [*self._shown, *shown][-12:]
        self.tally.counts['beacons'] += sum(bool(one.clip.text) for one in shown)
        self.tally.counts['lamps'] += sum(not one.clip.text for one in shown)
        borders_ns = np.arange(0, events.t_end_ns + 1, PACKET_NS)
        cuts = np.searchsorted(events.t_ns, borders_ns)
        for k in range(len(borders_ns) - 1):
            part = events.slice(int(cuts[k]), int(cuts[k + 1]), 0)
            t_ns = part.t_ns + self._start_ns
            batch = EventBatch(part.x, part.y, part.polarity, t_ns, self._start_ns + int(borders_ns[k + 1]) - 1000)
            first_ns = int(t_ns[0]) if len(t_ns) else self._start_ns + int(borders_ns[k])
            payload = self._encoder.encode(batch)
            packet = build_event_packet(STAMP_NS + first_ns, 'camera', WIDTH, HEIGHT, self._seq, 0, 'evt3', payload)
            self._seq += 1
            self.tally.counts['events'] += len(batch)
            if self._seq > 1 and self._random.random() < LOST_SHARE:
                continue
            self._take(self._live.push(packet, STAMP_NS + first_ns))
        self._start_ns += events.t_end_ns

    def _take(self, step: Step) -> None:
        tally = self.tally
        for beacon in (*step.lost, *self._live.beacons()):
            gone = tally.gone.pop(beacon.track_id, None)
            if gone is not None and not self._may_be_back(beacon, *gone):
                tally.problems.append(f'label {beacon.track_id} is back')
            tally.labels.add(beacon.track_id)
            if beacon.state is BeaconState.CONFIRMED:
                self._places[beacon.track_id] = beacon.x_px, beacon.y_px
            if beacon.state is BeaconState.CONFIRMED and beacon.track_id not in tally.confirmed:
                tally.confirmed.add(beacon.track_id)
                if self._beacon_at(beacon.track_id, beacon.t_ns - NS_PER_S, beacon.t_ns) is None:
                    tally.problems.append(f'{beacon.track_id} is confirmed at {self._places[beacon.track_id]}: no beacon')
        tally.gone.update({one.track_id: (one.t_ns, one.x_px, one.y_px) for one in step.lost})
        for stamped in step.characters:
            if stamped.track_id in self._places and stamped.character.status is Status.OK:
                t_ns = stamped.at.sensor_ns
                shown = self._beacon_at(stamped.track_id, t_ns, t_ns)
                right = shown is not None and self._is_right(shown, t_ns, stamped.character.code)
                tally.counts['right' if right else 'wrong'] += 1
                if right and shown is not None:
                    tally.read.add(shown.start_ns)
        for beacon in step.lost:
            self._places.pop(beacon.track_id, None)

    def _may_be_back(self, beacon: BeaconSnapshot, lost_ns: int, x_px: float, y_px: float) -> bool:
        """Return whether a lost track's label may be given again: near where it was, and soon."""
        near = math.hypot(beacon.x_px - x_px, beacon.y_px - y_px) <= self._parameters.max_gate_px
        return near and beacon.t_ns - lost_ns <= round((self._parameters.reacquire_s + PACKET_NS / NS_PER_S) * NS_PER_S)

    def _beacon_at(self, track_id: int, first_ns: int, last_ns: int) -> Shown | None:
        """Return the beacon that was where a confirmed track is, at some time from first to last (ns)."""
        x_px, y_px = self._places[track_id]
        for shown in self._shown:
            near = (shown.x_px - x_px) ** 2 + (shown.y_px - y_px) ** 2 <= NEAR_PX**2
            if shown.clip.text and near and shown.start_ns - TOLERANCE_NS <= last_ns and first_ns <= shown.stop_ns:
                return shown
        return None

    @staticmethod
    def _is_right(shown: Shown, t_ns: int, code: int) -> bool:
        place = (t_ns - shown.start_ns) * shown.clip.bit_rate_bps / NS_PER_S / CharacterFrame().length
        k = round(place)
        return abs(place - k) < MATCH_SHARE and 0 <= k < len(shown.clip.text) and ord(shown.clip.text[k]) == code


def run(minutes: float, seed: int, quiet: bool = False) -> Tally:
    """Run so many minutes of events."""
    hour = Hour(seed)
    scenes = round(minutes * 60.0 / SCENE_S)
    per_minute = round(60.0 / SCENE_S)
    for k in tqdm(range(scenes), 'scenes', disable=quiet):
        hour.scene()
        if (k + 1) % per_minute == 0:
            hour.tally.sizes_mib.append(resident_mib())
    return hour.tally


def main() -> int:
    """Run and print; exit code 1 if a promise was broken."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else '')
    parser.add_argument('--minutes', type=float, default=60.0, help='of events (default: %(default)s)')
    parser.add_argument('--seed', type=int, default=1, help='of the random numbers (default: %(default)s)')
    options = parser.parse_args()
    begin_s = time.monotonic()
    tally = run(options.minutes, options.seed)
    took_s = time.monotonic() - begin_s
    counts = tally.counts
    print(f'{options.minutes:g} minutes of events in {took_s / 60:.1f}: {counts["events"] / 1e6:.0f} million')
    print(f'{counts["beacons"]} beacons, {len(tally.read)} of them confirmed and read, and {counts["lamps"]} lamps;', end=' ')
    print(f'{len(tally.labels)} labels, {len(tally.confirmed)} of them confirmed')
    print(f'characters of confirmed beacons: {counts["right"]} right and OK, {counts["wrong"]} wrong and OK')
    shown = [f'{size:.0f}' for size in tally.sizes_mib[:: max(len(tally.sizes_mib) // 12, 1)]]
    print(f'memory held (MiB), over the time: {", ".join(shown)}')
    tally.problems += growth(tally.sizes_mib)
    for problem in tally.problems:
        print(f'broken: {problem}')
    return 1 if tally.problems else 0


if __name__ == '__main__':
    sys.exit(main())
