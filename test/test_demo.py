"""The demo: its verdict, and the whole of it as a user runs it."""

import os
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from beacon_comm.cli.demo_scene import simulated_scene
from beacon_comm.cli.demo_verdict import Heard, judge
from beacon_comm.core.character import Character, Status
from beacon_comm.core.events import NS_PER_S
from beacon_comm.recordings.sources import Beacon

BOUND_S = 300.0  # a first start compiles, on a machine that may be busy


@pytest.fixture(scope='module')
def sources() -> tuple[Beacon, ...]:
    return simulated_scene().beacons


def heard(beacon: Beacon, track_id: int, wrong_every: int = 0) -> Heard:
    """Return what a receiver without errors hears of a beacon, or with every n-th character wrong."""
    assert beacon.text is not None and beacon.bit_rate_bps is not None
    times = (beacon.t_ns[0] + beacon.t_ns[-1]) // 2 + np.arange(-50, 50) * 10_000_000
    path = [(int(t), float(x), float(y)) for t, x, y in zip(times, *beacon.disc.centre(times / NS_PER_S), strict=True)]
    period_ns = 11 / beacon.bit_rate_bps * NS_PER_S
    count = round((beacon.end_ns - 0.2 * NS_PER_S) / period_ns)
    characters = [
        Character(
            round(0.1 * NS_PER_S + k * period_ns),
            ord(beacon.text[k % len(beacon.text)]) ^ (1 if wrong_every and k % wrong_every == 0 else 0),
            Status.OK,
            1.0,
            0,
            beacon.bit_rate_bps,
        )
        for k in range(count)
    ]
    return Heard(track_id, characters, path)


def test_everything_right_passes(sources: tuple[Beacon, ...]) -> None:
    candidate = Heard(9)  # a track that was never confirmed does not matter
    verdict = judge([heard(sources[0], 1), candidate, heard(sources[1], 2)], sources, 0)
    assert verdict.passed
    assert verdict.line.startswith('demo passed: 2 of 2 beacons confirmed, 0 false; ')
    assert '(100.0 %); 0.0 px from the true paths; 0 packets lost' in verdict.line


def test_a_missing_beacon_fails(sources: tuple[Beacon, ...]) -> None:
    verdict = judge([heard(sources[0], 1)], sources, None)
    assert not verdict.passed and 'FAILED: 1 of 2 beacons' in verdict.line and 'loss of packets unknown' in verdict.line
    assert not judge([], sources, 0).passed


def test_a_confirmed_lamp_fails(sources: tuple[Beacon, ...]) -> None:
    lamp = Heard(3, [], [(k * 10_000_000, 520.0, 100.0) for k in range(100)])
    verdict = judge([heard(sources[0], 1), heard(sources[1], 2), lamp], sources, 0)
    assert not verdict.passed and '2 of 2 beacons confirmed, 1 false' in verdict.line


def test_a_beacon_beside_its_path_fails(sources: tuple[Beacon, ...]) -> None:
    beside = heard(sources[1], 2)
    beside.path = [(t, x + 10, y) for t, x, y in beside.path]
    assert not judge([heard(sources[0], 1), beside], sources, 0).passed


def test_wrong_characters_fail(sources: tuple[Beacon, ...]) -> None:
    assert judge([heard(sources[0], 1, 10), heard(sources[1], 2)], sources, 0).passed
    verdict = judge([heard(sources[0], 1, 4), heard(sources[1], 2)], sources, 0)
    assert not verdict.passed and '2 of 2' in verdict.line
    nothing = replace(heard(sources[1], 2), characters=[])
    assert not judge([heard(sources[0], 1), nothing], sources, 0).passed


def start_demo() -> subprocess.Popen[str]:
    pytest.importorskip('rclpy')
    pytest.importorskip('beacon_comm.msg')
    pytest.importorskip('event_camera_msgs')
    return subprocess.Popen(
        [sys.executable, '-m', 'beacon_comm.cli.demo', '--simulate'],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        start_new_session=True,
    )


def end_all(demo: subprocess.Popen[str]) -> None:
    try:
        os.killpg(demo.pid, signal.SIGKILL)
    except ProcessLookupError:
        return
    demo.wait()


def test_the_demo_passes() -> None:
    demo = start_demo()
    try:
        printed, _ = demo.communicate(timeout=BOUND_S)
    finally:
        end_all(demo)
    assert demo.returncode == 0, printed
    lines = printed.splitlines()
    assert lines[0] == 'recording: simulated (as asked)'
    assert lines[-1].startswith('demo passed: 2 of 2 beacons confirmed, 0 false;')
    assert any('504.0 bps' in line and 'North pier light: depth 4.2 m' in line and ' az ' in line for line in lines)


def test_ctrl_c_leaves_no_process_behind() -> None:
    demo = start_demo()
    try:
        assert demo.stdout is not None
        while 'starting the node' not in demo.stdout.readline():
            assert demo.poll() is None
        demo.send_signal(signal.SIGINT)
        assert demo.wait(BOUND_S) == 130
        deadline_s = time.monotonic() + 10.0
        while _in_group(demo.pid):
            assert time.monotonic() < deadline_s, _in_group(demo.pid)
            time.sleep(0.05)
    finally:
        end_all(demo)


def _in_group(group: int) -> list[str]:
    """Return the command lines of the processes in a process group, zombies left out."""
    found = []
    for folder in Path('/proc').glob('[0-9]*'):
        try:
            state, _, its_group = (folder / 'stat').read_text().rpartition(')')[2].split()[:3]
            if int(its_group) == group and state != 'Z':
                found.append((folder / 'cmdline').read_text().replace('\0', ' '))
        except (OSError, ValueError):
            continue
    return found
