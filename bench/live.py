#!/usr/bin/env python3
"""Publish a dense scene through DDS to the live node, rate by rate; write down what the node says of itself.

    bench.py ──► this process: messages at their pace ──► DDS, shared memory ──► the node's process
                     ▲                                                               │
                     └───────────────── /diagnostics, once a second ◄────────────────┘

A phase is a rate: a publisher comes, warms up for a while, in which the beacons are found, is measured, and goes.  The scene is
prepared once and sent round and round: of a message nothing changes from one round to the next but its times and its number.

It is a process of its own since the middleware takes its settings from the environment it is started in.
"""

from __future__ import annotations

import argparse
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from importlib.util import find_spec
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parent))  # PYTHONSAFEPATH leaves it out

from streams import LOOP_NS, PACKET_NS, Repeated, make_stream  # noqa: E402

from beacon_comm.core.events import NS_PER_S  # noqa: E402
from beacon_comm.ros.latency import LOOKS  # noqa: E402

PROJECT = Path(__file__).resolve().parents[1]
PROFILE = PROJECT / 'config' / 'fastdds_shm.xml'
MESSAGES_PREFIX = Path(sys.prefix) / 'bench'
"""Where ``make bench`` installs dvs_msgs, for its own processes alone."""
TOPIC = '/bench/events'
SIZE = (1280, 720)
WARM_UP_S, MEASURED_S = 2.0, LOOKS + 1.0
"""The node's window of latencies, which is up to a second old, is to lie in the second part."""
CONNECTED_S, SETTLED_S, CONNECT_TIMEOUT_S, START_TIMEOUT_S = 0.5, 4.0, 10.0, 240.0
LISTENING_PACKETS = 50
ENCODINGS = ('evt3', 'event_array')
TICK_S = 1.0 / os.sysconf('SC_CLK_TCK')


@dataclass
class Phase:
    """One rate, as it was offered and as the node says.

    Attributes:
        encoding: ``evt3`` (EventPacket) or ``event_array``.
        nominal_mev_per_s: the background's rate that was asked for.
        scene_mev_per_s: the rate of the scene, its beacons included.
        offered_mev_per_s: what was published, by the clock.
        late_ms: by how much the publisher was late, at the worst.
        packets: messages published, warm-up included.
        missing: of these, those that never reached the node.
        shed, measured: messages that the node shed, and that came, after the warm-up.
        lag_ms: longest from a message's arrival to what it gave being published, after the warm-up.
        events_mev_per_s: what the node read (median of the seconds).
        latency_p50_ms, latency_p99_ms, latency_characters: of the characters of the last seconds; None without any.
        confirmed: beacons at the end.
        node_cores, publisher_cores: processor time by time.
    """

    encoding: str
    nominal_mev_per_s: float
    scene_mev_per_s: float = 0.0
    offered_mev_per_s: float = 0.0
    late_ms: float = 0.0
    packets: int = 0
    missing: int = 0
    shed: int = 0
    measured: int = 0
    lag_ms: float = 0.0
    events_mev_per_s: float = 0.0
    latency_p50_ms: float | None = None
    latency_p99_ms: float | None = None
    latency_characters: int = 0
    confirmed: int = 0
    node_cores: float = 0.0
    publisher_cores: float = 0.0

    @property
    def held(self) -> bool:
        """Whether nothing was lost and nothing was shed."""
        return self.measured > 0 and self.missing == 0 and self.shed == 0


def measure(
    folder: Path,
    rates: Sequence[float],
    array_rates: Sequence[float] = (),
    warm_up_s: float = WARM_UP_S,
    measured_s: float = MEASURED_S,
) -> list[Phase]:
    """Run :func:`main` in a process of its own; return its phases.

    Args:
        folder: of the recordings.
        rates, array_rates: of the background (million events a second), as EventPackets and as EventArrays.
        warm_up_s, measured_s: lengths of a phase's parts (s).
    """
    with TemporaryDirectory(prefix='live_') as place:
        output = Path(place) / 'phases.json'
        command = [sys.executable, '-P', __file__, '--folder', str(folder), '--json', str(output), '--rates', *map(str, rates)]
        command += ['--array-rates', *map(str, array_rates), '--warm-up', str(warm_up_s), '--seconds', str(measured_s)]
        subprocess.run(command, env=environment(Path(place)), check=True)
        return [Phase(**phase) for phase in json.loads(output.read_text())]


def can_publish_arrays() -> bool:
    """Return whether there is a message type for EventArrays: the bench's own, or one that is installed."""
    return (MESSAGES_PREFIX / 'share' / 'dvs_msgs').is_dir() or find_spec('dvs_msgs') is not None


def environment(folder: Path) -> dict[str, str]:
    """Return the environment of both processes: the shipped profile, a domain of their own, logs into a folder."""
    env = {
        'ROS_DOMAIN_ID': str(1 + os.getpid() % 100),
        'ROS_AUTOMATIC_DISCOVERY_RANGE': 'LOCALHOST',
        'FASTRTPS_DEFAULT_PROFILES_FILE': str(PROFILE),
        'ROS_LOG_DIR': str(folder),
        **os.environ,
    }
    version = f'python{sys.version_info.major}.{sys.version_info.minor}'
    for name, path in (('PYTHONPATH', f'lib/{version}/site-packages'), ('LD_LIBRARY_PATH', 'lib')):
        if MESSAGES_PREFIX.is_dir():
            env[name] = os.pathsep.join(filter(None, [str(MESSAGES_PREFIX / path), env.get(name)]))
    return env


class Node:
    """The node under measurement, a process of its own."""

    def __init__(self, folder: Path) -> None:
        self._log = folder / 'node.log'
        arguments = ['--ros-args', '-r', f'events:={TOPIC}']
        with self._log.open('w') as log:
            self.process = subprocess.Popen(
                [sys.executable, '-P', '-m', 'beacon_comm.ros.node', *arguments], stdout=log, stderr=subprocess.STDOUT
            )

    def __enter__(self) -> Node:
        return self

    def __exit__(self, *error: object) -> None:
        self.process.send_signal(signal.SIGINT)
        try:
            self.process.wait(20)
        except subprocess.TimeoutExpired:
            self.process.kill()
            self.process.wait()
        if error[0] is not None:
            print(self._log.read_text()[-4000:], file=sys.stderr)

    def processor_s(self) -> float:
        """Return the processor time (s) it has taken."""
        fields = Path(f'/proc/{self.process.pid}/stat').read_text().rpartition(')')[2].split()
        return (int(fields[11]) + int(fields[12])) * TICK_S


@dataclass
class Report:
    """The node's ``/diagnostics`` of one second, and when they came (s, monotonic)."""

    at_s: float
    values: dict[str, str] = field(default_factory=dict)

    def count(self, kind: str) -> int:
        """Return a count."""
        return int(self.values.get(kind, '0'))


class Driver:
    """Publishes, and listens to the node's diagnostics."""

    def __init__(self) -> None:
        import rclpy
        from diagnostic_msgs.msg import DiagnosticArray

        rclpy.init()
        self._rclpy = rclpy
        self._node = rclpy.create_node('bench')
        self._node.create_subscription(DiagnosticArray, '/diagnostics', self._on_diagnostics, 10)
        self._reports: list[Report] = []

    def _on_diagnostics(self, message: Any) -> None:
        values = {entry.key: entry.value for entry in message.status[0].values}
        self._reports.append(Report(time.monotonic(), values))

    def listen(self, seconds: float) -> None:
        """Listen for so long."""
        deadline_s = time.monotonic() + seconds
        while (left_s := deadline_s - time.monotonic()) > 0.0:
            self._rclpy.spin_once(self._node, timeout_sec=left_s)

    def wait_for_a_report(self, node: Node) -> Report:
        """Return the next report.

        Raises:
            RuntimeError: the node ended, or takes too long.
        """
        self._reports.clear()
        deadline_s = time.monotonic() + START_TIMEOUT_S
        while not self._reports:
            if node.process.poll() is not None or time.monotonic() > deadline_s:
                raise RuntimeError('the node does not answer')
            self._rclpy.spin_once(self._node, timeout_sec=0.1)
        return self._reports[-1]

    def run(self, node: Node, phase: Phase, scene: Repeated, warm_up_s: float, measured_s: float) -> None:
        """Publish a scene at its pace, and fill the phase in."""
        before = self.wait_for_a_report(node)
        publisher = self._connect(phase.encoding)
        packets = round((warm_up_s + measured_s) * NS_PER_S / PACKET_NS)
        began_processor_s, began_own_s = node.processor_s(), time.process_time()
        began_s = time.monotonic()
        for k, message in zip(range(packets), scene, strict=False):
            due_s = began_s + k * PACKET_NS / NS_PER_S
            if k % LISTENING_PACKETS == 0:
                self._rclpy.spin_once(self._node, timeout_sec=0.0)
            if (early_s := due_s - time.monotonic()) > 0.0:
                time.sleep(early_s)
            phase.late_ms = max(phase.late_ms, (time.monotonic() - due_s) * 1e3)
            publisher.publish(message)
        ended_s = time.monotonic()
        seconds = max(ended_s - began_s, packets * PACKET_NS / NS_PER_S)
        phase.packets = packets
        events = scene.events[np.arange(packets) % len(scene.events)].sum()
        phase.offered_mev_per_s = float(events) / seconds / 1e6
        phase.node_cores = (node.processor_s() - began_processor_s) / seconds
        phase.publisher_cores = (time.process_time() - began_own_s) / seconds
        self._settle(before, packets)
        self._sum_up(phase, before, began_s + warm_up_s, ended_s)
        self._node.destroy_publisher(publisher)

    def _connect(self, encoding: str) -> Any:
        """Return a publisher that the node listens to."""
        from rclpy.qos import QoSProfile, ReliabilityPolicy

        if encoding == 'evt3':
            from event_camera_msgs.msg import EventPacket as Message
        else:
            from dvs_msgs.msg import EventArray as Message
        publisher = self._node.create_publisher(
            Message, TOPIC, QoSProfile(depth=1000, reliability=ReliabilityPolicy.BEST_EFFORT)
        )
        deadline_s = time.monotonic() + CONNECT_TIMEOUT_S
        while not publisher.get_subscription_count():
            if time.monotonic() > deadline_s:
                raise RuntimeError(f'the node does not read {encoding}')
            self.listen(0.1)
        self.listen(CONNECTED_S)  # the other side is to know of it, too
        return publisher

    def _settle(self, before: Report, packets: int) -> None:
        """Wait until all that arrived has been counted."""
        deadline_s = time.monotonic() + SETTLED_S
        while time.monotonic() < deadline_s:
            self.listen(0.1)
            if self._reports[-1].count('packets') - before.count('packets') >= packets:
                return

    def _sum_up(self, phase: Phase, before: Report, warm_s: float, ended_s: float) -> None:
        """Take from the reports what the phase tells."""
        last = self._reports[-1]
        phase.missing = phase.packets - (last.count('packets') - before.count('packets'))
        first = next((report for report in self._reports if report.at_s >= warm_s), last)
        after = [report for report in self._reports if report.at_s > first.at_s]
        phase.shed = last.count('shed_packets') - first.count('shed_packets')
        phase.measured = last.count('packets') - first.count('packets')
        phase.lag_ms = max((float(report.values['lag_s']) * 1e3 for report in after), default=0.0)
        during = [report for report in after if report.at_s <= ended_s] or [last]
        phase.events_mev_per_s = float(np.median([float(report.values['events_per_s']) for report in during])) / 1e6
        values = during[-1].values
        phase.latency_characters = int(values['character_latency_characters'])
        if phase.latency_characters:
            phase.latency_p50_ms = float(values['character_latency_p50_ms'])
            phase.latency_p99_ms = float(values['character_latency_p99_ms'])
        phase.confirmed = len(values['confirmed'].split())


def main() -> None:
    """Measure in an environment that :func:`measure` has made."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('--folder', type=Path, required=True, help='folder of the recordings')
    parser.add_argument('--json', type=Path, required=True, help='where the phases go')
    parser.add_argument('--rates', type=float, nargs='*', default=[], help='of EventPackets (million events a second)')
    parser.add_argument('--array-rates', type=float, nargs='*', default=[], help='of EventArrays (million events a second)')
    parser.add_argument('--warm-up', type=float, default=WARM_UP_S, help='first part of a phase (s)')
    parser.add_argument('--seconds', type=float, default=MEASURED_S, help='second part of a phase (s)')
    arguments = parser.parse_args()
    asked = dict(zip(ENCODINGS, (arguments.rates, arguments.array_rates), strict=True))
    phases = []
    with Node(arguments.json.parent) as node:
        driver = Driver()
        driver.wait_for_a_report(node)
        for rate in sorted({rate for rates in asked.values() for rate in rates}):
            stream = make_stream(arguments.folder, SIZE, rate * 1e6, LOOP_NS / NS_PER_S, packet_ns=PACKET_NS, repeatable=True)
            for encoding in (encoding for encoding, rates in asked.items() if rate in rates):
                phase = Phase(encoding, rate, stream.events / stream.seconds / 1e6)
                driver.run(node, phase, Repeated(stream, encoding), arguments.warm_up, arguments.seconds)
                phases.append(phase)
    arguments.json.write_text(json.dumps([asdict(phase) for phase in phases]))


if __name__ == '__main__':
    main()
