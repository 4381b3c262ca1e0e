"""The event topic on the ROS graph: who publishes it, of which type, and whether the two ends fit."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from importlib import import_module
from typing import Any

from rclpy.event_handler import SubscriptionEventCallbacks, UnsupportedEventTypeError
from rclpy.impl.implementation_singleton import rclpy_implementation as _rclpy
from rclpy.node import Node
from rclpy.qos import QoSCompatibility, QoSProfile, qos_check_compatible
from rclpy.subscription import Subscription
from rclpy.topic_endpoint_info import TopicEndpointInfo

from beacon_comm.core.events import NS_PER_S
from beacon_comm.wire.stream import SUPPORTED_TYPES, is_event_array_type

MAX_HINTS = 5


@dataclass(frozen=True, slots=True)
class Publishers:
    """The publishers of the event topic at one moment.

    Attributes:
        types: their types, one entry a publisher.
        incompatible: why none of them fits our QoS, '' if one does or there is none.
    """

    types: tuple[str, ...] = ()
    incompatible: str = ''


def is_supported(message_type: str) -> bool:
    """Tell whether a type (``package/msg/Name``) can be read."""
    return message_type in SUPPORTED_TYPES or is_event_array_type(message_type)


def choose_type(advertised: tuple[str, ...], current: str | None, not_installed: str = '') -> str | None:
    """Return the type to subscribe: the current one while anyone advertises it, else the first that can be read."""
    if current in advertised:
        return current
    return next((name for name in advertised if is_supported(name) and name != not_installed), None)


def message_class(message_type: str) -> Any:
    """Return the Python class of a type such as ``event_camera_msgs/msg/EventPacket``.

    Raises:
        ImportError: its package is not installed, or has no such message.
    """
    package, _, name = message_type.split('/')
    try:
        return getattr(import_module(f'{package}.msg'), name)
    except AttributeError as error:
        raise ImportError(f'{package}.msg has no {name}') from error


def subscribe_raw(
    node: Node,
    message_type: str,
    topic: str,
    callback: Callable[[bytes, dict[str, int]], None],
    qos: QoSProfile,
    events: SubscriptionEventCallbacks,
) -> Subscription:
    """Subscribe to a topic's CDR bytes; without ``events`` where the middleware does not know them.

    Raises:
        ImportError: the type's package is not installed.
    """
    cls = message_class(message_type)
    try:
        return node.create_subscription(cls, topic, callback, qos, raw=True, event_callbacks=events)
    except UnsupportedEventTypeError:
        return node.create_subscription(cls, topic, callback, qos, raw=True)


class MessageQueue:
    """The messages that wait in a raw subscription's queue, and a wait for the next one that costs no turn of an executor.

    A turn looks at every timer and subscription of the node and takes as long as reading a packet.
    """

    def __init__(self, node: Node, subscription: Subscription) -> None:
        self._subscription = subscription
        self._wait_set = _rclpy.WaitSet(1, 0, 0, 0, 0, 0, node.context.handle)

    def take(self, wait_s: float, rest: Callable[[], bool]) -> tuple[bytes, dict[str, int]] | None:
        """Return the message that waits longest, and its information; None if none comes within ``wait_s`` (s).

        ``rest`` is called while none is there, again and again until it returns False.
        """
        taken = self._take_one()
        while taken is None and rest():
            taken = self._take_one()
        if taken is None and wait_s > 0.0:
            self._wait_set.clear_entities()
            self._wait_set.add_subscription(self._subscription.handle)
            self._wait_set.wait(round(wait_s * NS_PER_S))
            taken = self._take_one()
        return taken

    def _take_one(self) -> tuple[bytes, dict[str, int]] | None:
        with self._subscription.handle:
            taken: tuple[bytes, dict[str, int]] | None = self._subscription.handle.take_message(
                self._subscription.msg_type, self._subscription.raw
            )
        return taken


def find_publishers(node: Node, topic: str, qos: QoSProfile) -> Publishers:
    """Look at the graph: the publishers of a resolved topic name, against the QoS we ask for."""
    infos = node.get_publishers_info_by_topic(topic)
    mismatches = [_mismatch(info, qos) for info in infos]
    return Publishers(
        types=tuple(info.topic_type for info in infos),
        incompatible='; '.join(filter(None, mismatches)) if mismatches and all(mismatches) else '',
    )


def similar_topics(node: Node, topic: str) -> tuple[str, ...]:
    """Return other topics that carry a type we can read, as ``name (type)``."""
    return tuple(
        f'{name} ({message_type})'
        for name, types in node.get_topic_names_and_types()
        for message_type in types
        if name != topic and is_supported(message_type)
    )[:MAX_HINTS]


def _mismatch(info: TopicEndpointInfo, qos: QoSProfile) -> str:
    compatibility, reason = qos_check_compatible(info.qos_profile, qos)
    if compatibility != QoSCompatibility.ERROR:
        return ''
    return f'{info.node_name} publishes {info.qos_profile.reliability.name.lower()} ({reason.strip().rstrip(";")})'
