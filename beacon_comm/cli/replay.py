"""``beacon_replay``: publish a recording, or several merged into one scene, or write it as a bag.

    beacon_replay BAG                                        a bag's event messages, unchanged
    beacon_replay A.mat B.mat --disc … --disc … [--background BAG]   beacons on discs, merged by event time

Bags are paced by the time they were recorded at, scenes by event time.
"""

from __future__ import annotations

import argparse
import re
import sys
from collections.abc import Sequence
from pathlib import Path

from beacon_comm.cli.interrupts import ignore_interrupts
from beacon_comm.cli.parser import EXIT_ERROR, LONGEST_S, OneLineParser
from beacon_comm.core.errors import BeaconCommError, ParameterError

EVENT_TOPIC = '/event_camera/events'
EXIT_INTERRUPTED = 130

_EPILOG = """\
Repeat --disc and --clip once for each .mat recording, in their order.
  --disc x,y[,radius[,vx,vy]]        centre at the start (px), radius (px, default 4), velocity (px/s); the disc
                                     bounces off the borders.  Default: side by side at half height, still.
  --clip start[,duration[,count]]    the part of the recording (s after its first event) that begins at scene
                                     time 0, and how often it comes in a row.  Default: all of it, once.
Every clip begins at scene time 0.  The scene ends with its last clip, or after --duration; the background is
looped for as long as it lasts.

A scene's stamps, and the /clock of --clock, begin at a fixed time, 1.7e9 s (14 November 2023), so that the same scene
gives the same bytes; a bag's are the recorded ones.

ROS arguments come last: --ros-args -r /event_camera/events:=/front/events publishes on another topic, a bag's too.

exit codes: 0 done, 2 an error (one line says which), 130 Ctrl-C before the end (0 with --loop)
"""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; return its exit code."""
    own, ros = _split_ros_arguments(sys.argv[1:] if arguments is None else arguments)
    options = _parser().parse_args(own)
    try:
        _check(options)
        from beacon_comm.cli.replaying import replay  # slow to import: after the options, and Ctrl-C stays clean

        replay(options, ros)
    except BeaconCommError as error:
        print(f'beacon_replay: {error}', file=sys.stderr)
        return EXIT_ERROR
    except KeyboardInterrupt:
        return 0 if options.loop else EXIT_INTERRUPTED
    finally:
        if arguments is None:
            ignore_interrupts()  # a second Ctrl-C must not cut the process's end short
    return 0


def _split_ros_arguments(arguments: Sequence[str]) -> tuple[list[str], list[str]]:
    at = list(arguments).index('--ros-args') if '--ros-args' in arguments else len(arguments)
    return list(arguments[:at]), list(arguments[at:])


def _parser() -> argparse.ArgumentParser:
    parser = OneLineParser(
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
    add('--clock', action='store_true', help='publish /clock: the recorded time; see below')
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
    add('--packet-period', type=float, default=0.004, metavar='S', help='event time of a packet (default 0.004)')
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
        value = getattr(options, name)
        if not 0.0 <= value <= LONGEST_S:
            raise ParameterError(f'--{name.replace("_", "-")} {value:g}: must be 0 or more, at most {LONGEST_S:g}')
    for name in ('duration', 'packet_period'):
        value = getattr(options, name)
        if value is not None and not 0.0 < value <= LONGEST_S:
            raise ParameterError(f'--{name.replace("_", "-")} {value:g}: must be above 0, at most {LONGEST_S:g}')
    if options.seed < 0:
        raise ParameterError(f'--seed {options.seed}: must be 0 or more')
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


if __name__ == '__main__':
    sys.exit(main())
