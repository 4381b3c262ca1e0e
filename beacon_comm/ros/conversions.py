"""Core values to ROS messages: the only module that fills them in, and writes the one that is to be quick.

Times come in as :class:`~beacon_comm.ros.stamped.Instant`: the same instant on both clocks.
"""

from __future__ import annotations

import math
import struct
from array import array
from collections.abc import Sequence

from builtin_interfaces.msg import Time
from geometry_msgs.msg import Vector3
from numpy.typing import NDArray
from std_msgs.msg import Header

from beacon_comm.core.candidates import BeaconState
from beacon_comm.core.events import NS_PER_S
from beacon_comm.core.receiver import BeaconSnapshot
from beacon_comm.core.tracks import Covariance
from beacon_comm.msg import Beacon, Beacons, Bearing, Bearings, Confirmed, Text
from beacon_comm.ros.stamped import Instant, StampedCharacter
from beacon_comm.ros.text import BeaconText, printable
from beacon_comm.wire.cdr import ENCAPSULATION, packed_header

NAN = math.nan
UNKNOWN_COVARIANCE = (-1.0, 0.0, 0.0, 0.0)
_SEC_LOW, _SEC_HIGH = -(2**31), 2**31 - 1
_FLOAT32_MAX = (2.0 - 2.0**-23) * 2.0**127
# CDR of a Characters message (beacon_comm.wire.cdr); int64 stands at multiples of 8 behind the encapsulation.
_TIME_AND_COUNT = struct.Struct('<qI')
_TO_STAMP = struct.Struct('<IBB2xfiI')
_TO_RATIOS = struct.Struct('<qfI')


def time_message(t_ns: int) -> Time:
    """Return a time (ns) as a message; what its 32-bit seconds cannot hold is cut."""
    sec, nanosec = _seconds(t_ns)
    return Time(sec=sec, nanosec=nanosec)


def _seconds(t_ns: int) -> tuple[int, int]:
    sec, nanosec = divmod(t_ns, NS_PER_S)
    return min(max(sec, _SEC_LOW), _SEC_HIGH), nanosec


def header_message(at: Instant, frame_id: str) -> Header:
    """Return a header."""
    return Header(stamp=time_message(at.ros_ns), frame_id=frame_id)


def vector_message(vector: NDArray | None) -> Vector3:
    """Return a bearing ``(3,)``; NaN where there is none."""
    x, y, z = (NAN, NAN, NAN) if vector is None else (float(entry) for entry in vector)
    return Vector3(x=x, y=y, z=z)


def characters_cdr(at: Instant, frame_id: str, characters: Sequence[StampedCharacter]) -> bytes:
    """Return the characters that one packet gave: the CDR bytes of a ``Characters`` message.

    The one output that somebody waits for: to fill in the message, and let rclpy take it apart again, takes four times as long.
    """
    data = packed_header(*_seconds(at.ros_ns), frame_id)
    data += bytes(-len(data) % 8)
    data += _TIME_AND_COUNT.pack(at.sensor_ns, len(characters))
    for track_id, character, began in characters:
        status, confidence, ratios = int(character.status), _float32(character.confidence), character.bit_llr
        data += _TO_STAMP.pack(track_id, character.code, status, confidence, *_seconds(began.ros_ns))
        data += bytes(-len(data) % 8)
        data += _TO_RATIOS.pack(began.sensor_ns, _float32(character.bit_rate_bps), len(ratios))
        data += struct.pack(f'<{len(ratios)}f', *map(_float32, ratios))
    return ENCAPSULATION + data


def text_message(frame_id: str, text: BeaconText) -> Text:
    """Return what one beacon has said."""
    return Text(
        header=header_message(text.at, frame_id),
        sensor_time_ns=text.at.sensor_ns,
        track_id=text.track_id,
        first_index=text.first_index,
        codes=array('B', text.codes),
        statuses=array('B', text.statuses),
        text=printable(text.codes),
    )


def beacons_message(at: Instant, frame_id: str, beacons: Sequence[BeaconSnapshot], slots_full: bool) -> Beacons:
    """Return all tracks."""
    return Beacons(
        header=header_message(at, frame_id),
        sensor_time_ns=at.sensor_ns,
        slots_full=slots_full,
        beacons=[_beacon_message(beacon) for beacon in beacons],
    )


def _beacon_message(beacon: BeaconSnapshot) -> Beacon:
    return Beacon(
        track_id=beacon.track_id,
        state=int(beacon.state),
        quiet=bool(beacon.quiet),
        x_px=_float32(beacon.x_px),
        y_px=_float32(beacon.y_px),
        vx_px_per_s=_float32(beacon.vx_px_per_s),
        vy_px_per_s=_float32(beacon.vy_px_per_s),
        extent_px=_float32(beacon.extent_px),
        index=_float32(beacon.index),
        bit_rate_bps=NAN if beacon.bit_rate_bps is None else _float32(beacon.bit_rate_bps),
        bit_rate_std_bps=NAN if beacon.bit_rate_std_bps is None else _float32(beacon.bit_rate_std_bps),
        characters=beacon.characters,
        characters_ok=beacon.characters_ok,
        parity_errors=beacon.parity_errors,
        framing_errors=beacon.framing_errors,
        has_bearing=beacon.bearing is not None,
        bearing=vector_message(beacon.bearing),
        pixel_covariance=[_float32(entry) for entry in _covariance_message(beacon.pixel_covariance)],
    )


def _covariance_message(covariance: Covariance | None) -> tuple[float, ...]:
    return UNKNOWN_COVARIANCE if covariance is None else (*covariance[0], *covariance[1])


def bearings_message(at: Instant, frame_id: str, beacons: Sequence[BeaconSnapshot]) -> Bearings:
    """Return the bearings of the confirmed ones among ``beacons``."""
    confirmed = [beacon for beacon in beacons if beacon.state == BeaconState.CONFIRMED]
    return Bearings(
        header=header_message(at, frame_id),
        sensor_time_ns=at.sensor_ns,
        bearings=[_bearing_message(beacon) for beacon in confirmed],
    )


def _bearing_message(beacon: BeaconSnapshot) -> Bearing:
    return Bearing(
        track_id=beacon.track_id,
        x_px=_float32(beacon.x_px),
        y_px=_float32(beacon.y_px),
        has_bearing=beacon.bearing is not None,
        bearing=vector_message(beacon.bearing),
        azimuth_rad=NAN if beacon.azimuth_rad is None else float(beacon.azimuth_rad),
        elevation_rad=NAN if beacon.elevation_rad is None else float(beacon.elevation_rad),
        age_s=float(beacon.age_s),
        covariance=_covariance_message(beacon.angle_covariance),
    )


def confirmed_message(at: Instant, frame_id: str, track_ids: Sequence[int]) -> Confirmed:
    """Return the labels of the beacons that are confirmed now."""
    return Confirmed(header=header_message(at, frame_id), sensor_time_ns=at.sensor_ns, track_ids=list(track_ids))


def _float32(value: float) -> float:
    """Return a value the message's 32-bit field takes; what is too large for it becomes infinite."""
    value = float(value)
    return value if abs(value) <= _FLOAT32_MAX or math.isnan(value) else math.copysign(math.inf, value)
