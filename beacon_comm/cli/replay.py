"""``beacon_replay``: publish a recording, or several merged into one scene, or write it as a bag.

    beacon_replay BAG                                        a bag's event messages, unchanged
    beacon_replay A.mat B.mat --disc … --disc … [--background BAG]   beacons on discs, merged by event time

Bags are paced by the time they were recorded at, scenes by event time.
"""

from __future__ import annotations

import argparse
import re
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NoReturn

from beacon_comm.cli.publisher import PacedMessage, Playback, note, publish
from beacon_comm.cli.progress import progress
from beacon_comm.core.errors import BeaconCommError, ParameterError, RecordingError
from beacon_comm.core.events import NS_PER_S
from beacon_comm.recordings.bag_writer import BagWriter
from beacon_comm.recordings.bags import Bag, open_recording
from beacon_comm.recordings.disc import DEFAULT_RADIUS_PX, Disc
from beacon_comm.recordings.interfaces import PACKET_TYPE
from beacon_comm.recordings.scene import PACKET_PERIOD_S, Scene
from beacon_comm.recordings.sources import Background, Clip, mat_beacon
from beacon_comm.recordings.storage import TopicInfo
from beacon_comm.recordings.truth import TRUTH_NAME, write_truth

EVENT_TOPIC = '/event_camera/events'
DEFAULT_SENSOR = (640, 480)
EXIT_ERROR = 2
EXIT_INTERRUPTED = 130

_EPILOG = """\
Repeat --disc and --clip once for each .mat recording, in their order.
  --disc x,y[,radius[,vx,vy]]        centre at the start (px), radius (px, default 4), velocity (px/s); the disc
                                     bounces off the borders.  Default: side by side at half height, still.
  --clip start[,duration[,count]]    the part of the recording (s after its first event) that begins at scene
                                     time 0, and how often it comes in a row.  Default: all of it, once.
Every clip begins at scene time 0.  The scene ends with its last clip, or after --duration; the background is
looped for as long as it lasts.

exit codes: 0 done, 2 an error (one line says which), 130 Ctrl-C before the end (0 with --loop)
"""


class _Parser(argparse.ArgumentParser):
    def error(self, message: str) -> NoReturn:
        self.exit(EXIT_ERROR, f'{self.prog}: {message}\n')


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; return its exit code."""
    own, ros = _split_ros_arguments(sys.argv[1:] if arguments is None else arguments)
    options = _parser().parse_args(own)
    try:
        _check(options)
        if options.recordings[0].suffix == '.mat':
            _replay_scene(options, ros)
        else:
            _replay_bag(options, ros)
    except BeaconCommError as error:
        print(f'beacon_replay: {error}', file=sys.stderr)
        return EXIT_ERROR
    except KeyboardInterrupt:
        return 0 if options.loop else EXIT_INTERRUPTED
    return 0


def _split_ros_arguments(arguments: Sequence[str]) -> tuple[list[str], list[str]]:
    at = list(arguments).index('--ros-args') if '--ros-args' in arguments else len(arguments)
    return list(arguments[:at]), list(arguments[at:])


def _parser() -> argparse.ArgumentParser:
    parser = _Parser(
        prog='beacon_replay',
        description='Publish the events of a recording, or of several .mat recordings merged into one scene.',
        epilog=_EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    add = parser.add_argument
    add('recordings', nargs='+', type=Path, metavar='RECORDING', help='one bag, or one or more .mat recordings')
    add('--rate', type=float, default=1.0, help='speed; 0: as fast as it goes (default 1)')
    add('--loop', action='store_true', help='over and over, until Ctrl-C')
    add('--start', type=float, default=0.0, metavar='S', help='begin so many seconds into it')
    add('--duration', type=float, metavar='S', help='end so many seconds later')
    add('--clock', action='store_true', help='publish /clock: the recorded time')
    add('--topic', metavar='NAME', help=f"the bag's event topic; of a scene: where to publish ({EVENT_TOPIC})")
    add('--reliable', action='store_true', help='publish reliably instead of best effort')
    add('--wait-subscribers', type=float, default=10.0, metavar='S', help='longest wait for a subscriber (default 10)')
    add('--write', type=Path, metavar='OUT', help='write a bag instead of publishing; a scene with its truth.json')
    scene = parser.add_argument_group('scenes of .mat recordings')
    add = scene.add_argument
    add('--disc', action='append', default=[], metavar='X,Y[,R[,VX,VY]]', help='where a recording is; see below')
    add('--clip', action='append', default=[], metavar='S[,S[,N]]', help='which part of a recording; see below')
    add('--background', type=Path, metavar='BAG', help='a bag of any supported encoding, looped')
    add('--background-topic', metavar='NAME', help="the background's event topic, if it has several")
    add('--sensor', type=_size, metavar='WxH', help="sensor size (default: the background's, or 640x480)")
    add('--packet-period', type=float, default=PACKET_PERIOD_S, metavar='S', help='event time of a packet (default 0.004)')
    add('--frame-id', metavar='NAME', help='frame of the messages (default event_camera)')
    add('--seed', type=int, default=0, help='seed of the pixels (default 0)')
    return parser


def _size(text: str) -> tuple[int, int]:
    match = re.fullmatch(r'(\d+)[x×](\d+)', text)
    if match is None:
        raise argparse.ArgumentTypeError(f'{text!r}: must be like 640x480')
    return int(match[1]), int(match[2])


def _check(options: argparse.Namespace) -> None:
    for name in ('rate', 'start', 'wait_subscribers'):
        if not 0.0 <= getattr(options, name) < float('inf'):
            raise ParameterError(f'--{name.replace("_", "-")} {getattr(options, name):g}: must be 0 or more')
    for name in ('duration', 'packet_period'):
        value = getattr(options, name)
        if value is not None and not 0.0 < value < float('inf'):
            raise ParameterError(f'--{name.replace("_", "-")} {value:g}: must be above 0')
    if options.write is not None and options.loop:
        raise ParameterError('--write with --loop would never end; --duration or the count of a --clip say how long')
    mats = [path.suffix == '.mat' for path in options.recordings]
    if all(mats):
        if len(options.disc) > len(mats) or len(options.clip) > len(mats):
            raise ParameterError(f'more --disc or --clip than the {len(mats)} recordings')
        return
    if any(mats):
        raise ParameterError('bags and .mat recordings together: give the bag as --background')
    if len(mats) > 1:
        raise ParameterError('one bag at a time')
    for name in ('disc', 'clip', 'background', 'sensor', 'frame_id'):
        if getattr(options, name):
            raise ParameterError(f'--{name.replace("_", "-")} is for .mat recordings; a bag is published unchanged')


def _replay_bag(options: argparse.Namespace, ros: Sequence[str]) -> None:
    with open_recording(options.recordings[0]) as bag:
        topic = bag.event_topic(options.topic)
        whole = options.start == 0.0 and options.duration is None and not options.loop
        messages = _bag_messages(bag, topic, options.start, options.duration, options.loop)
        _deliver(options, ros, topic.name, topic.type, messages, topic.count or None if whole else None)


def _bag_messages(
    bag: Bag, topic: TopicInfo, start_s: float, duration_s: float | None, loop: bool
) -> Iterator[PacedMessage]:
    """Yield the part of a bag; a further pass is paced on from where the one before ended."""
    shift_ns = 0
    while True:
        first_ns = last_ns = begin_ns = None
        gap_ns = 0
        for recorded_ns, cdr in bag.messages(topic):
            first_ns = recorded_ns if first_ns is None else first_ns
            since_ns = recorded_ns - first_ns - round(start_s * NS_PER_S)
            if since_ns < 0:
                continue
            if duration_s is not None and since_ns >= duration_s * NS_PER_S:
                break
            if last_ns is None:
                begin_ns = recorded_ns
            else:
                gap_ns = max(recorded_ns - last_ns, 0)
            last_ns = recorded_ns
            yield PacedMessage(recorded_ns + shift_ns, recorded_ns, cdr)
        if not loop or last_ns is None or begin_ns is None:
            return
        shift_ns += last_ns - begin_ns + gap_ns


def _replay_scene(options: argparse.Namespace, ros: Sequence[str]) -> None:
    scene = make_scene(options)
    count = scene.packet_count(options.start, options.duration)
    packets = scene.packets(options.start, options.duration, options.loop)
    messages = (PacedMessage(recorded_ns, recorded_ns, cdr) for recorded_ns, cdr in packets)
    _deliver(options, ros, options.topic or EVENT_TOPIC, PACKET_TYPE, messages, None if options.loop else count)
    if options.write is not None:
        write_truth(options.write / TRUTH_NAME, scene, options.start, options.duration)


def make_scene(options: argparse.Namespace) -> Scene:
    """Build the scene that the options describe.

    Raises:
        RecordingError, ParameterError: a recording or an option that does not work.
    """
    background = None
    if options.background is not None:
        background = Background(options.background, options.background_topic)
    natural = (background.width, background.height) if background is not None else DEFAULT_SENSOR
    width, height = options.sensor or natural
    beacons = []
    for index, path in enumerate(options.recordings):
        place = f'{(index + 1) * width // (len(options.recordings) + 1)},{height // 2},{DEFAULT_RADIUS_PX:g}'
        disc = Disc.parse(options.disc[index] if index < len(options.disc) else place, width, height)
        clip = Clip.parse(options.clip[index]) if index < len(options.clip) else Clip()
        beacons.append(mat_beacon(path, disc, clip))
    return Scene(
        tuple(beacons),
        width,
        height,
        background,
        packet_period_ns=round(options.packet_period * 1e6) * 1000,
        seed=options.seed,
        frame_id=options.frame_id or 'event_camera',
    )


def _deliver(
    options: argparse.Namespace,
    ros: Sequence[str],
    topic: str,
    message_type: str,
    messages: Iterator[PacedMessage],
    total: int | None,
) -> None:
    if options.write is None:
        publish(
            Playback(
                topic,
                message_type,
                messages,
                total,
                options.rate,
                options.reliable,
                options.clock,
                options.wait_subscribers,
            ),
            ros,
        )
        return
    stopped: BaseException | None = None
    count = 0
    with BagWriter(options.write) as writer:
        writer.add_topic(topic, message_type)
        try:
            for message in progress(messages, str(options.write), total):
                writer.write(topic, message.recorded_ns, message.cdr)
                count += 1
        except (RecordingError, KeyboardInterrupt) as error:
            stopped = error  # what was written so far becomes a whole bag
    note(f'{count} messages written to {options.write}')
    if stopped is not None:
        raise stopped


if __name__ == '__main__':
    sys.exit(main())
