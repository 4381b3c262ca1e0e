"""The node: event messages in, characters, texts, beacons, bearings and confirmations out.

::

    events ──────► on_message ─┐                      ┌─► ~/characters, ~/confirmed    at once
    (silence) ───► on_tick ────┴► LiveReceiver ► Step ┴─► ~/text, ~/beacons, ~/bearings  at publish_rate_hz
    camera_info ─► on_camera_info                         /diagnostics                  once a second
"""

from __future__ import annotations

import time
import traceback
from collections.abc import Callable
from contextlib import suppress
from functools import wraps
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
from rclpy.clock import Clock, ClockType, JumpThreshold
from rclpy.duration import Duration
from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy, qos_profile_sensor_data
from rclpy.subscription import Subscription
from sensor_msgs.msg import CameraInfo

from beacon_comm.compiling.warm_up import warm_up
from beacon_comm.core.errors import CalibrationError
from beacon_comm.core.events import NS_PER_S
from beacon_comm.core.receiver import BeaconSnapshot
from beacon_comm.msg import Beacons, Bearings, Characters, Confirmed, Text
from beacon_comm.ros import conversions
from beacon_comm.ros.camera import camera_of_message, load_camera
from beacon_comm.ros.diagnostics import diagnostics_message
from beacon_comm.ros.live import LiveReceiver, Step
from beacon_comm.ros.overload import Shedder
from beacon_comm.ros.parameters import read_parameters, unknown_parameters
from beacon_comm.ros.report import Report
from beacon_comm.ros.silence import Cause, Silence, Situation, why_silent
from beacon_comm.ros.text import Texts
from beacon_comm.ros.throttled_log import ThrottledLog
from beacon_comm.ros.topic import (
    MessageQueue,
    Publishers,
    choose_type,
    find_publishers,
    is_supported,
    message_class,
    similar_topics,
    subscribe_raw,
)
from beacon_comm.wire.stream import is_event_array_type

NODE_NAME = 'beacon_node'
GRAPH_PERIOD_S = 0.25
REPORT_PERIOD_S = 1.0
LONGEST_WAIT_S, LONGEST_TURN_S, LONGEST_SIMULATED_TURN_S = 0.02, 0.1, 0.005
"""Messages are read, and each waited for so long, before calibrations, the graph's news and requests have their turn; it comes
sooner for /clock where that tells the time, and for the middleware's word of lost messages where no seq does."""
FAILED_IN_A_ROW = 10
"""After so many messages that an internal error has kept from being read the stream is begun anew."""
LOG_PERIOD_NS = NS_PER_S
SILENCE_LOG_PERIOD_NS = 10 * NS_PER_S
ACKNOWLEDGED_WITHIN = Duration(nanoseconds=NS_PER_S // 5)


def guarded(callback: Callable[..., None]) -> Callable[..., None]:
    """Make a callback survive whatever goes wrong in it: counted and logged, and the node goes on."""

    @wraps(callback)
    def run(self: BeaconNode, *args: Any) -> None:
        try:
            callback(self, *args)
        except Exception:
            self.survive(callback.__name__)

    return run


def reliable(depth: int, durability: DurabilityPolicy = DurabilityPolicy.VOLATILE) -> QoSProfile:
    """Return the QoS of an output."""
    return QoSProfile(
        history=HistoryPolicy.KEEP_LAST, depth=depth, reliability=ReliabilityPolicy.RELIABLE, durability=durability
    )


class BeaconNode(Node):
    """See the module's head.

    Raises:
        ParameterError: a parameter is refused.
        CalibrationError: ``camera_info_file`` is refused.
    """

    def __init__(self, **options: Any) -> None:
        super().__init__(NODE_NAME, **options)
        self._core, self._own = read_parameters(self)
        for line in unknown_parameters(list(self._parameter_overrides)):
            self.get_logger().warning(line)
        self.report = Report()
        # rclpy allows one severity for each place in the source that logs, so every log is a place of its own.
        logger = self.get_logger()
        self.log_error = ThrottledLog(lambda text: logger.error(text), LOG_PERIOD_NS)
        self.log_warning = ThrottledLog(lambda text: logger.warning(text), LOG_PERIOD_NS)
        self._log_silence = ThrottledLog(lambda text: logger.warning(text), SILENCE_LOG_PERIOD_NS, counting=False)
        self._log_quiet = ThrottledLog(lambda text: logger.info(text), SILENCE_LOG_PERIOD_NS, counting=False)
        camera = load_camera(self._own.camera_info_file)
        if camera is None and not self._own.use_camera_info:
            self.get_logger().info('no calibration: bearings are pixels only (camera_info_file, use_camera_info)')
        self._warm_up()
        silent_after_ns = round(self._own.silent_clock_after_s * NS_PER_S)
        self._live = LiveReceiver(self._core, silent_after_ns, round(self._own.silent_clock_lag_s * NS_PER_S), camera)
        self._shedder = Shedder(round(self._own.max_lag_s * NS_PER_S))
        self._texts = Texts(self._own.text_codes)
        self._lost: list[BeaconSnapshot] = []
        self._topic = self.resolve_topic_name('events')
        self._type: str | None = None
        self._not_installed = ''
        self._found = Publishers()
        self._silence: Silence | None = None
        self._only_refused = False
        self._failed = 0  # messages in a row
        self._subscription: Subscription | None = None
        self._queue: MessageQueue | None = None
        self._make_publishers()
        self._make_inputs()
        self._publish_confirmed()
        self.get_logger().info(f'waiting for events on {self._topic}')

    def survive(self, where: str) -> None:
        """Count and log the exception that is being handled, and go on."""
        self.report.totals['internal_errors'] += 1
        with suppress(Exception):
            self.log_error('internal', f'in {where}: {traceback.format_exc()}', time.monotonic_ns())

    @guarded
    def _warm_up(self) -> None:
        warm_up(self._core)

    def _make_publishers(self) -> None:
        self._characters = self.create_publisher(Characters, '~/characters', reliable(1000))
        self._text = self.create_publisher(Text, '~/text', reliable(100))
        self._beacons = self.create_publisher(Beacons, '~/beacons', reliable(10))
        self._bearings = self.create_publisher(Bearings, '~/bearings', reliable(10))
        self._confirmed = self.create_publisher(Confirmed, '~/confirmed', reliable(1, DurabilityPolicy.TRANSIENT_LOCAL))
        self._diagnostics = self.create_publisher(DiagnosticArray, '/diagnostics', reliable(10))

    def _make_inputs(self) -> None:
        own = self._own
        self._qos = QoSProfile(
            history=HistoryPolicy.KEEP_LAST,
            depth=own.qos_depth,
            reliability=ReliabilityPolicy[own.qos_reliability.upper()],
            durability=DurabilityPolicy.VOLATILE,
        )
        if own.use_camera_info:
            self.create_subscription(CameraInfo, 'camera_info', self._on_camera_info, qos_profile_sensor_data)
        # Timers run on the steady clock: under use_sim_time the node's own may stand.
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        self._tick_s = own.silent_clock_after_s / 2.0
        self._prompt_timers = [
            self.create_timer(self._tick_s, self._on_tick, clock=steady),
            self.create_timer(1.0 / own.publish_rate_hz, self._on_publish, clock=steady),
        ]
        self._prompt_s = 0.0  # when to look at these again (s, monotonic clock)
        self.create_timer(GRAPH_PERIOD_S, self._on_graph, clock=steady)
        self.create_timer(REPORT_PERIOD_S, self._on_report, clock=steady)
        backwards = JumpThreshold(min_forward=None, min_backward=Duration(nanoseconds=-1), on_clock_change=True)
        self._jump = self.get_clock().create_jump_callback(
            backwards, post_callback=lambda _: self._live.clock_was_set()
        )

    # --- inputs ---

    @guarded
    def _on_message(self, cdr: bytes, info: dict[str, int]) -> None:
        # A turn of the executor takes longer than reading a packet: messages that wait, or come soon, are read in the same one.
        end_s = time.monotonic() + self._longest_turn_s()
        waiting: tuple[bytes, dict[str, int]] | None = (cdr, info)
        while waiting is not None:
            self._read(*waiting)
            waiting = self._next_message(min(end_s, time.monotonic() + LONGEST_WAIT_S))

    def _next_message(self, stop_s: float) -> tuple[bytes, dict[str, int]] | None:
        """Return the next message, None if none comes until ``stop_s`` (s, monotonic clock); publish and tick meanwhile."""
        waiting = None
        while waiting is None and self._queue is not None and (now_s := time.monotonic()) < stop_s:
            if now_s >= self._prompt_s:
                self._prompt_s = now_s + self._call_prompt_timers()
            waiting = self._queue.take(min(self._prompt_s, stop_s) - now_s, self._live.rest)
        return waiting

    def _longest_turn_s(self) -> float:
        if self.get_clock().ros_time_is_active:
            return LONGEST_SIMULATED_TURN_S
        return LONGEST_WAIT_S if self._type is not None and is_event_array_type(self._type) else LONGEST_TURN_S

    def _call_prompt_timers(self) -> float:
        """Call back, as the executor would, the timers that messages are not to hold up; return how long the next has (s)."""
        for timer in self._prompt_timers:
            if timer.is_ready():
                with timer.handle:
                    timer.handle.call_timer()
                timer.callback()
        return min(max(timer.time_until_next_call() or 0, 0) for timer in self._prompt_timers) / NS_PER_S

    @guarded
    def _read(self, cdr: bytes, info: dict[str, int]) -> None:
        # A middleware that does not stamp arrivals gives 0: then nothing is known to have waited.
        arrival_ns = info['received_timestamp'] or time.time_ns()
        waited_ns = time.time_ns() - arrival_ns
        begun_ns = time.monotonic_ns()  # the host's clock may be set meanwhile
        if self._shedder.sheds(waited_ns):
            self._live.shed(self._now_ns())
            self.report.shed()
            return
        if self._shedder.hurries(waited_ns):
            self._live.hurry()
        try:
            step = self._live.push(cdr, self._now_ns(), lambda early: self._give(early, arrival_ns))
        except Exception:
            self.survive('push')
            self._failed += 1
            if self._failed >= FAILED_IN_A_ROW:  # what is left of the state is of no use
                self._open_stream()
                self._failed = 0
            return
        self._failed = 0
        self.report.message(step, waited_ns / NS_PER_S)
        if step.lost_packets:
            self.log_warning('lost', f'{self._topic}: {step.lost_packets} packets lost', time.monotonic_ns())
        if step.problem is not None:
            self.log_warning(step.problem_kind, f'{self._topic}: {step.problem}', time.monotonic_ns())
        self._give(step, arrival_ns)
        took_ns = time.monotonic_ns() - begun_ns
        self._shedder.read(took_ns)
        self.report.published((waited_ns + took_ns) / NS_PER_S)

    @guarded
    def _give(self, step: Step, arrival_ns: int) -> None:
        """Publish what a message gave, or a part of it; it arrived at ``arrival_ns`` (ns, host)."""
        if step.end_ns is not None:
            self.report.latency.arrived(step.end_ns, arrival_ns)
        self._publish(step)
        self.report.latency.published(step.due_ns, time.time_ns())

    @guarded
    def _on_tick(self) -> None:
        step = self._live.tick(self._now_ns(), round(self._tick_s * NS_PER_S))
        if step is not None:
            self._publish(step)

    @guarded
    def _on_camera_info(self, message: CameraInfo) -> None:
        try:
            self._live.set_camera(camera_of_message(message))
        except CalibrationError as error:
            self.log_warning('camera_info', f'camera_info: {error}', time.monotonic_ns())

    # --- outputs ---

    def _publish(self, step: Step) -> None:
        """Publish what is due at once, keep the rest for the next turn of :meth:`_on_publish`."""
        self.report.characters(len(step.characters))
        if step.characters:
            self._characters.publish(conversions.characters_cdr(step.at, self._live.frame_id, step.characters))
            for character in step.characters:
                self._texts.add(character)
        self._lost += step.lost
        if step.confirmed_changed:
            self._publish_confirmed()

    def _publish_confirmed(self) -> None:
        at = self._live.now(self._now_ns())
        self._confirmed.publish(conversions.confirmed_message(at, self._live.frame_id, self._live.confirmed))

    @guarded
    def _on_publish(self) -> None:
        frame_id = self._live.frame_id
        if self._text.get_subscription_count():  # what grows meanwhile is published once somebody comes
            for text in self._texts.take_changed():
                self._text.publish(conversions.text_message(frame_id, text))
        self._texts.keep(self._live.track_ids)
        lost, self._lost = self._lost, []
        wants_beacons, wants_bearings = self._beacons.get_subscription_count(), self._bearings.get_subscription_count()
        if self._live.sensor_size is None or not (wants_beacons or wants_bearings):
            return
        at = self._live.now(self._now_ns())
        beacons = self._live.beacons()
        if wants_beacons:
            everything = (*beacons, *lost)
            self._beacons.publish(
                conversions.beacons_message(at, frame_id, everything, self._live.slots_full)
            )
        if wants_bearings:
            self._bearings.publish(conversions.bearings_message(at, frame_id, beacons))

    # --- the event topic ---

    @guarded
    def _on_graph(self) -> None:
        self._found = find_publishers(self, self._topic, self._qos)
        message_type = choose_type(self._found.types, self._type, self._not_installed)
        if message_type not in (None, self._type):
            self._subscribe(message_type)

    def _subscribe(self, message_type: str) -> None:
        events = SubscriptionEventCallbacks(matched=self._on_matched, message_lost=self._on_message_lost)
        try:
            message_class(message_type)
        except ImportError as error:
            self._not_installed = message_type
            self.get_logger().error(f'{self._topic} carries {message_type}, which is not installed here: {error}')
            return
        if self._subscription is not None:
            # Before the other one comes: the middleware refuses two types of one topic in one process.
            self.destroy_subscription(self._subscription)
            self._subscription, self._queue, self._type = None, None, None
        self._subscription = subscribe_raw(self, message_type, self._topic, self._on_message, self._qos, events)
        self._queue = MessageQueue(self, self._subscription)
        self._type, self._not_installed = message_type, ''
        self._open_stream()
        self.get_logger().info(f'reading {self._topic} ({message_type})')

    @guarded
    def _on_matched(self, status: Any) -> None:
        """Begin a new stream where a publisher comes after the last one had gone."""
        if status.current_count == status.current_count_change == 1:
            self._open_stream()
        elif status.current_count == 0:
            self._live.publisher_gone()

    def _open_stream(self) -> None:
        if self._type is not None:
            self._publish(self._live.open(self._type, self._now_ns()))

    @guarded
    def _on_message_lost(self, status: Any) -> None:
        self.report.totals['queue_overflow'] += status.total_count_change
        self._live.messages_lost()

    # --- report ---

    @guarded
    def _on_report(self) -> None:
        traffic, events, values = self.report.look(self._live, time.monotonic_ns())
        if traffic.only_refused and self._only_refused:
            self.get_logger().warning(f'{self._live.frame_id!r} is gone from {self._topic}: reading the other camera')
            self._open_stream()
        self._only_refused = traffic.only_refused
        unsubscribed = self._type not in self._found.types
        situation = Situation(
            topic=self._topic,
            advertised=self._found.types,
            supported=any(map(is_supported, self._found.types)),
            not_installed=self._not_installed if unsubscribed else '',
            incompatible=self._found.incompatible,
            similar=() if self._found.types else similar_topics(self, self._topic),
            messages=traffic.messages,
            events=events,
            bad_messages=traffic.bad_messages,
            shed=traffic.shed,
            problems=traffic.problem_text(),
            tracks=self._live.beacons(),
            index_threshold=self._live.index_threshold,
        )
        silence = why_silent(situation)
        if silence is not None and silence.cause is Cause.OVERLOADED:
            self.log_warning('overload', silence.text, time.monotonic_ns())
        elif silence is not None and self._silence is not None and silence.cause is self._silence.cause:
            log = self._log_silence if silence.cause.is_fault else self._log_quiet
            log(silence.cause.name, silence.text, time.monotonic_ns())
        self._silence = silence
        if self._live.camera_problem:
            self._log_silence('camera', f'no bearings: {self._live.camera_problem}', time.monotonic_ns())
        values = {'topic': self._topic, 'type': self._type or '', 'calibrated': self._live.calibrated, **values}
        self._diagnostics.publish(
            diagnostics_message(
                self.get_clock().now().to_msg(), f'{self.get_name()}: events', self._live.frame_id, silence, values
            )
        )

    def close(self) -> None:
        """End the stream: publish what is still held, and wait a moment for it to arrive."""
        self._flush()
        self._queue = None
        for publisher in (self._characters, self._text, self._confirmed):
            publisher.wait_for_all_acked(ACKNOWLEDGED_WITHIN)

    @guarded
    def _flush(self) -> None:
        self._publish(self._live.flush(self._now_ns()))
        self._on_publish()

    def _now_ns(self) -> int:
        clock = self.get_clock()
        return clock.now().nanoseconds if clock.ros_time_is_active else time.time_ns()
