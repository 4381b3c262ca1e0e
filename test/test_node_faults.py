"""The node over DDS through a robot's day: simulated time that jumps, too much at once, drivers that come and go."""

from __future__ import annotations

import signal
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

rclpy = pytest.importorskip('rclpy')
messages = pytest.importorskip('beacon_comm.msg')
EventPacket = pytest.importorskip('event_camera_msgs.msg').EventPacket

from diagnostic_msgs.msg import DiagnosticArray  # noqa: E402
from live_session import MS, PACKET_NS, STAMP_NS, START_NS, TEXT, beacon_events, packets  # noqa: E402
from node_process import DOMAIN, NodeProcess, Peer  # noqa: E402
from rclpy.qos import ReliabilityPolicy  # noqa: E402
from rosgraph_msgs.msg import Clock  # noqa: E402
from sensor_msgs.msg import CameraInfo  # noqa: E402

from beacon_comm.core.events import NS_PER_S  # noqa: E402
from beacon_comm.simulation.led import sensor_noise  # noqa: E402
from beacon_comm.wire.cdr import build_event_packet  # noqa: E402
from beacon_comm.wire.evt3_encoder import Evt3Encoder  # noqa: E402

TOPIC = '/camera/events'
BURST = 400
BURST_EVENTS_PER_S = 5e6


@pytest.fixture
def peer(monkeypatch: pytest.MonkeyPatch) -> Iterator[Peer]:
    monkeypatch.setenv('ROS_AUTOMATIC_DISCOVERY_RANGE', 'LOCALHOST')
    monkeypatch.setenv('ROS_DOMAIN_ID', str(DOMAIN))
    one = Peer('test_faults')
    yield one
    one.close()


@pytest.fixture
def node(tmp_path: Path) -> Iterator[NodeProcess]:
    one = NodeProcess(
        tmp_path, '-r', f'events:={TOPIC}', '-p', 'bit_rates:=[3125]', '-p', 'rate_search:=listed', '-p', 'use_sim_time:=true'
    )
    yield one
    one.kill()


class Day:
    """Everything that is published, and what is heard of it."""

    def __init__(self, peer: Peer) -> None:
        self.peer = peer
        self._clock = peer.node.create_publisher(Clock, '/clock', 10)
        self.now_ns = STAMP_NS
        peer.listen('/beacon_node/characters', messages.Characters)
        peer.listen('/diagnostics', DiagnosticArray)

    def publish(self, stream: list[bytes]) -> None:
        """Publish packets and the time, at their pace."""
        for message in stream:
            self.tick(PACKET_NS)
            self.peer.publisher.publish(message)
            self.peer.spin_for(PACKET_NS / NS_PER_S)

    def tick(self, step_ns: int) -> None:
        self.now_ns += step_ns
        clock = Clock()
        clock.clock.sec, clock.clock.nanosec = divmod(self.now_ns, NS_PER_S)
        self._clock.publish(clock)

    def passing(self, condition: Callable[[], bool]) -> Callable[[], bool]:
        """Return a condition that lets time pass, or no track would ever be lost."""

        def passed() -> bool:
            self.tick(20 * MS)
            return condition()

        return passed

    def text(self) -> str:
        heard = self.peer.heard['/beacon_node/characters']
        return ''.join(chr(character.code) for message in heard for character in message.characters)

    def reads(self, text: str, before: int = 0) -> bool:
        return self.peer.spin_until(lambda: text in self.text()[before:])

    def status(self) -> Any:
        return self.peer.heard['/diagnostics'][-1].status[0]

    def count(self, kind: str) -> int:
        if not self.peer.heard['/diagnostics']:
            return 0
        return next((int(entry.value) for entry in self.status().values if entry.key == kind), 0)


def burst(first_seq: int, start_ns: int) -> list[bytes]:
    """Return packets of noise that are many times what the node can do, if they come at once."""
    encoder = Evt3Encoder(64, 48)
    noise = sensor_noise(BURST_EVENTS_PER_S, BURST * PACKET_NS / NS_PER_S, 64, 48, t0_ns=start_ns)
    made = []
    for k in range(BURST):
        begin_ns = start_ns + k * PACKET_NS
        first, stop = np.searchsorted(noise.t_ns, [begin_ns, begin_ns + PACKET_NS])
        payload = encoder.encode(noise.slice(int(first), int(stop), begin_ns + PACKET_NS - 1000))
        made.append(build_event_packet(begin_ns + STAMP_NS - START_NS, 'cam', 64, 48, first_seq + k, 0, 'evt3', payload))
    return made


def begun(peer: Peer, node: NodeProcess) -> Day:
    """Return a day on which both hear one another."""
    day = Day(peer)
    node.wait_for(f'waiting for events on {TOPIC}')
    peer.advertise(EventPacket, TOPIC, ReliabilityPolicy.BEST_EFFORT)
    assert peer.spin_until(peer.publisher.get_subscription_count), node.output()
    assert peer.spin_until(lambda: peer.node.count_publishers('/beacon_node/characters'))
    return day


def test_a_day_of_faults(peer: Peer, node: NodeProcess) -> None:
    day = begun(peer, node)
    stream = packets(beacon_events(12 * TEXT))
    part = len(stream) // 4

    # Simulated time jumps back, ahead, and not at all.
    day.publish(stream[: part // 3])
    for k, jump_s in enumerate((-100, 1000, 0)):
        day.tick(jump_s * NS_PER_S)
        begin = part // 3 * (1 + k)
        before = len(day.text())
        day.publish(stream[begin : begin + part // 3])
        assert day.reads("compare thee to a summer's day", before), (day.text(), node.output())
    read = 4 * (part // 3)

    # Far too much at once: most of it is shed, and the beacon is read again behind it.
    start_ns = START_NS + read * PACKET_NS
    for message in burst(read, start_ns):
        day.peer.publisher.publish(message)
    assert peer.spin_until(lambda: day.count('shed_packets') > 0), (day.status(), node.output())
    assert peer.spin_until(lambda: any(m.status[0].message.startswith('overloaded') for m in peer.heard['/diagnostics']))
    assert 'overloaded' in node.output()
    shed = day.count('shed_packets')
    before = len(day.text())
    events = beacon_events(4 * TEXT, start_ns + (BURST + 2) * PACKET_NS)
    day.publish(packets(events, first_seq=read + BURST))
    assert day.reads("compare thee to a summer's day?\nShall I", before), (day.text(), node.output())
    assert day.count('restarts') == 0 and shed < day.count('packets')

    # The driver goes, another type comes and goes, a driver comes again with a clock of its own.
    peer.node.destroy_publisher(peer.publisher)
    other = peer.node.create_publisher(CameraInfo, TOPIC, 1)
    assert peer.spin_until(day.passing(lambda: 'carries sensor_msgs/msg/CameraInfo' in day.status().message)), day.status()
    peer.node.destroy_publisher(other)
    peer.advertise(EventPacket, TOPIC, ReliabilityPolicy.BEST_EFFORT)
    assert peer.spin_until(peer.publisher.get_subscription_count)
    before = len(day.text())
    day.publish(stream[: part // 2])
    assert day.reads("to a summer's day", before), (day.text(), node.output())

    node.process.send_signal(signal.SIGINT)
    assert node.exit_code() == 0, node.output()
    assert 'Traceback' not in node.output()
    assert day.count('internal_errors') == 0


def test_a_clock_of_negative_time_ends_no_node(peer: Peer, node: NodeProcess) -> None:
    day = begun(peer, node)
    stream = packets(beacon_events(2 * TEXT))
    day.publish(stream[:20])
    day.tick(-day.now_ns - 5 * NS_PER_S)
    assert peer.spin_until(lambda: day.count('internal_errors') > 0), node.output()
    day.tick(STAMP_NS - day.now_ns)
    before = len(day.text())
    day.publish(stream[20:])
    assert day.reads("to a summer's day", before), (day.text(), node.output())
    node.process.send_signal(signal.SIGINT)
    assert node.exit_code() == 0, node.output()
