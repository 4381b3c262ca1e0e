"""``beacon_simulate``: a scene file to a bag of events, with the truth beside it."""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import yaml

from beacon_comm.cli.interrupts import ignore_interrupts, interrupts_held, uninterrupted
from beacon_comm.cli.parser import EXIT_ERROR, EXIT_OK, OneLineParser
from beacon_comm.core.errors import BeaconCommError, ParameterError, RecordingError

if TYPE_CHECKING:
    from beacon_comm.core.events import EventBatch
    from beacon_comm.simulation.description import SceneDescription
    from beacon_comm.simulation.truth import Camera

NAME = 'beacon_simulate'
EVENT_TOPIC = '/event_camera/events'
PACKET_S = 0.004
CAMERA_NAME = 'camera.yaml'
EXIT_INTERRUPTED = 130
_LOOKS = 1001  # so many times it is looked whether a beacon is in sight
FORMATS = {'evt3': 'event_camera_msgs/msg/EventPacket'} | {
    package: f'{package}/msg/EventArray' for package in ('dvs_msgs', 'prophesee_event_msgs', 'dv_ros2_msgs')
}

_EPILOG = f"""\
SCENE is a YAML file, or the name of one of the package's own (--list). How to write one: docs/simulator.md; its keys:
docs/scenes_format.md.

The bag's folder also gets truth.json and truth.npz (docs/simulator.md), and {CAMERA_NAME} if the scene has a camera: give
it to beacon_node as camera_info_file, or to beacon_evaluate as --camera.

exit codes: 0 done, 2 an error (one line says which), 130 Ctrl-C before the end
"""


def make_parser() -> argparse.ArgumentParser:
    """Return the command line's parser."""
    parser = OneLineParser(
        prog=NAME,
        description='Simulate a scene of beacons and write it as a bag (rosbag2, mcap), with the truth beside it.',
        epilog=_EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    add = parser.add_argument
    add('scene', nargs='?', metavar='SCENE', help="a scene's YAML file, or the name of one of the package's own")
    add('--output', type=Path, metavar='BAG', help="folder to write; must not exist (default: the scene's name, here)")
    add('--seed', type=int, default=0, help='of everything random: the same seed, the same bytes (default 0)')
    add('--duration', type=float, metavar='S', help="instead of the scene's duration_s")
    add('--format', choices=tuple(FORMATS), default='evt3', help='EventPacket in evt3, or the EventArray of a package')
    add('--topic', default=EVENT_TOPIC, metavar='NAME', help='event topic (default %(default)s)')
    add('--frame-id', default='event_camera', metavar='NAME', help='frame of the messages (default %(default)s)')
    add('--list', action='store_true', help="list the package's own scenes")
    return parser


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command; return its exit code."""
    parser = make_parser()
    options = parser.parse_args(argv)
    if options.list:
        for path in own_scenes().values():
            print(f'{path.stem:20} {_first_comment(path)}')
        return EXIT_OK
    if options.scene is None:
        parser.error('SCENE is required')
    if options.output is None:
        options.output = Path(Path(options.scene).stem)
    try:
        _simulate(options)
    except BeaconCommError as error:
        print(f'{NAME}: {" ".join(str(error).split())}', file=sys.stderr)
        return EXIT_ERROR
    except KeyboardInterrupt:
        return EXIT_INTERRUPTED
    finally:
        if argv is None:
            ignore_interrupts()  # a second Ctrl-C must not cut the process's end short
    return EXIT_OK


def own_scenes() -> dict[str, Path]:
    """Return the scenes that are installed with the package, by name."""
    prefixes = [*filter(None, os.environ.get('AMENT_PREFIX_PATH', '').split(os.pathsep)), sys.prefix]
    for prefix in prefixes:
        folder = Path(prefix) / 'share' / 'beacon_comm' / 'config' / 'scenes'
        if folder.is_dir():
            return {path.stem: path for path in sorted(folder.glob('*.yaml'))}
    return {}


def _first_comment(path: Path) -> str:
    line = path.read_text(encoding='utf-8').split('\n', 1)[0]
    return line.lstrip('# ') if line.startswith('#') else ''


def scene_path(name: str) -> Path:
    """Return the file that SCENE stands for.

    Raises:
        RecordingError: no such file, nor a scene of the package.
    """
    path = Path(name)
    if path.is_file():
        return path
    own = own_scenes()
    if name in own:
        return own[name]
    raise RecordingError(f'{name}: no such file, nor one of the scenes {", ".join(own)}')


@dataclass(frozen=True, slots=True)
class _Scene:
    """A scene that was read: its file, its description, and the file's content as the truth keeps it."""

    path: Path
    description: SceneDescription
    content: dict[str, Any]


def _read(options: argparse.Namespace) -> _Scene:
    from beacon_comm.evaluation.truth import load_truth
    from beacon_comm.simulation.description import make_description, read_description

    path = scene_path(options.scene)

    def load_text(name: str) -> str:
        """Return a beacon's text: a file's is looked for beside the scene first."""
        beside = path.parent / name
        return load_truth(str(beside) if name.endswith('.txt') and os.path.isfile(beside) else name)

    description, content = read_description(path, load_text)
    if options.duration is not None:
        content = {**content, 'duration_s': options.duration}
        try:
            description = make_description(content, load_text)
        except ParameterError as error:
            raise ParameterError(f'--duration {options.duration:g}: {error}') from error
    return _Scene(path, description, content)


def _background(scene: _Scene) -> Iterator[EventBatch] | None:
    keys, sensor = scene.description.background, scene.description.sensor
    if keys.bag is None:
        return None
    from beacon_comm.recordings.sources import Background

    beside = scene.path.parent / keys.bag
    background = Background(beside if beside.exists() else keys.bag, keys.bag_topic)
    if (background.width, background.height) != (sensor.width, sensor.height):
        raise ParameterError(
            f'{scene.path}: background.bag = {keys.bag!r}: has {background.width}×{background.height} pixels,'
            f' the sensor {sensor.width}×{sensor.height}'
        )
    return background.batches()


def _simulate(options: argparse.Namespace) -> None:
    scene = _read(options)
    # Imported here: --help and errors in the file need no compiled loops.
    import numpy as np

    from beacon_comm.cli.progress import progress
    from beacon_comm.recordings.bag_writer import BagWriter
    from beacon_comm.recordings.packets import PacketMaker
    from beacon_comm.recordings.truth import write_simulated_truth
    from beacon_comm.simulation.scene import SimulatedScene

    try:
        simulated = SimulatedScene(scene.description, options.seed, _background(scene))
    except ParameterError as error:
        text = str(error)
        raise ParameterError(text if text.startswith(str(scene.path)) else f'{scene.path}: {text}') from error
    sensor, truth, message_type = scene.description.sensor, simulated.truth, FORMATS[options.format]
    maker = PacketMaker(sensor.width, sensor.height, truth.stamp_start_ns, options.frame_id, message_type)
    events = begin_ns = 0
    stopped: BaseException | None = None
    with ExitStack() as ending, BagWriter(options.output) as writer:
        try:
            writer.add_topic(options.topic, message_type)
            count = round(truth.duration_s / PACKET_S)
            for batch in progress(simulated.batches(PACKET_S), str(options.output), count):
                recorded_ns, cdr = maker.message(batch, begin_ns)
                with interrupts_held():  # or a message is counted in the bag's summary that is not in the bag
                    writer.write(options.topic, recorded_ns, cdr)
                events += len(batch)
                begin_ns = batch.t_end_ns
        except (RecordingError, KeyboardInterrupt) as error:
            stopped = error  # what was written so far becomes a whole bag
        finally:
            ending.enter_context(uninterrupted())  # until the bag is closed
    with uninterrupted():
        write_simulated_truth(options.output, truth, scene.content)
        if truth.camera is not None:
            _write_camera(options.output / CAMERA_NAME, truth.camera)
    lost = f', {simulated.readout.lost} lost on the bus' if simulated.readout.lost else ''
    span_s = max(begin_ns * 1e-9, 1e-9)
    print(
        f'{options.output}: {span_s:g} s, {events} events ({events / span_s / 1e6:.3g} Mev/s){lost},'
        f' {len(truth.beacons)} beacons, {len(truth.distractors)} distractors',
        file=sys.stderr,
    )
    looks_ns = np.linspace(0, round(truth.duration_s * 1e9), _LOOKS).astype(np.int64)
    for beacon in truth.beacons:
        if not beacon.visible(looks_ns).any():
            print(f'{NAME}: {scene.path}: {beacon.name} is never in sight', file=sys.stderr)
    if stopped is not None:
        raise stopped


def _write_camera(path: Path, camera: Camera) -> None:
    """Write the camera's calibration as ROS's camera_calibration does.

    Raises:
        RecordingError: the file cannot be written.
    """
    matrix = [camera.fx, 0.0, camera.cx, 0.0, camera.fy, camera.cy, 0.0, 0.0, 1.0]
    projection = [camera.fx, 0.0, camera.cx, 0.0, 0.0, camera.fy, camera.cy, 0.0, 0.0, 0.0, 1.0, 0.0]
    d = [*camera.d] or [0.0] * 5
    identity = [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0]
    content = {
        'image_width': camera.width,
        'image_height': camera.height,
        'camera_name': 'simulated',
        'camera_matrix': {'rows': 3, 'cols': 3, 'data': matrix},
        'distortion_model': camera.model,
        'distortion_coefficients': {'rows': 1, 'cols': len(d), 'data': d},
        'rectification_matrix': {'rows': 3, 'cols': 3, 'data': identity},
        'projection_matrix': {'rows': 3, 'cols': 4, 'data': projection},
    }
    try:
        path.write_text(yaml.safe_dump(content, sort_keys=False, default_flow_style=None), encoding='utf-8')
    except OSError as error:
        raise RecordingError(f'{path}: cannot be written ({error.strerror})') from error


if __name__ == '__main__':
    sys.exit(main())
