"""Values with their time on both clocks: the event camera's and ROS's."""

from __future__ import annotations

from typing import NamedTuple

from beacon_comm.core.character import Character


class Instant(NamedTuple):
    """One instant on both clocks.

    Attributes:
        ros_ns: ROS time (ns).
        sensor_ns: the event camera's clock (ns).
    """

    ros_ns: int
    sensor_ns: int


class StampedCharacter(NamedTuple):
    """A character of a track, with the instant of its start edge."""

    track_id: int
    character: Character
    at: Instant
