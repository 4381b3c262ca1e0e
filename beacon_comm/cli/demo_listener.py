"""The demo's third process: listens to the node and prints what each beacon says, line by line, as it comes."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from beacon_comm.cli.demo_verdict import Heard
from beacon_comm.cli.interrupts import interrupts_held
from beacon_comm.core.character import Character, Status

NODE = '/beacon_node'
LINE_CHARACTERS = 64
LINE_FEED = 10
OBSERVED_WITHIN_S = 0.1  # what is predicted for longer says nothing about the path
SILENCE_S = 0.5  # ends a line, too
_SPIN_S = 0.05
_UNREADABLE = '·'  # stands for a character whose parity or framing failed, or that cannot be printed


@dataclass
class _Line:
    """A line that is being heard: its text, where its beacon was last, and when that was (monotonic s)."""

    text: str = ''
    where: str = ''
    heard_s: float = 0.0


class Listener:
    """Subscribes to the node's topics.

    Attributes:
        tracks: what was heard, by track_id.
        lost_packets: as the node counted them last; None: it has not said.
        heard_s: monotonic time (s) of the last character.
    """

    def __init__(self, print_line: Callable[[str], None]) -> None:
        import rclpy
        from diagnostic_msgs.msg import DiagnosticArray
        from rclpy.executors import SingleThreadedExecutor
        from rclpy.signals import SignalHandlerOptions

        from beacon_comm.msg import Beacons, Bearings, Characters, Text

        self.tracks: dict[int, Heard] = {}
        self.lost_packets: int | None = None
        self.heard_s = time.monotonic()
        self._print_line = print_line
        self._bearings: dict[int, Any] = {}
        self._bit_rates: dict[int, float] = {}
        self._pending: dict[int, _Line] = {}
        self._printed: dict[int, int] = {}
        rclpy.init(args=[], signal_handler_options=SignalHandlerOptions.NO)
        self._node = rclpy.create_node('beacon_demo')
        for kind, topic, take in (
            (Characters, 'characters', self._take_characters),
            (Text, 'text', self._take_text),
            (Bearings, 'bearings', self._take_bearings),
            (Beacons, 'beacons', self._take_beacons),
        ):
            self._node.create_subscription(kind, f'{NODE}/{topic}', take, 1000)
        self._node.create_subscription(DiagnosticArray, '/diagnostics', self._take_diagnostics, 10)
        self._executor = SingleThreadedExecutor()
        self._executor.add_node(self._node)

    def node_is_up(self) -> bool:
        """Return whether the node's publishers have been discovered."""
        return all(
            self._node.count_publishers(f'{NODE}/{topic}') for topic in ('characters', 'text', 'bearings', 'beacons')
        )

    def spin_once(self) -> None:
        """Take what has arrived, or wait a moment for it."""
        with interrupts_held():
            self._executor.spin_once(timeout_sec=_SPIN_S)
        silent_since_s = time.monotonic() - SILENCE_S
        for track_id in [key for key, line in self._pending.items() if line.heard_s < silent_since_s]:
            self._flush(track_id)

    def finish(self) -> None:
        """Print the lines that have no end yet."""
        for track_id in sorted(self._pending):
            self._flush(track_id)

    def close(self) -> None:
        """End the ROS side."""
        import rclpy

        self._executor.shutdown()
        self._node.destroy_node()
        rclpy.try_shutdown()

    def _track(self, track_id: int) -> Heard:
        return self.tracks.setdefault(track_id, Heard(track_id))

    def _take_characters(self, message: Any) -> None:
        self.heard_s = time.monotonic()
        for c in message.characters:
            status = Status(c.status)
            self._track(c.track_id).characters.append(
                Character(c.sensor_time_ns, c.code, status, c.confidence, 0, c.bit_rate_bps)
            )

    def _take_bearings(self, message: Any) -> None:
        for bearing in message.bearings:
            self._bearings[bearing.track_id] = bearing
            if bearing.age_s <= OBSERVED_WITHIN_S or not self._track(bearing.track_id).path:
                self._track(bearing.track_id).path.append((message.sensor_time_ns, bearing.x_px, bearing.y_px))

    def _take_beacons(self, message: Any) -> None:
        for beacon in message.beacons:
            self._bit_rates[beacon.track_id] = beacon.bit_rate_bps

    def _take_diagnostics(self, message: Any) -> None:
        for status in message.status:
            for value in status.values:
                if value.key == 'lost_packets':
                    self.lost_packets = int(value.value)

    def _take_text(self, message: Any) -> None:
        track_id = message.track_id
        if track_id not in self._bearings:
            return  # a candidate's text is shown once it is confirmed, from its begin
        skipped = max(self._printed.get(track_id, 0) - message.first_index, 0)
        self._printed[track_id] = message.first_index + len(message.codes)
        for code, status in zip(message.codes[skipped:], message.statuses[skipped:], strict=True):
            readable = status in (Status.OK, Status.REPAIRED)
            if readable and code == LINE_FEED:
                self._flush(track_id)
                continue
            line = self._pending.setdefault(track_id, _Line())
            line.text += chr(code) if readable and 32 <= code < 127 else _UNREADABLE
            line.where, line.heard_s = self._where(track_id), time.monotonic()
            if len(line.text) >= LINE_CHARACTERS:
                self._flush(track_id)

    def _flush(self, track_id: int) -> None:
        line = self._pending.pop(track_id, None)
        if line is not None:
            self._print_line(f'beacon {track_id:<3} {line.where}  {line.text}')

    def _where(self, track_id: int) -> str:
        bearing = self._bearings[track_id]
        rate_bps = self._bit_rates.get(track_id, math.nan)
        pixel = f'{rate_bps:7.1f} bps  ({bearing.x_px:5.1f}, {bearing.y_px:5.1f}) px'
        if not bearing.has_bearing:
            return pixel
        azimuth, elevation = math.degrees(bearing.azimuth_rad), math.degrees(bearing.elevation_rad)
        return f'{pixel}  az {azimuth:+6.2f}° el {elevation:+6.2f}°'
