"""The node's state as a diagnostic_msgs/DiagnosticArray, once a second on ``/diagnostics``."""

from __future__ import annotations

from collections.abc import Mapping

from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue

from beacon_comm.ros.silence import Silence


def diagnostics_message(
    stamp: Time, name: str, hardware_id: str, silence: Silence | None, values: Mapping[str, object]
) -> DiagnosticArray:
    """Return the node's state: OK, or WARN with why it is silent, and its counts."""
    fault = silence is not None and silence.cause.is_fault
    status = DiagnosticStatus(
        level=DiagnosticStatus.WARN if fault else DiagnosticStatus.OK,
        name=name,
        hardware_id=hardware_id,
        message='beacons confirmed' if silence is None else silence.text,
        values=[KeyValue(key=key, value=str(value)) for key, value in values.items()],
    )
    array = DiagnosticArray(status=[status])
    array.header.stamp = stamp
    return array
