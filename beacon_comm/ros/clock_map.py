"""The node's clock map: from the sensor's clock to ROS time.

Every packet ties the two clocks together at one point, its *anchor*::

    ROS time   = header.stamp + (event time - the packet's first event time)

    ROS ▲                      · anchor 2 (late: what follows is later, too)
        │              ·  ·  ·
        │       ·─────┘ flat: anchor 1 was early, and time never runs backwards
        │    · anchor 1
        │  · anchor 0
        └──────────────────────────────► sensor

An event time is mapped by the last anchor at or before it, so a character that began some packets ago gets the stamp
of *its* packet.  Where a stamp is early against the one before it (the host's jitter) the map is held level until it
has caught up; a stamp that is early by more than ``STEP_NS`` is a clock that was set, and the map starts anew.
"""

from __future__ import annotations

from bisect import bisect_right

STEP_NS = 1_000_000_000
MAX_ANCHORS = 8192


class ClockMap:
    """Sensor time (ns) to ROS time (ns), non-decreasing."""

    def __init__(self) -> None:
        self._last_header_ns: int | None = None
        self._forget_anchors()

    def renew(self) -> None:
        """Start anew with the next anchor: one of the two clocks was set.  Until then the old ones hold."""
        self._renewing = True

    def _forget_anchors(self) -> None:
        self._renewing = False
        self._sensor_ns: list[int] = []
        self._stamp_ns: list[int] = []
        self._floor_ns: list[int] = []

    @property
    def ready(self) -> bool:
        """Whether there is an anchor."""
        return bool(self._sensor_ns)

    def observe(self, stamp_ns: int, sensor_ns: int) -> None:
        """Tie ROS time ``stamp_ns`` to sensor time ``sensor_ns``: a packet's stamp and its first event's time."""
        floor_ns = self.ros_ns(sensor_ns) if self.ready else stamp_ns
        if self.ready and (self._renewing or sensor_ns < self._sensor_ns[-1] or stamp_ns < floor_ns - STEP_NS):
            self._forget_anchors()
            floor_ns = stamp_ns
        self._sensor_ns.append(sensor_ns)
        self._stamp_ns.append(stamp_ns)
        self._floor_ns.append(floor_ns)
        if len(self._sensor_ns) > MAX_ANCHORS:
            for anchors in (self._sensor_ns, self._stamp_ns, self._floor_ns):
                del anchors[: MAX_ANCHORS // 2]

    def ros_ns(self, sensor_ns: int) -> int:
        """Return the ROS time (ns) of a sensor time (ns); before the oldest anchor by the oldest.

        Raises:
            ValueError: there is no anchor yet.
        """
        if not self.ready:
            raise ValueError('the clock map has no anchor yet')
        k = max(0, bisect_right(self._sensor_ns, sensor_ns) - 1)
        by_stamp_ns = self._stamp_ns[k] + (sensor_ns - self._sensor_ns[k])
        return by_stamp_ns if sensor_ns < self._sensor_ns[k] else max(self._floor_ns[k], by_stamp_ns)

    def header_ns(self, sensor_ns: int) -> int:
        """Return the ROS time (ns) for a message's header: as :meth:`ros_ns`, non-decreasing from call to call.

        It differs where a silent stream's time had been carried on by the clock and the next stamp was earlier.
        """
        ros_ns = self.ros_ns(sensor_ns)
        if self._last_header_ns is not None and ros_ns < self._last_header_ns <= ros_ns + STEP_NS:
            ros_ns = self._last_header_ns
        self._last_header_ns = ros_ns
        return ros_ns
