"""Publishing raw messages at their pace; the part of ``beacon_replay`` that needs ROS.

    messages, the first one fetched ──→ a subscriber awaited (bounded) ──→ each published when its time has come
"""

from __future__ import annotations

import importlib
import re
import sys
import time
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, NamedTuple

from tqdm import tqdm

from beacon_comm.cli.interrupts import uninterrupted
from beacon_comm.cli.progress import progress
from beacon_comm.core.errors import BeaconCommError
from beacon_comm.core.events import NS_PER_S
from beacon_comm.wire.stream import PACKET_TYPES

QUEUE_DEPTH = 1000  # as the camera drivers publish
_POLL_S = 0.02
# A best-effort subscriber takes its last messages from the writer's memory, which goes when the writer does.
_DRAIN_S = 0.5
_ACKNOWLEDGE_S = 10.0
_LATE_S = 0.5
_CLOCK_STEP_NS = 10_000_000


class PublishError(BeaconCommError):
    """Nothing can be published: no ROS, no Python package of the message type, or arguments that ROS refuses."""


class PacedMessage(NamedTuple):
    """A message, the time that paces it (ns, running on), the ROS time it was recorded at (ns), and its CDR."""

    pace_ns: int
    recorded_ns: int
    cdr: bytes


@dataclass(frozen=True, slots=True)
class Playback:
    """What is to be published, and how.

    Attributes:
        topic, type: the topic's name and message type.
        messages: in the order they are published; the first is best at hand already, for the clock begins with it.
        total: how many there are, None: not known or endless.
        rate: speed, 1.0 is the recording's own, 0.0 as fast as it goes.
        reliable: reliable instead of best effort.
        clock: publish ``/clock``, too.
        wait_s: longest wait for a subscriber (s).
    """

    topic: str
    type: str
    messages: Iterable[PacedMessage]
    total: int | None
    rate: float = 1.0
    reliable: bool = False
    clock: bool = False
    wait_s: float = 10.0


def note(text: str) -> None:
    """Print one line for the user, beside the progress bar."""
    tqdm.write(f'beacon_replay: {text}', file=sys.stderr)


def publish(playback: Playback, ros_arguments: Sequence[str] = ()) -> None:
    """Publish a playback.

    Raises:
        PublishError: no ROS, no Python package of the message type, or a topic or arguments that ROS refuses.
        RecordingError: the recording is damaged; what could be read was published.
    """
    message_class = _message_class(playback.type)
    with _node(ros_arguments) as node:
        publisher = _publisher(node, message_class, playback)
        clock = _Clock(node) if playback.clock else None
        _await_subscriber(node, publisher, playback.wait_s)
        late_s = _publish_paced(playback, publisher, clock)
        if late_s > _LATE_S:
            note(f'could not keep the pace: {late_s:.1f} s late at the worst')
        _drain(publisher, playback.reliable)


def _publish_paced(playback: Playback, publisher: Any, clock: _Clock | None) -> float:
    """Publish and return by how much the worst message was late (s)."""
    begin_ns: int | None = None
    begin_s = time.monotonic()
    late_s = 0.0
    for message in progress(playback.messages, playback.topic, playback.total):
        if begin_ns is None:
            begin_ns = message.pace_ns
        if playback.rate > 0.0:
            wait_s = begin_s + (message.pace_ns - begin_ns) / NS_PER_S / playback.rate - time.monotonic()
            late_s = max(late_s, -wait_s)
            if wait_s > 0.0:
                time.sleep(wait_s)
        if clock is not None:
            clock.publish(message.recorded_ns)
        publisher.publish(message.cdr)
    return late_s


class _Clock:
    """Publishes ``/clock``, at most every 10 ms of it."""

    def __init__(self, node: Any) -> None:
        from rosgraph_msgs.msg import Clock

        self._message = Clock()
        self._publisher = node.create_publisher(Clock, '/clock', 10)
        self._published_ns: int | None = None

    def publish(self, now_ns: int) -> None:
        """Publish a time (ns), unless it was published just before."""
        if self._published_ns is not None and 0 <= now_ns - self._published_ns < _CLOCK_STEP_NS:
            return
        self._published_ns = now_ns
        self._message.clock.sec, self._message.clock.nanosec = divmod(now_ns, NS_PER_S)
        self._publisher.publish(self._message)


def _message_class(message_type: str) -> type:
    names = [message_type]
    if message_type in PACKET_TYPES:
        names.append(PACKET_TYPES[0])  # the former name's messages are the same bytes
    for name in names:
        package, _, class_name = name.split('/')
        try:
            message_class: type = getattr(importlib.import_module(f'{package}.msg'), class_name)
        except (ImportError, AttributeError):
            continue
        if name != message_type:
            note(f'{message_type} is not installed; publishing as {name}, which has the same fields')
        return message_class
    package = names[-1].split('/')[0]
    raise PublishError(
        f'publishing {message_type} needs the ROS package {package} (its Python messages);'
        ' --write OUT does without'
    )


def _publisher(node: Any, message_class: type, playback: Playback) -> Any:
    from rclpy.exceptions import NameValidationException

    try:
        return node.create_publisher(message_class, playback.topic, _qos(playback.reliable))
    except (NameValidationException, RuntimeError) as error:
        raise PublishError(f'topic {playback.topic!r}: {_one_line(error)}') from error


def _one_line(error: Exception) -> str:
    """Return what ROS says, without the places in its source and the picture of a name below its text."""
    text = str(error).split(':\n')[0]
    return ' '.join(re.sub(r', at [^\s,]+:\d+', '', text).split())


def _qos(reliable: bool) -> Any:
    from rclpy.qos import QoSHistoryPolicy, QoSProfile, QoSReliabilityPolicy

    return QoSProfile(
        history=QoSHistoryPolicy.KEEP_LAST,
        depth=QUEUE_DEPTH,
        reliability=QoSReliabilityPolicy.RELIABLE if reliable else QoSReliabilityPolicy.BEST_EFFORT,
    )


@contextmanager
def _node(ros_arguments: Sequence[str]) -> Iterator[Any]:
    try:
        import rclpy
        from rclpy.logging import LoggingSeverity, set_logger_level
        from rclpy.signals import SignalHandlerOptions
    except ImportError as error:
        raise PublishError(f'publishing needs ROS 2 ({error}); source it, or use --write OUT') from error
    # Ctrl-C stays Python's KeyboardInterrupt: rclpy's own handler would only end the context.
    set_logger_level('rcl', LoggingSeverity.FATAL)  # it would say first, in a line of its own, what is raised anyway
    try:
        rclpy.init(args=['beacon_replay', *ros_arguments], signal_handler_options=SignalHandlerOptions.NO)
        set_logger_level('rcl', LoggingSeverity.UNSET)
        node = rclpy.create_node('beacon_replay')
    except RuntimeError as error:  # the base of everything that rclpy raises here
        rclpy.try_shutdown()
        given = ' '.join(('', 'with', *ros_arguments)) if ros_arguments else ''
        raise PublishError(f'ROS does not start{given}: {_one_line(error)}') from error
    try:
        yield node
    finally:
        with uninterrupted():
            node.destroy_node()
            rclpy.try_shutdown()


def _await_subscriber(node: Any, publisher: Any, wait_s: float) -> None:
    deadline_s = time.monotonic() + wait_s
    while publisher.get_subscription_count() == 0:
        if time.monotonic() >= deadline_s:
            if wait_s > 0.0:
                others = node.get_subscriptions_info_by_topic(publisher.topic_name)
                why = f' that takes it ({len(others)} want other QoS; try --reliable)' if others else ''
                note(f'no subscriber of {publisher.topic_name}{why} within {wait_s:g} s; publishing all the same')
            return
        time.sleep(_POLL_S)


def _drain(publisher: Any, reliable: bool) -> None:
    if publisher.get_subscription_count() == 0:
        return
    if not reliable:
        time.sleep(_DRAIN_S)
        return
    from rclpy.duration import Duration

    if not publisher.wait_for_all_acked(Duration(seconds=_ACKNOWLEDGE_S)):
        note(f'not everything was acknowledged within {_ACKNOWLEDGE_S:g} s')
