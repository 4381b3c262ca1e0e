"""The node as a process of its own, over DDS: event packets in, characters, texts, bearings and reasons out."""

from __future__ import annotations

import signal
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

rclpy = pytest.importorskip('rclpy')
messages = pytest.importorskip('beacon_comm.msg')
EventPacket = pytest.importorskip('event_camera_msgs.msg').EventPacket

import node_process  # noqa: E402
from diagnostic_msgs.msg import DiagnosticArray  # noqa: E402
from live_session import pixel_events  # noqa: E402
from node_process import DOMAIN, START_TIMEOUT_S, NodeProcess, Peer  # noqa: E402
from rclpy.qos import ReliabilityPolicy  # noqa: E402
from sensor_msgs.msg import CameraInfo  # noqa: E402

from beacon_comm.core.character import Status  # noqa: E402
from beacon_comm.core.events import NS_PER_S, EventBatch  # noqa: E402
from beacon_comm.wire.cdr import build_event_packet  # noqa: E402
from beacon_comm.wire.evt3_encoder import Evt3Encoder  # noqa: E402

STAMP_NS = 1_700_000_000 * NS_PER_S
OFFSET_NS = STAMP_NS - NS_PER_S
"""ROS time less sensor time in what these tests publish."""
PACKET_NS = 5_000_000
SIZE = (64, 48)
BIT_RATE = 3125.0
TEXT = "Shall I compare thee to a summer's day?\n"


def beacon_events(text: str, start_ns: int, x_px: int, y_px: int) -> EventBatch:
    """Return the events of a beacon that covers a disc of pixels."""
    columns, rows = np.meshgrid(np.arange(-4, 5), np.arange(-4, 5))
    disc = columns**2 + rows**2 <= 16
    return pixel_events(text, start_ns, BIT_RATE, columns[disc] + x_px, rows[disc] + y_px)


def packets(events: EventBatch) -> list[bytes]:
    """Cut events into packets as a driver sends them; every stamp belongs to its packet's first event."""
    encoder = Evt3Encoder(*SIZE)
    first_ns = int(events.t_ns[0])
    cuts = np.searchsorted(events.t_ns, np.arange(first_ns, events.t_end_ns + PACKET_NS, PACKET_NS))
    cuts[-1] = len(events)
    messages_out = []
    for start, stop in zip(cuts[:-1], cuts[1:], strict=True):
        if start == stop:
            continue
        part = events.slice(int(start), int(stop), int(events.t_ns[stop - 1]))
        messages_out.append(
            build_event_packet(
                stamp_ns=int(part.t_ns[0]) + OFFSET_NS,
                frame_id='event_camera', width=SIZE[0], height=SIZE[1], seq=len(messages_out), time_base_ns=0,
                encoding='evt3', payload=encoder.encode(part),
            )
        )
    return messages_out


def publish(peer: Peer, stream: list[bytes]) -> None:
    """Publish packets at their own pace."""
    for message in stream:
        peer.publisher.publish(message)
        peer.spin_for(PACKET_NS / NS_PER_S)


def nanoseconds(stamp: Any) -> int:
    return int(stamp.sec) * NS_PER_S + int(stamp.nanosec)


@pytest.fixture(scope='module')
def domain() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv('ROS_AUTOMATIC_DISCOVERY_RANGE', 'LOCALHOST')
        patch.setenv('ROS_DOMAIN_ID', str(DOMAIN))
        yield


@pytest.fixture
def peer(domain: None) -> Iterator[Peer]:
    one = Peer('test_peer')
    yield one
    one.close()


@pytest.fixture
def late(domain: None) -> Iterator[Peer]:
    """A listener that has found the node, but subscribes later: discovery may take longer than a track lives."""
    one = Peer('test_late')
    yield one
    one.close()


@pytest.fixture(scope='module')
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp('node')


@pytest.fixture
def start(folder: Path) -> Iterator[Callable[..., NodeProcess]]:
    running: list[NodeProcess] = []

    def start_one(*arguments: str) -> NodeProcess:
        # Nothing is shed, however busy the machine is.
        running.append(NodeProcess(folder, *arguments, '-p', 'max_lag_s:=60.0'))
        return running[-1]

    yield start_one
    for node in running:
        node.kill()


OUTPUTS = {
    '/beacon_node/characters': 'Characters', '/beacon_node/text': 'Text', '/beacon_node/beacons': 'Beacons',
    '/beacon_node/bearings': 'Bearings',
}


def connect(peer: Peer, node: NodeProcess) -> None:
    """Listen to every output, publish on the event topic, and wait until the node reads it."""
    for topic, kind in OUTPUTS.items():
        peer.listen(topic, getattr(messages, kind))
    peer.listen('/beacon_node/confirmed', messages.Confirmed, latched=True)
    peer.listen('/diagnostics', DiagnosticArray)
    node.wait_for('waiting for events on /camera/events')
    peer.advertise(EventPacket, '/camera/events', ReliabilityPolicy.BEST_EFFORT)
    assert peer.spin_until(peer.publisher.get_subscription_count), node.output()
    assert peer.spin_until(
        lambda: all(peer.node.count_publishers(topic) for topic in OUTPUTS) and peer.heard['/beacon_node/confirmed']
    )


def characters(peer: Peer) -> list[Any]:
    return [character for message in peer.heard['/beacon_node/characters'] for character in message.characters]


def status(peer: Peer) -> Any:
    return peer.heard['/diagnostics'][-1].status[0]


def values(peer: Peer) -> dict[str, str]:
    return {entry.key: entry.value for entry in status(peer).values}


def test_a_beacon_is_read_confirmed_and_its_last_character_comes_out(
    peer: Peer, late: Peer, start: Callable[..., NodeProcess]
) -> None:
    node = start(
        '-r', 'events:=/camera/events', '-p', 'bit_rates:=[3125]', '-p', 'publish_rate_hz:=20', '-p', 'lost_after_s:=4'
    )
    connect(peer, node)
    assert late.spin_until(lambda: late.node.count_publishers('/beacon_node/confirmed'))
    assert list(peer.heard['/beacon_node/confirmed'][0].track_ids) == []
    sent = 6 * TEXT
    stream = packets(beacon_events(sent, NS_PER_S, 30, 20))
    publish(peer, stream)
    # No packet follows: the last character needs the silent topic's clock.
    peer.spin_until(lambda: characters(peer) and characters(peer)[-1].code == ord('\n'))
    read = ''.join(chr(character.code) for character in characters(peer))
    assert sent.endswith(read) and len(read) > len(sent) - 20, (read, node.output())

    (track_id,) = {character.track_id for character in characters(peer)}
    assert peer.spin_until(lambda: list(peer.heard['/beacon_node/confirmed'][-1].track_ids) == [track_id])
    assert peer.spin_until(lambda: peer.heard['/beacon_node/text'][-1].text.endswith(r'day?\n'))
    text = peer.heard['/beacon_node/text'][-1]
    assert bytes(text.codes).decode() == read and text.first_index == 0 and text.track_id == track_id

    assert peer.spin_until(lambda: any(message.bearings for message in peer.heard['/beacon_node/bearings']))
    bearing = next(message for message in peer.heard['/beacon_node/bearings'] if message.bearings).bearings[0]
    assert (bearing.x_px, bearing.y_px) == pytest.approx((30.0, 20.0), abs=1.0)
    assert not bearing.has_bearing and bearing.covariance[0] == -1.0
    beacon = peer.heard['/beacon_node/beacons'][-1].beacons[0]
    assert beacon.state == beacon.CONFIRMED and beacon.bit_rate_bps == pytest.approx(BIT_RATE, rel=0.01)

    check_times(peer)
    check_the_latency_is_told(peer)
    check_a_late_listener_hears_what_is_confirmed(late, track_id)
    check_garbage_is_counted(peer, node)
    check_a_track_is_lost_once(peer, track_id)
    check_another_driver_is_read(peer, track_id, stream)

    node.process.send_signal(signal.SIGINT)
    assert node.exit_code() == 0, node.output()
    assert 'Traceback' not in node.output()


def check_times(peer: Peer) -> None:
    """Stamps are ROS time of the observation, the frame is the input's, and time never runs backwards."""
    for character in characters(peer):
        assert nanoseconds(character.stamp) - character.sensor_time_ns == pytest.approx(OFFSET_NS, abs=1000)
        assert 0.0 <= character.confidence <= 1.0 and character.status in set(Status)
    for topic in OUTPUTS:
        heard = peer.heard[topic]
        assert {message.header.frame_id for message in heard} == {'event_camera'}, topic
        stamps = [nanoseconds(message.header.stamp) for message in heard]
        assert stamps == sorted(stamps), topic
        for message in heard:
            difference_ns = nanoseconds(message.header.stamp) - message.sensor_time_ns
            assert difference_ns == pytest.approx(OFFSET_NS, abs=1000)


def check_the_latency_is_told(peer: Peer) -> None:
    """The node measures how long after they were due its characters were out: of those that it did not read back."""
    heard = [{entry.key: entry.value for entry in message.status[0].values} for message in peer.heard['/diagnostics']]
    told = [report for report in heard if report['character_latency_characters'] != '0']
    assert told
    for report in told:
        assert 0 < int(report['character_latency_characters']) <= len(characters(peer))
        assert 0.0 <= float(report['character_latency_p50_ms']) <= float(report['character_latency_p99_ms'])


def check_a_late_listener_hears_what_is_confirmed(late: Peer, track_id: int) -> None:
    late.listen('/beacon_node/confirmed', messages.Confirmed, latched=True)
    assert late.spin_until(lambda: late.heard['/beacon_node/confirmed'])
    assert list(late.heard['/beacon_node/confirmed'][0].track_ids) == [track_id]


def check_garbage_is_counted(peer: Peer, node: NodeProcess) -> None:
    random = np.random.default_rng(1)
    good = packets(beacon_events('x', NS_PER_S, 30, 20))[0]
    garbage = [b'\x00\x01\x00\x00' + random.bytes(n) for n in (1, 20, 300)] + [good[: len(good) // 2], good[:40]]
    other = build_event_packet(
        stamp_ns=STAMP_NS, frame_id='other_camera', width=64, height=48, seq=0, time_base_ns=0, encoding='evt3',
        payload=b'',
    )
    for message in [*garbage, other]:
        peer.publisher.publish(message)
        peer.spin_for(0.01)
    assert peer.spin_until(lambda: values(peer).get('refused_frames') == '1'), status(peer)
    assert int(values(peer)['bad_messages']) == len(garbage)
    assert 'other_camera' in node.output()


def check_a_track_is_lost_once(peer: Peer, track_id: int) -> None:
    """After lost_after_s of silence the track is published as lost, once, and nothing is confirmed any more."""
    assert peer.spin_until(lambda: list(peer.heard['/beacon_node/confirmed'][-1].track_ids) == [])
    peer.spin_for(0.2)
    states = [
        beacon.state for message in peer.heard['/beacon_node/beacons'] for beacon in message.beacons
        if beacon.track_id == track_id
    ]
    assert states.count(messages.Beacon.LOST) == 1 and states[-1] == messages.Beacon.LOST


def check_another_driver_is_read(peer: Peer, track_id: int, stream: list[bytes]) -> None:
    """The publisher goes, another one comes and begins its time anew: the same beacon under a new label."""
    peer.node.destroy_publisher(peer.publisher)
    peer.advertise(EventPacket, '/camera/events', ReliabilityPolicy.BEST_EFFORT)
    assert peer.spin_until(peer.publisher.get_subscription_count)
    before = len(characters(peer))
    publish(peer, stream[:60])
    assert peer.spin_until(lambda: len(characters(peer)) > before + 40)
    assert min(character.track_id for character in characters(peer)[before:]) > track_id


def test_a_text_that_grew_while_nobody_listened_is_published_to_who_comes(
    peer: Peer, start: Callable[..., NodeProcess]
) -> None:
    node = start('-r', 'events:=/camera/events', '-p', 'bit_rates:=[3125]')
    peer.listen('/beacon_node/characters', messages.Characters)
    node.wait_for('waiting for events on /camera/events')
    peer.advertise(EventPacket, '/camera/events', ReliabilityPolicy.BEST_EFFORT)
    assert peer.spin_until(peer.publisher.get_subscription_count), node.output()
    assert peer.spin_until(lambda: peer.node.count_publishers('/beacon_node/characters'))
    publish(peer, packets(beacon_events(6 * TEXT, NS_PER_S, 30, 20)))
    assert peer.spin_until(lambda: characters(peer) and characters(peer)[-1].code == ord('\n'))
    peer.listen('/beacon_node/text', messages.Text)
    assert peer.spin_until(lambda: peer.heard['/beacon_node/text'])
    assert peer.heard['/beacon_node/text'][0].text.endswith(r'day?\n')


def test_reasons_of_every_severity_are_logged_and_the_node_goes_on(
    peer: Peer, start: Callable[..., NodeProcess]
) -> None:
    """A warning (no publisher), then an information (nothing above the threshold)."""
    node = start('-r', 'events:=/camera/events', '-p', 'index_threshold:=50.0', '-p', 'bit_rates:=[3125]')
    node.wait_for('no publisher on /camera/events')
    peer.advertise(EventPacket, '/camera/events', ReliabilityPolicy.BEST_EFFORT)
    assert peer.spin_until(peer.publisher.get_subscription_count), node.output()

    def informed() -> bool:
        log = node.output().rsplit('reading /camera/events', 1)[-1]
        return '[INFO]' in log and 'index' in log

    for message in packets(beacon_events(60 * TEXT, NS_PER_S, 42, 24)):
        publish(peer, [message])
        if informed():
            break
    assert informed() and node.process.poll() is None, node.output()
    node.process.send_signal(signal.SIGINT)
    assert node.exit_code() == 0, node.output()


def test_silence_is_explained_and_a_calibration_gives_bearings(
    peer: Peer, start: Callable[..., NodeProcess]
) -> None:
    node = start(
        '-r', 'events:=/camera/events', '-p', 'qos_reliability:=reliable', '-p', 'use_camera_info:=true', '-p',
        'bit_rates:=[3125]', '-p', 'text_codes:=5',
    )
    peer.listen('/diagnostics', DiagnosticArray)
    peer.listen('/beacon_node/bearings', messages.Bearings)
    peer.listen('/beacon_node/text', messages.Text)
    other = peer.node.create_publisher(EventPacket, '/other/events', 1)
    assert peer.spin_until(
        lambda: peer.heard['/diagnostics'] and '/other/events' in status(peer).message, START_TIMEOUT_S
    ), node.output()
    assert status(peer).message.startswith('no publisher on /camera/events')
    peer.node.destroy_publisher(other)

    wrong = peer.node.create_publisher(CameraInfo, '/camera/events', 1)
    assert peer.spin_until(lambda: 'carries sensor_msgs/msg/CameraInfo' in status(peer).message), status(peer)
    peer.node.destroy_publisher(wrong)

    peer.advertise(EventPacket, '/camera/events', ReliabilityPolicy.BEST_EFFORT)
    assert peer.spin_until(lambda: 'QoS of /camera/events does not match' in status(peer).message), status(peer)
    peer.node.destroy_publisher(peer.publisher)

    peer.advertise(EventPacket, '/camera/events', ReliabilityPolicy.RELIABLE)
    assert peer.spin_until(lambda: 'no messages come' in status(peer).message), status(peer)

    info = CameraInfo(width=64, height=48, distortion_model='plumb_bob', d=[0.0] * 5)
    info.k = [50.0, 0.0, 32.0, 0.0, 50.0, 24.0, 0.0, 0.0, 1.0]
    calibration = peer.node.create_publisher(CameraInfo, 'camera_info', 1)

    def calibrated() -> bool:
        calibration.publish(info)  # again and again, as drivers do: nobody may be there for the first
        return values(peer)['calibrated'] == 'True'

    assert peer.spin_until(calibrated), status(peer)
    publish(peer, packets(beacon_events(2 * TEXT, NS_PER_S, 42, 24)))
    assert peer.spin_until(lambda: any(message.bearings for message in peer.heard['/beacon_node/bearings']))
    bearing = next(message for message in peer.heard['/beacon_node/bearings'] if message.bearings).bearings[0]
    assert bearing.has_bearing and bearing.azimuth_rad == pytest.approx(np.arctan(10.0 / 50.0), abs=0.02)
    assert peer.spin_until(lambda: 'beacons confirmed' in status(peer).message), status(peer)
    text = peer.heard['/beacon_node/text'][-1]
    assert len(text.codes) == 5 and text.first_index > 20

    node.process.send_signal(signal.SIGINT)
    node.process.send_signal(signal.SIGINT)
    assert node.exit_code() == 0, node.output()
    assert 'Traceback' not in node.output()


ENDINGS = [(signal.SIGTERM,), (signal.SIGINT, signal.SIGINT, signal.SIGTERM)]


def test_it_ends_cleanly_however_it_is_told(start: Callable[..., NodeProcess]) -> None:
    nodes = [start() for _ in ENDINGS]
    for node in nodes:
        node.wait_for('waiting for events on /events')
    for node, signals in zip(nodes, ENDINGS, strict=True):
        for number in signals:
            node.process.send_signal(number)
            time.sleep(0.05)
    for node in nodes:
        assert node.exit_code() == 0, node.output()
        assert 'Traceback' not in node.output()


REFUSALS = [
    (['-p', 'index_threshold:=-1.0'], 'index_threshold = -1.0: must lie in [0, ∞]'),
    (['-p', 'bit_rates:=[504.0, 19.0]'], 'bit_rates = 19.0: must lie in [20, 10000] bps'),
    (['-p', 'camera_info_file:=/no/such/file.yaml'], '/no/such/file.yaml'),
]


def test_it_starts_without_a_folder_for_logs(
    folder: Path, monkeypatch: pytest.MonkeyPatch, start: Callable[..., NodeProcess]
) -> None:
    """A robot whose disk is read-only, and a user without a home."""
    without = {**node_process.environment(folder), 'HOME': '/proc/nowhere'}
    del without['ROS_LOG_DIR']
    monkeypatch.setattr(node_process, 'environment', lambda _: without)
    node = start()
    node.wait_for('waiting for events on')
    assert '/proc/nowhere/.ros/log cannot be written' in node.output()
    node.process.send_signal(signal.SIGINT)
    assert node.exit_code() == 0, node.output()


def test_a_wrong_value_is_refused_in_one_line(start: Callable[..., NodeProcess]) -> None:
    nodes = [start(*arguments) for arguments, _ in REFUSALS]
    for node, (_, line) in zip(nodes, REFUSALS, strict=True):
        assert node.exit_code(START_TIMEOUT_S) == 2, node.output()
        (written,) = [text for text in node.output().splitlines() if text.strip()]
        assert line in written
