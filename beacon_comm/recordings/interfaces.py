"""Definitions of the event messages, for bags: what recordings embed, and what ROS 1 conversion goes by.

Fields in wire order.  ``event_array_msgs/msg/EventArray`` is the former name of ``EventPacket``: the same fields.
"""

from __future__ import annotations

from beacon_comm.wire.stream import PACKET_TYPES, is_event_array_type

PACKET_TYPE = 'event_camera_msgs/msg/EventPacket'

_PACKET = """std_msgs/Header header
uint32 height
uint32 width
uint64 seq
uint64 time_base
string encoding
bool is_bigendian
uint8[] events
"""

_ARRAY = """std_msgs/Header header
uint32 height
uint32 width
Event[] events
"""

_EVENT = """uint16 x
uint16 y
builtin_interfaces/Time ts
bool polarity
"""

_HEADER = """builtin_interfaces/Time stamp
string frame_id
"""

_TIME = """int32 sec
uint32 nanosec
"""

def is_event_type(message_type: str) -> bool:
    """Return whether messages of this type hold events."""
    return message_type in PACKET_TYPES or is_event_array_type(message_type)


def definitions(message_type: str) -> dict[str, str]:
    """Return the text of an event message's definition and of all that it needs, by full type name.

    Raises:
        KeyError: not an event message.
    """
    needed = {'std_msgs/msg/Header': _HEADER, 'builtin_interfaces/msg/Time': _TIME}
    if message_type in PACKET_TYPES:
        return {message_type: _PACKET, **needed}
    if is_event_array_type(message_type):
        package = message_type.partition('/')[0]
        return {message_type: _ARRAY, f'{package}/msg/Event': _EVENT, **needed}
    raise KeyError(message_type)


def definition_text(message_type: str) -> str:
    """Return the definition as bags embed it (ros2msg): the message, then each part below a line of 80 ``=``."""
    first, *others = definitions(message_type).items()
    parts = [first[1], *(f'MSG: {name.replace("/msg/", "/")}\n{text}' for name, text in others)]
    return ('=' * 80 + '\n').join(parts)
