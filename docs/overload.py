#!/usr/bin/env python3
"""Offer the live node more than it can do, over DDS; print what it read, what it shed, and how far it fell behind.

    python docs/overload.py                    # about a minute; ROS 2 and the built package are needed
    python docs/overload.py --seconds 10

::

    offered  half of what it can do ──► twice ──► half       a beacon of 3125 bps among noise, packets of 4 ms
    node     its /diagnostics once a second, its ~/characters

What it can do is measured first, with the same stream: half as much again in every step until some is shed, and then back
until none is, for an overload leaves false tracks behind, which cost time as long as they last.  Both processes share this
machine, so the figures are of this machine with a driver on it.
"""

from __future__ import annotations

import argparse
import os
import signal
import subprocess
import sys
import time
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from tqdm import tqdm

from beacon_comm.core.character import Status
from beacon_comm.core.events import NS_PER_S, EventBatch
from beacon_comm.core.framing import CharacterFrame
from beacon_comm.recordings.disc import Disc
from beacon_comm.simulation.led import simulate_text
from beacon_comm.wire.cdr import build_event_packet
from beacon_comm.wire.evt3_encoder import Evt3Encoder

WIDTH, HEIGHT = 640, 480
TOPIC = '/overload/events'
BIT_RATE = 3125.0
LINE = "Shall I compare thee to a summer's day? Thou art more lovely and more temperate:\n"
START_NS = NS_PER_S
STAMP_NS = 1_700_000_000 * NS_PER_S
PACKET_NS = 4_000_000
ONSET_S, STEP_S, STEPS, SETTLING_S = 1.0, 3.0, 12, 1.0
FIRST_EV_PER_S, MORE = 1e6, 1.5
TOO_MUCH = 0.05
"""Share of packets that is shed or lost where there is more than can be done."""
START_TIMEOUT_S = 240.0
RUN = 4
"""Events of the noise come in runs of so many columns, as edges that move do: words are then as dense as real ones."""


class Stream:
    """Packets of a beacon among noise of a rate that may change from packet to packet."""

    def __init__(self, seconds: float, seed: int = 1) -> None:
        self._random = np.random.default_rng(seed)
        length_s = CharacterFrame().length / BIT_RATE
        self.text = LINE * (int(seconds / length_s / len(LINE)) + 1)
        t_ns, polarity = simulate_text(self.text, BIT_RATE, t0_ns=START_NS, lead_s=0.0, seed=seed)
        x, y = Disc(320.0, 240.0, 4.0, 0.0, 0.0, WIDTH, HEIGHT).pixels(t_ns, seed)
        self._beacon = EventBatch(x, y, polarity, t_ns, int(t_ns[-1]))
        self._encoder = Evt3Encoder(WIDTH, HEIGHT)
        self._seq = 0

    def packets(self, seconds: float, events_per_s: float) -> list[tuple[bytes, int]]:
        """Return the next packets and their numbers of events."""
        return [self._next(events_per_s) for _ in tqdm(range(round(seconds * NS_PER_S / PACKET_NS)), 'packets')]

    def _next(self, events_per_s: float) -> tuple[bytes, int]:
        begin_ns = START_NS + self._seq * PACKET_NS
        first, stop = np.searchsorted(self._beacon.t_ns, [begin_ns, begin_ns + PACKET_NS])
        beacon = self._beacon.slice(int(first), int(stop), begin_ns + PACKET_NS)
        runs = self._random.poisson(events_per_s * PACKET_NS / NS_PER_S / RUN)
        t_ns = begin_ns + np.sort(self._random.integers(0, PACKET_NS // 1000, runs)) * 1000
        columns = self._random.integers(0, WIDTH - RUN, runs)[:, None] + np.arange(RUN)
        noise = (
            columns.ravel(),
            np.repeat(self._random.integers(0, HEIGHT, runs), RUN),
            self._random.choice([-1, 1], runs * RUN),
            np.repeat(t_ns, RUN),
        )
        parts = zip((beacon.x, beacon.y, beacon.polarity, beacon.t_ns), noise, strict=True)
        x, y, polarity, times = (np.concatenate(pair) for pair in parts)
        order = np.argsort(times, kind='stable')
        batch = EventBatch(
            x[order].astype(np.uint16), y[order].astype(np.uint16), polarity[order].astype(np.int8),
            times[order].astype(np.int64), begin_ns + PACKET_NS - 1000,
        )  # fmt: skip
        payload = self._encoder.encode(batch)
        stamp_ns = STAMP_NS + begin_ns - START_NS
        packet = build_event_packet(stamp_ns, 'camera', WIDTH, HEIGHT, self._seq, 0, 'evt3', payload)
        self._seq += 1
        return packet, len(batch)


@dataclass
class Phase:
    """What was offered and heard in one phase.

    Attributes:
        name: of the phase.
        offered_ev_per_s: events that were published in a second.
        late_s: by how much the publisher itself was late at the worst (s).
        reports: values of ``/diagnostics``, one entry a second.
        characters: sensor times (ns), codes and whether they are OK.
    """

    name: str
    offered_ev_per_s: float = 0.0
    late_s: float = 0.0
    reports: list[dict[str, str]] = field(default_factory=list)
    characters: list[tuple[int, int, bool]] = field(default_factory=list)

    def counted(self, kind: str) -> int:
        """Return what was counted between its first and its last report."""
        return int(self.reports[-1][kind]) - int(self.reports[0][kind])

    @property
    def decoded_ev_per_s(self) -> float:
        """Events that were decoded in a second, the middle one of the seconds that had any."""
        rates = [float(report['events_per_s']) for report in self.reports]
        return float(np.median([rate for rate in rates if rate > 0.0] or [0.0]))

    @property
    def unread(self) -> float:
        """Share of the packets that were shed or lost."""
        lost = self.counted('lost_packets')
        return (self.counted('shed_packets') + lost) / max(self.counted('packets') + lost, 1)

    def row(self, sent: str) -> str:
        """Return the phase as a row of the table."""
        tally = Counter(verdict(sent, *character) for character in self.characters)
        lag_ms = [1e3 * float(report['lag_s']) for report in self.reports]
        packets, shed, lost = self.counted('packets'), self.counted('shed_packets'), self.counted('lost_packets')
        cells = (
            self.name,
            f'{self.offered_ev_per_s / 1e6:.1f}',
            f'{self.decoded_ev_per_s / 1e6:.1f}',
            f'{shed / max(packets, 1):.0%}',
            str(lost),
            f'{np.median(lag_ms):.0f}, {max(lag_ms):.0f}',
            str(tally['ok']),
            str(tally['wrong, ok']),
        )
        return f'| {" | ".join(cells)} |'


def verdict(sent: str, t_ns: int, code: int, ok: bool) -> str:
    """Say of a character whether it is as sent."""
    place = (t_ns - START_NS) * BIT_RATE / NS_PER_S / CharacterFrame().length
    k = round(place)
    right = abs(place - k) < 0.2 and 0 <= k < len(sent) and ord(sent[k]) == code
    return ('ok' if ok else 'right') if right else ('wrong, ok' if ok else 'wrong')


class Driver:
    """Publishes packets at their pace, and listens."""

    def __init__(self) -> None:
        import rclpy
        from beacon_comm.msg import Characters
        from diagnostic_msgs.msg import DiagnosticArray
        from event_camera_msgs.msg import EventPacket
        from rclpy.qos import QoSProfile, ReliabilityPolicy

        rclpy.init()
        self._rclpy = rclpy
        self._node = rclpy.create_node('driver')
        self._publisher = self._node.create_publisher(
            EventPacket, TOPIC, QoSProfile(depth=1000, reliability=ReliabilityPolicy.BEST_EFFORT)
        )
        self._node.create_subscription(DiagnosticArray, '/diagnostics', self._on_diagnostics, 10)
        self._node.create_subscription(Characters, '/beacon_node/characters', self._on_characters, 1000)
        self.phase = Phase('')

    def _on_diagnostics(self, message: Any) -> None:
        self.phase.reports.append({entry.key: entry.value for entry in message.status[0].values})

    def _on_characters(self, message: Any) -> None:
        for character in message.characters:
            entry = (character.sensor_time_ns, character.code, character.status == Status.OK)
            self.phase.characters.append(entry)

    def wait_for_the_node(self, node: subprocess.Popen[bytes]) -> None:
        """Wait until the node subscribes.

        Raises:
            RuntimeError: it ended, or took too long.
        """
        deadline_s = time.monotonic() + START_TIMEOUT_S
        while not self._publisher.get_subscription_count():
            if node.poll() is not None or time.monotonic() > deadline_s:
                raise RuntimeError('the node did not start')
            self._rclpy.spin_once(self._node, timeout_sec=0.1)

    def run(self, phase: Phase, packets: list[tuple[bytes, int]]) -> None:
        """Publish packets at their pace, as one phase."""
        self.phase = phase
        begin_s = time.monotonic()
        for k, (packet, _) in enumerate(packets):
            due_s = begin_s + k * PACKET_NS / NS_PER_S
            self.listen(due_s - time.monotonic())
            phase.late_s = max(phase.late_s, time.monotonic() - due_s)
            self._publisher.publish(packet)
        phase.offered_ev_per_s = sum(n for _, n in packets) / (time.monotonic() - begin_s)
        self.listen(SETTLING_S)

    def listen(self, seconds: float) -> None:
        """Only listen for so long."""
        deadline_s = time.monotonic() + seconds
        while (left_s := deadline_s - time.monotonic()) > 0.0:
            self._rclpy.spin_once(self._node, timeout_sec=left_s)


def capacity(driver: Driver, stream: Stream) -> float:
    """Return how many events a second (1/s) the node reads all of."""

    def offer(step: int) -> Phase:
        driver.run(Phase('onset'), stream.packets(ONSET_S, FIRST_EV_PER_S * MORE**step))
        phase = Phase('step')
        driver.run(phase, stream.packets(STEP_S, FIRST_EV_PER_S * MORE**step))
        print(f'{phase.offered_ev_per_s / 1e6:.1f} Mev/s: {phase.unread:.0%} unread', file=sys.stderr)
        return phase

    step = 0
    while (phase := offer(step)).unread <= TOO_MUCH and step < STEPS:
        step += 1
    while phase.unread > TOO_MUCH and step > -STEPS:
        step -= 1
        phase = offer(step)
    return phase.offered_ev_per_s


def main() -> int:
    """Run the phases and print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else '')
    parser.add_argument('--seconds', type=float, default=6.0, help='length of a phase (default: %(default)s)')
    options = parser.parse_args()
    os.environ.setdefault('ROS_DOMAIN_ID', str(1 + os.getpid() % 100))
    os.environ.setdefault('ROS_AUTOMATIC_DISCOVERY_RANGE', 'LOCALHOST')
    profile = Path(__file__).resolve().parents[1] / 'config' / 'fastdds_shm.xml'
    os.environ.setdefault('FASTRTPS_DEFAULT_PROFILES_FILE', str(profile))
    with TemporaryDirectory(prefix='overload_') as folder, (Path(folder) / 'node.log').open('w') as log:
        arguments = ['--ros-args', '-r', f'events:={TOPIC}', '-p', f'bit_rates:=[{BIT_RATE}]', '-p', 'rate_search:=listed']
        command = [sys.executable, '-P', '-m', 'beacon_comm.ros.node', *arguments]
        node = subprocess.Popen(command, stdout=log, stderr=subprocess.STDOUT)
        try:
            driver = Driver()
            driver.wait_for_the_node(node)
            stream = Stream(4 * STEPS * (ONSET_S + STEP_S) + 3 * options.seconds + 1.0)
            can_ev_per_s = capacity(driver, stream)
            phases = [Phase('half'), Phase('twice'), Phase('half again')]
            for phase, factor in zip(phases, (0.5, 2.0, 0.5), strict=True):
                driver.run(phase, stream.packets(options.seconds, factor * can_ev_per_s))
        finally:
            node.send_signal(signal.SIGINT)
            code = node.wait(30)
        print(f'what it can do: {can_ev_per_s / 1e6:.1f} Mev/s; the node ended with exit code {code}\n')
        print('| offered | Mev/s | decoded, Mev/s | shed | lost | lag, median and longest (ms) | right and ok | wrong and ok |')
        print('|---|---|---|---|---|---|---|---|')
        for phase in phases:
            print(phase.row(stream.text))
        late_ms = max(1e3 * phase.late_s for phase in phases)
        print(f'\nThe publisher itself was late by up to {late_ms:.0f} ms.')
    return code


if __name__ == '__main__':
    sys.exit(main())
