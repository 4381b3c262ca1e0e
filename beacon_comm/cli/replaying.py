"""What ``beacon_replay`` does once its options are read: bags and scenes to paced messages, to a topic or a bag."""

from __future__ import annotations

import argparse
import itertools
from collections.abc import Iterator, Sequence
from contextlib import ExitStack

from beacon_comm.cli.interrupts import interrupts_held, uninterrupted
from beacon_comm.cli.progress import progress
from beacon_comm.cli.publisher import PacedMessage, Playback, note, publish
from beacon_comm.cli.replay import EVENT_TOPIC
from beacon_comm.core.errors import ParameterError, RecordingError
from beacon_comm.core.events import NS_PER_S
from beacon_comm.recordings.bag_writer import BagWriter
from beacon_comm.recordings.bags import Bag, open_recording
from beacon_comm.recordings.disc import DEFAULT_RADIUS_PX, Disc
from beacon_comm.recordings.interfaces import PACKET_TYPE
from beacon_comm.recordings.scene import Scene
from beacon_comm.recordings.sources import Background, Clip, mat_beacon
from beacon_comm.recordings.storage import TopicInfo
from beacon_comm.recordings.truth import TRUTH_NAME, write_truth
from beacon_comm.wire.evt3_encoder import MAX_SIDE_PX

DEFAULT_SENSOR = (640, 480)


def replay(options: argparse.Namespace, ros: Sequence[str] = ()) -> None:
    """Do what the checked options say.

    Args:
        options: of ``beacon_replay``.
        ros: ROS arguments, from ``--ros-args`` on.

    Raises:
        BeaconCommError: a recording, an option or the publishing does not work.
    """
    if options.recordings[0].suffix == '.mat':
        _replay_scene(options, ros)
    else:
        _replay_bag(options, ros)


def _replay_bag(options: argparse.Namespace, ros: Sequence[str]) -> None:
    with open_recording(options.recordings[0]) as bag:
        topic = bag.event_topic(options.topic)
        whole = options.start == 0.0 and options.duration is None and not options.loop
        messages = bag_messages(bag, topic, options.start, options.duration, options.loop)
        _deliver(options, ros, topic.name, topic.type, messages, topic.count or None if whole else None)


def bag_messages(
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
    if options.sensor is not None and not all(1 <= side <= MAX_SIDE_PX for side in options.sensor):
        size, most = ('x'.join(map(str, sides)) for sides in (options.sensor, (MAX_SIDE_PX, MAX_SIDE_PX)))
        raise ParameterError(f'--sensor {size}: must be from 1x1 to {most}')
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
    first = next(messages, None)  # decoding and compiling begin before the clock does
    if first is None:
        names = ', '.join(map(str, options.recordings))
        raise RecordingError(f'{names}: nothing in the part asked for, from {options.start:g} s on')
    whole = itertools.chain([first], messages)
    if options.write is None:
        publish(
            Playback(
                topic,
                message_type,
                whole,
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
    with ExitStack() as ending, BagWriter(options.write) as writer:
        try:
            writer.add_topic(topic, message_type)
            for message in progress(whole, str(options.write), total):
                with interrupts_held():  # or a message is counted in the bag's summary that is not in the bag
                    writer.write(topic, message.recorded_ns, message.cdr)
                    count += 1
        except (RecordingError, KeyboardInterrupt) as error:
            stopped = error  # what was written so far becomes a whole bag
        finally:
            ending.enter_context(uninterrupted())  # until the bag is closed
    if count:
        note(f'{count} messages written to {options.write}')
    if stopped is not None:
        raise stopped
