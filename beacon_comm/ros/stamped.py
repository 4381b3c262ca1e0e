"""Values with their time on both clocks: the event camera's and ROS's."""

from __future__ import annotations

from dataclasses import dataclass

from beacon_comm.core.character import Character


@dataclass(frozen=True, slots=True)
class Instant:
    """One instant on both clocks.

    Attributes:
        ros_ns: ROS time (ns).
        sensor_ns: the event camera's clock (ns).
    """

    ros_ns: int
    sensor_ns: int


@dataclass(frozen=True, slots=True)
class StampedCharacter:
    """A character of a track, with the instant of its start edge."""

    track_id: int
    character: Character
    at: Instant
