"""``beacon_replay``: what it writes, what it publishes over DDS from a process of its own, and how it ends."""

import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.io import savemat

from beacon_comm.cli.replay import main
from beacon_comm.cli.replaying import bag_messages
from beacon_comm.core.events import NS_PER_S
from beacon_comm.recordings.bag_writer import BagWriter
from beacon_comm.recordings.bags import open_recording
from beacon_comm.recordings.interfaces import PACKET_TYPE
from beacon_comm.recordings.truth import read_truth
from beacon_comm.simulation.led import noise
from beacon_comm.wire.cdr import build_event_packet, parse_event_packet
from beacon_comm.wire.stream import EventStream

PROJECT = Path(__file__).resolve().parents[1]
TOPIC = '/event_camera/events'
BOUND_S = 60.0


@pytest.fixture
def mat(tmp_path: Path) -> Path:
    t_ns, polarity = noise(20_000.0, 0.4, seed=1)
    savemat(tmp_path / 'one.mat', {'event': polarity[None].astype(np.int16), 'event_t': t_ns[None] / 1e9})
    return tmp_path / 'one.mat'


@pytest.fixture
def bag(tmp_path: Path) -> Path:
    """A bag of 100 messages, 5 ms apart."""
    with BagWriter(tmp_path / 'bag') as writer:
        writer.add_topic(TOPIC, PACKET_TYPE)
        for k in range(100):
            cdr = build_event_packet(k * 5_000_000, 'camera', 64, 48, k, 0, 'evt3', bytes([k, 0x80]))
            writer.write(TOPIC, NS_PER_S + k * 5_000_000, cdr)
    return tmp_path / 'bag'


def messages(path: Path) -> list[tuple[int, bytes]]:
    with open_recording(path) as opened:
        return list(opened.messages(opened.event_topic()))


def test_a_bag_is_written_unchanged(bag: Path, tmp_path: Path) -> None:
    assert main([str(bag), '--write', str(tmp_path / 'out')]) == 0
    assert messages(tmp_path / 'out') == messages(bag)
    assert not (tmp_path / 'out' / 'truth.json').exists()
    assert main([str(bag), '--write', str(tmp_path / 'part'), '--start', '0.1', '--duration', '0.2']) == 0
    assert messages(tmp_path / 'part') == messages(bag)[20:60]


def test_a_damaged_bag_is_written_as_far_as_it_goes(
    bag: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    whole = messages(bag)
    (bag / 'metadata.yaml').unlink()
    content = (bag / 'bag.mcap').read_bytes()
    (bag / 'bag_2.mcap').write_bytes(content[: len(content) // 2])  # what a recorder that was killed leaves
    assert main([str(bag), '--write', str(tmp_path / 'out')]) == 2
    assert 'bag_2.mcap: the file ends' in capsys.readouterr().err
    assert messages(tmp_path / 'out') == whole


def test_a_scene_is_written_with_its_truth(mat: Path, bag: Path, tmp_path: Path) -> None:
    out = tmp_path / 'out'
    command = [str(mat), str(mat), '--disc', '20,20,4,50,0', '--disc', '40,30', '--clip', '0.1,0.2', '--sensor', '64x48']
    assert main([*command, '--write', str(out), '--seed', '3', '--frame-id', 'front']) == 0
    truth = read_truth(out)
    assert [b.name for b in truth.beacons] == ['one.mat', 'one.mat']
    assert truth.beacons[0].centre(100_000_000) == (25.0, 20.0) and truth.beacons[0].shown_ns[1] == 200_000_000
    assert truth.beacons[1].shown_ns[1] / NS_PER_S == truth.duration_s == pytest.approx(0.4, abs=1e-3)
    stream = EventStream(PACKET_TYPE)
    events = [stream.push(cdr).batch for _, cdr in messages(out)]
    assert sum(len(batch) for batch in events if batch is not None) == sum(b.events for b in truth.beacons)
    assert parse_event_packet(messages(out)[0][1]).frame_id == 'front'
    # The same by default places, over the written scene as background.
    over = tmp_path / 'over'
    assert main([str(mat), '--background', str(out), '--duration', '1', '--write', str(over)]) == 0
    stream = EventStream(PACKET_TYPE)
    times = np.concatenate([batch.t_ns for _, cdr in messages(over) if (batch := stream.push(cdr).batch) is not None])
    assert np.all(np.diff(times) >= 0) and times[-1] > 0.99 * NS_PER_S
    assert (read_truth(over).beacons[0].centre(0)[0], read_truth(over).width) == (32, 64)


@pytest.mark.parametrize(
    ('arguments', 'reason'),
    [
        (['absent'], 'absent: no such file or folder'),
        (['absent.mat'], 'absent.mat: no such file'),
        (['{bag}', '--disc', '1,1'], '--disc is for .mat recordings'),
        (['{bag}', '--frame-id', 'a'], '--frame-id is for .mat recordings'),
        (['{bag}', '{bag}'], 'one bag at a time'),
        (['{bag}', '{mat}'], 'give the bag as --background'),
        (['{bag}', '--topic', '/other'], 'no event topic /other (the bag holds /event_camera/events'),
        (['{mat}', '--disc', '1,1', '--disc', '2,2'], 'more --disc or --clip than the 1 recordings'),
        (['{mat}', '--disc', '900,10'], 'x must lie in [4, 635] px'),
        (['{mat}', '--clip', '9'], 'no events in the clip from 9 s'),
        (['{mat}', '--sensor', 'big'], "argument --sensor: 'big': must be like 640x480"),
        (['{mat}', '--sensor', '0x0'], '--sensor 0x0: must be from 1x1 to 2048x2048'),
        (['{mat}', '--sensor', '640x5000'], '--sensor 640x5000: must be from 1x1'),
        (['{mat}', '--sensor', '8x8'], 'does not fit on the 8×8 sensor'),
        (['{bag}', '--start', '100'], 'bag: nothing in the part asked for, from 100 s on'),
        (['{bag}', '--start', '100', '--write', '{bag}/out'], 'bag: nothing in the part asked for, from 100 s on'),
        (['{mat}', '--start', '100'], 'one.mat: nothing in the part asked for, from 100 s on'),
        (['{mat}', '--rate', '-1'], '--rate -1: must be 0 or more'),
        (['{mat}', '--duration', '0'], '--duration 0: must be above 0'),
        (['{mat}', '--duration', '1e300'], '--duration 1e+300: must be above 0, at most 1e+09'),
        (['{mat}', '--start', '1e300'], '--start 1e+300: must be 0 or more, at most 1e+09'),
        (['{mat}', '--clip', '0,1e300'], 'clip duration 1e+300: must be above 0 s, at most a day'),
        (['{mat}', '--clip', '0,0.05,100000000000'], 'clip count 100000000000: more than a day'),
        (['{mat}', '--seed', '-1'], '--seed -1: must be 0 or more'),
        (['{mat}', '--write', 'x', '--loop'], '--write with --loop would never end'),
        (['{bag}', '--write', '{bag}'], 'exists already, nothing is overwritten'),
        (['{mat}', '--rate', 'fast'], 'argument --rate'),
        ([], 'the following arguments are required: RECORDING'),
    ],
)
def test_errors_are_one_line_and_exit_code_2(
    arguments: list[str], reason: str, bag: Path, mat: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    try:
        code = main([argument.format(bag=bag, mat=mat) for argument in arguments])
    except SystemExit as leaving:
        code = leaving.code
    printed = capsys.readouterr()
    assert code == 2
    assert reason in printed.err and printed.err.count('\n') == 1 and printed.out == ''


def test_the_help_tells_of_remapping_and_of_a_scenes_time(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        main(['--help'])
    printed = capsys.readouterr().out
    assert '--ros-args -r' in printed and '1.7e9 s' in printed


def test_a_looped_bag_is_paced_on_from_its_end(bag: Path) -> None:
    with open_recording(bag) as opened:
        paced = list(islice(bag_messages(opened, opened.event_topic(), 0.1, 0.2, loop=True), 100))
    assert np.all(np.diff([message.pace_ns for message in paced]) == 5_000_000)
    assert [message.recorded_ns for message in paced[:40]] == [message.recorded_ns for message in paced[40:80]]
    assert [message.cdr for message in paced[40:80]] == [cdr for _, cdr in messages(bag)[20:60]]


# ---- over DDS, from a process of its own ---------------------------------------------------------------------


class Listener:
    """A best-effort subscriber in this process that collects raw messages."""

    def __init__(self, domain: int) -> None:
        import rclpy
        from rclpy.executors import SingleThreadedExecutor
        from rclpy.qos import QoSProfile, QoSReliabilityPolicy
        from rosgraph_msgs.msg import Clock

        self.received: list[tuple[float, bytes]] = []
        self.clock_ns: list[int] = []
        self._context = rclpy.Context()
        rclpy.init(context=self._context, domain_id=domain)
        self._node = rclpy.create_node('listener', context=self._context)
        best_effort = QoSProfile(depth=1000, reliability=QoSReliabilityPolicy.BEST_EFFORT)
        self._events = self._subscribe(best_effort)
        self._node.create_subscription(Clock, '/clock', self._take_clock, best_effort)
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self._node)

    def _subscribe(self, qos: Any) -> Any:
        from event_camera_msgs.msg import EventPacket

        return self._node.create_subscription(EventPacket, TOPIC, self._take, qos, raw=True)

    def insist(self) -> None:
        """Lose nothing from now on, of a publisher that is reliable."""
        from rclpy.qos import QoSProfile, QoSReliabilityPolicy

        self._node.destroy_subscription(self._events)
        self._events = self._subscribe(QoSProfile(depth=1000, reliability=QoSReliabilityPolicy.RELIABLE))

    def _take(self, raw: bytes) -> None:
        self.received.append((time.monotonic(), bytes(raw)))

    def _take_clock(self, message: Any) -> None:
        self.clock_ns.append(message.clock.sec * NS_PER_S + message.clock.nanosec)

    def spin_until(self, condition: Callable[[], bool]) -> None:
        deadline_s = time.monotonic() + BOUND_S
        while not condition():
            assert time.monotonic() < deadline_s, f'{len(self.received)} messages only within {BOUND_S:g} s'
            self._executor.spin_once(timeout_sec=0.05)

    def hear(self, count: int, replay: 'Replay') -> None:
        """Listen until ``count`` messages are there, or the replay has ended."""
        self.spin_until(lambda: len(self.received) >= count or replay.ended())
        heard = -1
        while heard < len(self.received) < count:  # what is on its way when the replay has ended
            heard, until_s = len(self.received), time.monotonic() + 0.5
            self.spin_until(lambda until_s=until_s: time.monotonic() > until_s)

    def close(self) -> None:
        self._executor.shutdown()
        self._node.destroy_node()
        self._context.try_shutdown()


@pytest.fixture
def domain(monkeypatch: pytest.MonkeyPatch) -> int:
    pytest.importorskip('rclpy')
    pytest.importorskip('event_camera_msgs')
    number = 1 + os.getpid() % 100
    monkeypatch.setenv('ROS_DOMAIN_ID', str(number))
    monkeypatch.setenv('ROS_AUTOMATIC_DISCOVERY_RANGE', 'LOCALHOST')
    monkeypatch.setenv('FASTRTPS_DEFAULT_PROFILES_FILE', str(PROJECT / 'config' / 'fastdds_shm.xml'))
    return number


@pytest.fixture
def listener(domain: int) -> Iterator[Listener]:
    listening = Listener(domain)
    yield listening
    listening.close()


class Replay:
    """``beacon_replay`` as a process; its stderr is read along."""

    def __init__(self, *arguments: object) -> None:
        self.process = subprocess.Popen(
            [sys.executable, '-m', 'beacon_comm.cli.replay', *map(str, arguments)],
            stderr=subprocess.PIPE,
            text=True,
        )
        self.printed: list[str] = []
        self._reader = threading.Thread(target=lambda: self.printed.extend(self.process.stderr or ()), daemon=True)
        self._reader.start()

    def ended(self) -> bool:
        return self.process.poll() is not None

    def end(self) -> tuple[int, str]:
        try:
            code = self.process.wait(BOUND_S)
        finally:
            self.process.kill()
            self.process.wait()
            self._reader.join()
        return code, ''.join(self.printed)


def padded(sent: list[tuple[int, bytes]]) -> list[bytes]:
    """Return messages as they arrive: DDS fills them up to a multiple of 4 bytes."""
    return [cdr + bytes(-len(cdr) % 4) for _, cdr in sent]


def test_a_bag_is_published_unchanged_at_its_pace(bag: Path, listener: Listener) -> None:
    replay = Replay(bag, '--clock', '--rate', '0.5')
    try:
        listener.hear(100, replay)
    finally:
        code, printed = replay.end()
    assert (code, printed) == (0, '')
    assert [cdr for _, cdr in listener.received] == padded(messages(bag))
    took_s = listener.received[-1][0] - listener.received[0][0]
    assert took_s == pytest.approx(0.99, abs=0.25)  # 99 steps of 5 ms at half speed
    assert listener.clock_ns == sorted(listener.clock_ns)
    assert listener.clock_ns[0] >= NS_PER_S and listener.clock_ns[-1] <= NS_PER_S + 99 * 5_000_000
    assert len(listener.clock_ns) >= 40


def test_a_scene_is_published_and_remapped(mat: Path, tmp_path: Path, listener: Listener) -> None:
    listener.insist()
    replay = Replay(mat, '--rate', '0', '--reliable', '--topic', '/elsewhere', '--ros-args', '-r', f'/elsewhere:={TOPIC}')
    try:
        listener.hear(100, replay)
    finally:
        code, printed = replay.end()
    assert (code, printed) == (0, '')
    assert main([str(mat), '--write', str(tmp_path / 'out')]) == 0
    assert [cdr for _, cdr in listener.received] == padded(messages(tmp_path / 'out'))


def test_loop_ends_with_ctrl_c(bag: Path, listener: Listener) -> None:
    replay = Replay(bag, '--loop', '--rate', '4', '--wait-subscribers', '20')
    try:
        listener.hear(251, replay)
        replay.process.send_signal(signal.SIGINT)
        replay.process.send_signal(signal.SIGINT)
    finally:
        code, printed = replay.end()
    assert (code, printed) == (0, '')


@pytest.mark.parametrize('write', [False, True])
def test_further_ctrl_c_cut_nothing_short(write: bool, bag: Path, mat: Path, tmp_path: Path, domain: int) -> None:
    out = tmp_path / 'out'
    command = [mat, '--duration', '1e6', '--write', out] if write else [bag, '--rate', '0.01', '--wait-subscribers', '0.01']

    def written() -> int:
        return sum(file.stat().st_size for file in out.glob('*.mcap'))

    replay = Replay(*command)
    try:
        deadline_s = time.monotonic() + BOUND_S
        while not (written() > 100_000 if write else replay.printed):
            assert time.monotonic() < deadline_s and not replay.ended()
            time.sleep(0.05)
        while not replay.ended():
            assert time.monotonic() < deadline_s
            replay.process.send_signal(signal.SIGINT)
            time.sleep(0.02)
    finally:
        code, printed = replay.end()
    assert code == 130
    assert 'Traceback' not in printed
    if write:
        assert f'{len(messages(out))} messages written' in printed


@pytest.mark.parametrize(
    ('arguments', 'reason'),
    [
        (['--topic', 'bad topic'], "topic 'bad topic': Invalid topic name: topic name must not contain"),
        (['--ros-args', '-r', 'bogus'], 'ROS does not start with --ros-args -r bogus: failed'),
        (['--ros-args', '--bogus'], 'ROS does not start with --ros-args --bogus: '),
    ],
)
def test_what_ros_refuses_is_one_line(arguments: list[str], reason: str, mat: Path, domain: int) -> None:
    code, printed = Replay(mat, *arguments).end()
    assert code == 2
    assert reason in printed and printed.count('\n') == 1


def test_without_a_subscriber_it_says_so_and_goes_on(bag: Path, domain: int) -> None:
    code, printed = Replay(bag, '--wait-subscribers', '0.2', '--rate', '0').end()
    assert code == 0
    assert printed == f'beacon_replay: no subscriber of {TOPIC} within 0.2 s; publishing all the same\n'


def test_a_type_without_its_package_is_refused(tmp_path: Path, domain: int) -> None:
    with BagWriter(tmp_path / 'dvs') as writer:
        writer.add_topic(TOPIC, 'dvs_msgs/msg/EventArray')
        writer.write(TOPIC, 1, b'\x00\x01\x00\x00' + bytes(24))
    code, printed = Replay(tmp_path / 'dvs').end()
    assert code == 2
    assert 'needs the ROS package dvs_msgs' in printed
    assert printed.count('\n') == 1
