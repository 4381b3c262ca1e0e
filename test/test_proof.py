"""The whole of it on real recordings: two beacons over real backgrounds, offline, and through DDS into the live node."""

from __future__ import annotations

import subprocess
import sys
from collections import defaultdict
from collections.abc import Iterable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest

from beacon_comm.core.bearing import CameraModel
from beacon_comm.core.events import NS_PER_S, EventBatch
from beacon_comm.core.parameters import Parameters
from beacon_comm.core.receiver import Receiver
from beacon_comm.recordings.disc import Disc
from beacon_comm.recordings.scene import Scene
from beacon_comm.recordings.sources import Background, Beacon, Clip, mat_beacon
from beacon_comm.wire.cdr import parse_event_packet
from beacon_comm.wire.stream import PACKET_TYPES, EventStream

FAST, SLOW = '3125hz_30m.mat', '504hz_30m.mat'
CALIBRATION = Path(__file__).resolve().parents[1] / 'config' / 'camera_example.yaml'
CHARACTER_NS = round(11 / 504.0 * NS_PER_S)
Row = tuple[int, int, int]
"""Sensor time of a character (ns), its code and its status."""


class Decoded(NamedTuple):
    """What a receiver made of a stream: by track, its characters and its path ``(t_ns, x_px, y_px)``."""

    characters: dict[int, list[Row]]
    paths: dict[int, list[tuple[int, float, float]]]
    confirmed: tuple[int, ...]

    def near(self, beacon: Beacon) -> int:
        """Return the one confirmed track on a beacon's path."""

        (found,) = [track_id for track_id in self.confirmed if rms_px(self.paths[track_id], beacon) < 3.0]
        return found


def beacons(folder: Path, width: int, height: int) -> tuple[Beacon, Beacon]:
    """The whole 3125 bps recording still, and the 504 bps one with its gap, moving at 50 px/s."""
    still = Disc(0.2 * width, 0.25 * height, 4.0, 0.0, 0.0, width, height)
    moving = Disc(0.3 * width, 0.6 * height, 4.0, 50.0, 0.0, width, height)
    return mat_beacon(folder / FAST, still), mat_beacon(folder / SLOW, moving, Clip(12.3, 5.0))


def decode(
    batches: Iterable[EventBatch], width: int, height: int, parameters: Parameters = Parameters()  # noqa: B008
) -> Decoded:
    receiver = Receiver(parameters, (width, height))
    characters: dict[int, list[Row]] = defaultdict(list)
    paths: dict[int, list[tuple[int, float, float]]] = defaultdict(list)
    ever_confirmed: set[int] = set()
    outputs = []
    for batch in batches:
        outputs.append(receiver.push(batch))
        ever_confirmed.update(receiver.confirmed)
        for beacon in receiver.beacons():
            if beacon.track_id in receiver.confirmed and not beacon.quiet:
                paths[beacon.track_id].append((beacon.t_ns, beacon.x_px, beacon.y_px))
    outputs.append(receiver.flush())
    for output in outputs:
        for received in output.characters:
            c = received.character
            characters[received.track_id].append((c.t_ns, c.code, int(c.status)))
    return Decoded(characters, paths, tuple(sorted(ever_confirmed)))


def read(decoded: Decoded, track_id: int) -> list[int]:
    """Return codes; times are left out, since an edge may shift by microseconds, and statuses: light beside it is doubt."""
    return [code for _, code, _ in decoded.characters[track_id]]


def rms_px(path: list[tuple[int, float, float]], beacon: Beacon) -> float:
    """Return the distance from the beacon's true path while it was sending (px, rms)."""
    t_ns, x, y = np.array([point for point in path if point[0] <= beacon.end_ns]).T
    centre_x, centre_y = beacon.disc.centre(t_ns / NS_PER_S)
    return float(np.sqrt(np.mean((x - centre_x) ** 2 + (y - centre_y) ** 2)))


@pytest.mark.parametrize(('name', 'share_that_may_differ'), [('evt3_static', 0.01), ('libcaer_grid', 0.01)])
def test_a_real_background_does_not_matter(name: str, share_that_may_differ: float, data_folder: Path) -> None:
    """The paper's claim, section IV: the characters equal those without background; the tracks follow the paths.

    Over the moving grid, whose edges run through both beacons, a character that was hard at 3125 bps may turn out
    otherwise, and a stray one may follow the end of a recording.
    """
    background = Background(data_folder / name)
    width, height = background.width, background.height
    both = beacons(data_folder, width, height)
    with_background = decode(Scene(both, width, height, background).batches(), width, height)
    without = decode(Scene(both, width, height).batches(), width, height)
    assert len(with_background.confirmed) == len(without.confirmed) == 2
    for beacon in both:
        track, alone = with_background.near(beacon), without.near(beacon)
        there, here = read(with_background, track), read(without, alone)
        differing = sum(a != b for a, b in zip(there, here, strict=False)) + abs(len(there) - len(here))
        assert differing <= share_that_may_differ * len(here)
        assert rms_px(with_background.paths[track], beacon) < 0.3


@pytest.mark.parametrize(
    ('name', 'events', 'on', 'off'),
    [
        ('evt3_static', 343_474, 125_183, 218_291),
        ('libcaer_grid', 571_266, 211_043, 360_223),
        ('evt3_trigger_hd', 82_469, None, None),
    ],
)
def test_a_background_alone_confirms_nothing(
    name: str, events: int, on: int | None, off: int | None, data_folder: Path
) -> None:
    """Lamp flicker and moving edges; and every event of the known counts is there."""
    background = Background(data_folder / name)
    counted = [0, 0]

    def one_pass_and_more() -> Iterable[EventBatch]:
        for batch, _, _ in background._one_pass():
            counted[0] += int(np.count_nonzero(batch.polarity > 0))
            counted[1] += int(np.count_nonzero(batch.polarity < 0))
        for batch in background.batches():
            if batch.t_end_ns > 4 * NS_PER_S:
                return
            yield batch

    decoded = decode(one_pass_and_more(), background.width, background.height)
    assert sum(counted) == events and (on is None or counted == [on, off])
    assert decoded.confirmed == ()


def packets_of(bag: Path) -> list[bytes]:
    from beacon_comm.recordings.bags import open_recording

    with open_recording(bag) as opened:
        return [cdr for _, cdr in opened.messages(opened.event_topic())]


def decode_packets(
    packets: list[bytes], width: int, height: int, parameters: Parameters = Parameters()  # noqa: B008  (immutable)
) -> Decoded:
    """Decode what the node gets, packet by packet, without ROS."""
    stream = EventStream(PACKET_TYPES[0])

    def batches() -> Iterable[EventBatch]:
        for packet in packets:
            batch = stream.push(packet).batch
            if batch is not None:
                yield batch

    return decode(batches(), width, height, parameters)


def live(bag: Path, folder: Path, rate: float, *parameters: str) -> tuple[Decoded, list[Any], dict[str, str]]:
    """Replay a bag through DDS into the node, each a process of its own; return what it published.

    Returns:
        Characters and bearings' paths by track; the bearings messages; the node's last diagnostics.
    """
    from beacon_comm.msg import Bearings, Characters, Confirmed
    from diagnostic_msgs.msg import DiagnosticArray
    from node_process import NodeProcess, Peer, environment

    peer = Peer('proof')
    node = NodeProcess(
        folder, '-r', 'events:=/event_camera/events', '-p', 'qos_reliability:=reliable', '-p', 'max_lag_s:=60.0', '-p',
        f'camera_info_file:={CALIBRATION}', *parameters,
    )  # fmt: skip
    replay = None
    try:
        peer.listen('/beacon_node/characters', Characters)
        peer.listen('/beacon_node/bearings', Bearings)
        peer.listen('/beacon_node/confirmed', Confirmed, latched=True)
        peer.listen('/diagnostics', DiagnosticArray)
        node.wait_for('waiting for events on /event_camera/events')
        assert peer.spin_until(lambda: peer.heard['/beacon_node/confirmed'] and peer.heard['/diagnostics'])
        command = [sys.executable, '-P', '-m', 'beacon_comm.cli.replay', str(bag), '--reliable', '--rate', f'{rate:g}']
        with (folder / 'replay.log').open('w') as log:
            replay = subprocess.Popen(command, env=environment(folder), stdout=log, stderr=subprocess.STDOUT)
        assert peer.spin_until(lambda: replay.poll() is not None, 120), 'the replay did not end'
        assert replay.returncode == 0, (folder / 'replay.log').read_text()
        sent = len(packets_of(bag))

        def values() -> dict[str, str]:
            return {v.key: v.value for s in peer.heard['/diagnostics'][-1].status for v in s.values}

        assert peer.spin_until(lambda: int(values()['packets']) >= sent), (values(), node.output())
        peer.spin_for(1.0)  # the silent topic's clock brings the last characters out
        return heard(peer), peer.heard['/beacon_node/bearings'], values()
    finally:
        for process in (replay, node.process):
            if process is not None and process.poll() is None:
                process.kill()
                process.wait()
        peer.close()


def heard(peer: Any) -> Decoded:
    characters: dict[int, list[Row]] = defaultdict(list)
    for message in peer.heard['/beacon_node/characters']:
        for c in message.characters:
            characters[c.track_id].append((c.sensor_time_ns, c.code, c.status))
    paths: dict[int, list[tuple[int, float, float]]] = defaultdict(list)
    for message in peer.heard['/beacon_node/bearings']:
        for b in message.bearings:
            if b.age_s < 0.02:
                paths[b.track_id].append((message.sensor_time_ns, b.x_px, b.y_px))
    confirmed = {track_id for message in peer.heard['/beacon_node/confirmed'] for track_id in message.track_ids}
    return Decoded(characters, paths, tuple(sorted(confirmed)))


def write_bag(arguments: list[str], out: Path) -> Path:
    from beacon_comm.cli.replay import main

    assert main([*arguments, '--write', str(out)]) == 0
    return out


def test_live_and_offline_agree_over_a_real_background(data_folder: Path, tmp_path: Path) -> None:
    """Two beacons over looped lamp flicker, through DDS: the same characters as offline, bearings on the true path."""
    pytest.importorskip('rclpy')
    both = beacons(data_folder, 640, 480)
    discs = [argument for beacon in both for argument in ('--disc', beacon.disc.text())]
    bag = write_bag(
        [
            str(data_folder / FAST), str(data_folder / SLOW), *discs, '--clip', '0', '--clip', '12.3,5',
            '--background', str(data_folder / 'evt3_static'),
        ],
        tmp_path / 'scene',
    )  # fmt: skip
    decoded, bearings, diagnostics = live(bag, tmp_path, 1.0)
    offline = decode_packets(packets_of(bag), 640, 480)
    assert diagnostics['lost_packets'] == '0'
    camera = CameraModel.from_yaml(CALIBRATION)
    assert len(decoded.confirmed) == len(offline.confirmed) == 2
    for beacon in both:
        track = decoded.near(beacon)
        ends_ns = beacon.end_ns - 2 * CHARACTER_NS  # what follows the recording's end depends on how the stream ends
        said = [row for row in decoded.characters[track] if row[0] < ends_ns]
        assert said == [row for row in offline.characters[offline.near(beacon)] if row[0] < ends_ns]
        assert len(said) > 200
        assert rms_px(decoded.paths[track], beacon) < 0.3
        seen = [b for message in bearings for b in message.bearings if b.track_id == track and b.has_bearing]
        assert len(seen) > 50
        vectors = np.array([(b.bearing.x, b.bearing.y, b.bearing.z) for b in seen])
        expected = camera.bearings(np.array([(b.x_px, b.y_px) for b in seen], float))
        assert np.allclose(vectors, expected, atol=1e-6)
        assert np.allclose([b.azimuth_rad for b in seen], np.arctan2(vectors[:, 0], vectors[:, 2]), atol=1e-9)


def test_live_and_offline_agree_across_the_24_bit_wrap(data_folder: Path, tmp_path: Path) -> None:
    """EVT3's clock wraps every 16.8 s: the whole 504 bps recording, 19.6 s, three times as fast as it was."""
    pytest.importorskip('rclpy')
    arguments = [str(data_folder / SLOW), '--disc', '60,60,4,50,30', '--sensor', '320x240']
    bag = write_bag(arguments, tmp_path / 'scene')
    packets = packets_of(bag)
    last = parse_event_packet(packets[-1])
    assert last.stamp_ns - parse_event_packet(packets[0]).stamp_ns > 17 * NS_PER_S
    decoded, _, diagnostics = live(bag, tmp_path, 3.0, '-p', 'bit_rates:=[504.0]')
    offline = decode_packets(packets, 320, 240, Parameters(bit_rates=(504.0,)))
    assert diagnostics['lost_packets'] == '0'
    (track,), (same,) = decoded.confirmed, offline.confirmed
    assert decoded.characters[track] == offline.characters[same]
    assert len(decoded.characters[track]) > 825 and decoded.characters[track][-1][0] >= 2**24 * 1000
