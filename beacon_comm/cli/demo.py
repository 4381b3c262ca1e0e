"""The demo: a short recording goes through DDS into the live node, and what the beacons say comes out.

    beacon_replay ──/event_camera/events──► beacon_node ──~/text, ~/bearings …──► this process, which prints

Three processes.  It ends by itself; the last line is the verdict.  Exit code 0: passed, 1: failed, 2: could not be
run, 130: Ctrl-C.
"""

from __future__ import annotations

import argparse
import contextlib
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from types import FrameType

from beacon_comm.cli.demo_listener import Listener
from beacon_comm.cli.demo_scene import REAL_FILES, real_scene, simulated_scene
from beacon_comm.cli.demo_verdict import judge
from beacon_comm.core.errors import BeaconCommError
from beacon_comm.recordings.bag_writer import BagWriter
from beacon_comm.recordings.folder import recordings_folder
from beacon_comm.recordings.interfaces import PACKET_TYPE
from beacon_comm.recordings.scene import Scene

EVENT_TOPIC = '/event_camera/events'
PROJECT = Path(__file__).resolve().parents[2]
EXIT_FAILED, EXIT_NOT_RUN, EXIT_INTERRUPTED = 1, 2, 130
START_TIMEOUT_S = 240.0  # the node's first start compiles
REPLAY_TIMEOUT_S = 90.0
LAST_WORDS_S = 1.0
END_TIMEOUT_S = 10.0
LOG_LINES = 15


class DemoError(BeaconCommError):
    """The demo cannot be run; the text says why."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the demo; return its exit code."""
    parser = argparse.ArgumentParser(prog='beacon_demo', description=__doc__.splitlines()[0] if __doc__ else '')
    parser.add_argument('--simulate', action='store_true', help='simulated beacons, even where the recordings are')
    options = parser.parse_args(arguments)
    signal.signal(signal.SIGTERM, _interrupt)
    try:
        return _run(options.simulate)
    except BeaconCommError as error:
        print(f'demo could not be run: {error}', file=sys.stderr)
        return EXIT_NOT_RUN
    except KeyboardInterrupt:
        return EXIT_INTERRUPTED


def _interrupt(number: int, frame: FrameType | None) -> None:
    raise KeyboardInterrupt


def _run(simulate: bool) -> int:
    _set_environment()
    scene = _scene(simulate)
    with TemporaryDirectory(prefix='beacon_demo_') as folder:
        bag = Path(folder) / 'recording'
        _write(scene, bag)
        with _listening() as listener, _node_process(Path(folder)) as node:
            say('starting the node (its first start compiles, which can take a minute)')
            _wait(listener, listener.node_is_up, START_TIMEOUT_S, 'the node to start', node)
            with _process('beacon_comm.cli.replay', str(bag), '--wait-subscribers', '30') as replay:
                _wait(listener, replay.ended, REPLAY_TIMEOUT_S, 'the replay to end', node)
                if replay.process.returncode != 0:
                    raise DemoError(f'the replay ended with exit code {replay.process.returncode}')
            begin_s = time.monotonic()
            while time.monotonic() - max(listener.heard_s, begin_s) < LAST_WORDS_S:
                listener.spin_once()
            listener.finish()
            code = node.end()
        verdict = judge(list(listener.tracks.values()), scene.beacons, listener.lost_packets)
        if code != 0:
            raise DemoError(f'the node ended with exit code {code}: {node.last_lines()}')
    say(verdict.line)
    return 0 if verdict.passed else EXIT_FAILED


def say(line: str) -> None:
    """Print a line at once, also into a pipe."""
    print(line, flush=True)


def _set_environment() -> None:
    """Keep to this machine and to a domain of its own, unless told otherwise."""
    os.environ.setdefault('ROS_DOMAIN_ID', str(1 + os.getpid() % 100))
    os.environ.setdefault('ROS_AUTOMATIC_DISCOVERY_RANGE', 'LOCALHOST')
    os.environ.setdefault('FASTRTPS_DEFAULT_PROFILES_FILE', str(_config('fastdds_shm.xml')))


def _config(name: str) -> Path:
    """Return a file of the package's config folder: of the checkout, else as installed."""
    beside = PROJECT / 'config' / name
    if beside.is_file():
        return beside
    from ament_index_python.packages import get_package_share_directory

    return Path(get_package_share_directory('beacon_comm')) / 'config' / name


def _scene(simulate: bool) -> Scene:
    folder = recordings_folder()
    missing = [name for name in REAL_FILES if not (folder / name).exists()]
    if simulate or missing:
        say(f'recording: simulated ({"as asked" if simulate else f"no {missing[0]} in {folder}"})')
        return simulated_scene()
    say(f'recording: outdoor beacons at 30 m over an indoor background, from {folder}')
    return real_scene(folder)


def _write(scene: Scene, bag: Path) -> None:
    with BagWriter(bag) as writer:
        writer.add_topic(EVENT_TOPIC, PACKET_TYPE)
        for recorded_ns, cdr in scene.packets():
            writer.write(EVENT_TOPIC, recorded_ns, cdr)
    say(f'{scene.packet_count()} packets, {scene.end_ns / 1e9:.1f} s, {len(scene.beacons)} sources; example calibration')


@contextlib.contextmanager
def _listening() -> Iterator[Listener]:
    try:
        listener = Listener(say)
    except ImportError as error:
        raise DemoError(f'ROS 2 or the built package is missing ({error})') from error
    try:
        yield listener
    finally:
        listener.close()


class Child:
    """A process of the demo; its output goes to a log unless it shares ours."""

    def __init__(self, command: Sequence[str], log: Path | None = None) -> None:
        self._log = log
        if log is None:
            self.process = subprocess.Popen(command)
            return
        with log.open('w') as output:
            self.process = subprocess.Popen(command, stdout=output, stderr=subprocess.STDOUT)

    def ended(self) -> bool:
        """Return whether it has ended."""
        return self.process.poll() is not None

    def end(self) -> int:
        """Ask it to end, wait a bounded time, and return its exit code."""
        if not self.ended():
            self.process.send_signal(signal.SIGINT)
            with contextlib.suppress(subprocess.TimeoutExpired):
                self.process.wait(END_TIMEOUT_S)
        if not self.ended():
            self.process.kill()
        return self.process.wait()

    def last_lines(self) -> str:
        """Return the end of its log."""
        if self._log is None:
            return ''
        return '\n'.join(self._log.read_text(errors='replace').splitlines()[-LOG_LINES:])


@contextlib.contextmanager
def _process(module: str, *arguments: str, log: Path | None = None) -> Iterator[Child]:
    child = Child([sys.executable, '-m', module, *arguments], log)
    try:
        yield child
    finally:
        child.end()


def _node_process(folder: Path) -> contextlib.AbstractContextManager[Child]:
    return _process(
        'beacon_comm.ros.node',
        '--ros-args',
        '-r',
        f'events:={EVENT_TOPIC}',
        '--params-file',
        str(_config('beacon.yaml')),
        '-p',
        f'camera_info_file:={_config("camera_example.yaml")}',
        '-p',
        'max_lag_s:=60.0',  # everything is to be read, however slow the machine is
        log=folder / 'node.log',
    )


def _wait(
    listener: Listener, condition: Callable[[], bool], timeout_s: float, what: str, node: Child
) -> None:
    """Listen until something has happened.

    Raises:
        DemoError: the time is up, or the node has ended.
    """
    deadline_s = time.monotonic() + timeout_s
    while not condition():
        if node.ended():
            raise DemoError(f'the node ended with exit code {node.process.returncode}: {node.last_lines()}')
        if time.monotonic() > deadline_s:
            raise DemoError(f'waited {timeout_s:g} s for {what}: {node.last_lines()}')
        listener.spin_once()


if __name__ == '__main__':
    sys.exit(main())
