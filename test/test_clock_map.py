"""The node's two maps of time: sensor clock to ROS time, and a silent topic's stream time."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from beacon_comm.core.events import EventBatch
from beacon_comm.ros.clock_map import MAX_ANCHORS, STEP_NS, ClockMap
from beacon_comm.ros.stream_time import LONGEST_LEARNT_LAG_NS, StreamTime

MS = 1_000_000
S = 1000 * MS
START = 2**40
STAMP = 1_700_000_000 * S


def batch(*t_ns: int, end_ns: int | None = None) -> EventBatch:
    times = np.array(t_ns, np.int64)
    zeros = np.zeros(len(times), np.uint16)
    return EventBatch(zeros, zeros, np.ones(len(times), np.int8), times, int(times[-1]) if end_ns is None else end_ns)


# --- sensor clock to ROS time ---


def test_a_stamp_is_the_packets_stamp_plus_the_offset_from_its_first_event() -> None:
    clock_map = ClockMap()
    clock_map.observe(STAMP, START)
    clock_map.observe(STAMP + 10 * MS + 3, START + 10 * MS)
    assert clock_map.ros_ns(START + 4 * MS) == STAMP + 4 * MS
    assert clock_map.ros_ns(START + 10 * MS) == STAMP + 10 * MS + 3
    assert clock_map.ros_ns(START + 12 * MS + 1) == STAMP + 12 * MS + 4


def test_a_time_before_the_first_packet_is_mapped_by_it() -> None:
    clock_map = ClockMap()
    clock_map.observe(STAMP, START)
    assert clock_map.ros_ns(START - 5 * MS) == STAMP - 5 * MS


def test_without_a_packet_there_is_no_ros_time() -> None:
    with pytest.raises(ValueError, match='no anchor'):
        ClockMap().ros_ns(START)


@given(st.lists(st.integers(-20, 40), min_size=1, max_size=40))
def test_the_map_never_runs_backwards_under_jitter(jitters_ms: list[int]) -> None:
    clock_map = ClockMap()
    answers = []
    for k, jitter_ms in enumerate(jitters_ms):
        clock_map.observe(STAMP + (10 * k + jitter_ms) * MS, START + 10 * k * MS)
        answers += [clock_map.ros_ns(START + (10 * k + step) * MS) for step in range(0, 10, 3)]
    assert answers == sorted(answers)
    again = [clock_map.ros_ns(START + t * MS) for t in range(10 * len(jitters_ms))]
    assert again == sorted(again)


def test_headers_never_run_backwards_when_a_silence_was_carried_on_too_far() -> None:
    clock_map = ClockMap()
    clock_map.observe(STAMP, START)
    ahead_ns = clock_map.header_ns(START + 300 * MS)
    clock_map.observe(STAMP + 100 * MS, START + 100 * MS)
    assert clock_map.header_ns(START + 101 * MS) == ahead_ns
    assert clock_map.header_ns(START + 400 * MS) == STAMP + 400 * MS


def test_a_clock_that_was_set_back_is_followed() -> None:
    clock_map = ClockMap()
    clock_map.observe(STAMP, START)
    clock_map.header_ns(START)
    clock_map.observe(STAMP - 100 * S, START + 10 * MS)
    assert clock_map.ros_ns(START + 11 * MS) == STAMP - 100 * S + 1 * MS
    assert clock_map.header_ns(START + 11 * MS) == STAMP - 100 * S + 1 * MS


def test_a_sensor_that_was_restarted_is_followed() -> None:
    clock_map = ClockMap()
    clock_map.observe(STAMP, START)
    clock_map.observe(STAMP + 5 * S, 0)
    assert clock_map.ros_ns(1) == STAMP + 5 * S + 1


def test_after_renew_the_next_packet_alone_counts() -> None:
    clock_map = ClockMap()
    clock_map.observe(STAMP, START)
    clock_map.renew()
    assert clock_map.ros_ns(START) == STAMP  # until then the old one holds
    clock_map.observe(STAMP - STEP_NS // 2, START + MS)
    assert clock_map.ros_ns(START + MS) == STAMP - STEP_NS // 2


def test_memory_is_bounded() -> None:
    clock_map = ClockMap()
    for k in range(3 * MAX_ANCHORS):
        clock_map.observe(STAMP + k * MS, START + k * MS)
    assert len(clock_map._sensor_ns) <= MAX_ANCHORS
    assert clock_map.ros_ns(START + 3 * MAX_ANCHORS * MS) == STAMP + 3 * MAX_ANCHORS * MS


# --- the stream's time ---

WAIT = 50 * MS
LAG = 100 * MS
PERIOD = 25 * MS


def carry_on(time: StreamTime, from_ns: int, until_ns: int) -> list[int]:
    """Tick through a silence; return the times that were announced."""
    ticks = [time.tick(now_ns, PERIOD) for now_ns in range(from_ns + PERIOD, until_ns + 1, PERIOD)]
    assert all(tick is None or len(tick) == 0 for tick in ticks)
    return [tick.t_end_ns for tick in ticks if tick is not None]


def test_packets_on_time_pass_unchanged() -> None:
    time = StreamTime(WAIT, LAG)
    for k in range(5):
        packet = batch(START + k * 10 * MS, START + (k * 10 + 9) * MS)
        assert time.admit(packet, STAMP + k * 10 * MS) is packet
        assert time.tick(STAMP + k * 10 * MS + MS, PERIOD) is None
    assert time.late_packets == 0
    assert time.sensor_ns(START + 7) == START + 7


def test_a_silent_topic_is_carried_on_behind_the_clock() -> None:
    time = StreamTime(WAIT, LAG)
    time.admit(batch(START), STAMP)
    announced = carry_on(time, STAMP, STAMP + 200 * MS)
    assert announced == [START + 25 * MS * k for k in range(1, 5)]


def test_a_packet_late_by_less_than_the_lag_does_no_harm() -> None:
    time = StreamTime(WAIT, LAG)
    time.admit(batch(START), STAMP)
    carry_on(time, STAMP, STAMP + LAG)
    late = batch(START + 1 * MS, START + 4 * MS)
    assert time.admit(late, STAMP + LAG) is late
    assert time.late_packets == 0


def test_a_topic_without_a_publisher_is_not_waited_for() -> None:
    time = StreamTime(WAIT, LAG)
    time.admit(batch(START), STAMP)
    time.publisher_gone()
    assert carry_on(time, STAMP, STAMP + 100 * MS) == [START + 25 * MS, START + 50 * MS]


def test_a_stream_that_ends_is_carried_on_up_to_the_clock() -> None:
    time = StreamTime(WAIT, LAG)
    assert time.finish() is None
    time.admit(batch(START), STAMP)
    assert carry_on(time, STAMP, STAMP + 75 * MS) == []
    end = time.finish()
    assert end is not None and end.t_end_ns == START + 75 * MS
    assert time.finish() is None


def test_nothing_is_announced_before_the_first_packet() -> None:
    time = StreamTime(WAIT, LAG)
    assert time.tick(STAMP, PERIOD) is None


def test_a_clock_that_stands_announces_nothing() -> None:
    time = StreamTime(WAIT, LAG)
    time.admit(batch(START), STAMP)
    assert all(time.tick(STAMP, PERIOD) is None for _ in range(100))


def test_a_clock_that_runs_fast_or_jumps_announces_no_more_than_the_ticks() -> None:
    time = StreamTime(WAIT, LAG)
    time.admit(batch(START), STAMP)
    announced = [time.tick(STAMP + k * 10 * S, PERIOD) for k in range(1, 7)]
    assert [tick.t_end_ns - START for tick in announced if tick is not None] == [25 * MS, 50 * MS]


def test_a_clock_that_jumps_back_does_no_harm() -> None:
    time = StreamTime(WAIT, LAG)
    time.admit(batch(START), STAMP)
    assert time.tick(STAMP - 1000 * S, PERIOD) is None
    assert carry_on(time, STAMP - 1000 * S, STAMP - 1000 * S + 200 * MS)


def test_a_late_packet_keeps_its_shape_and_its_sensor_time() -> None:
    time = StreamTime(WAIT, LAG)
    time.admit(batch(START), STAMP)
    announced_ns = carry_on(time, STAMP, STAMP + 200 * MS)[-1]
    late = batch(START + 1 * MS, START + 4 * MS, end_ns=START + 10 * MS)
    admitted = time.admit(late, STAMP + 205 * MS)
    assert admitted.t_ns[0] == announced_ns
    np.testing.assert_array_equal(np.diff(admitted.t_ns), np.diff(late.t_ns))
    assert [time.sensor_ns(int(t)) for t in admitted.t_ns] == late.t_ns.tolist()
    assert time.sensor_ns(START - 1) == START - 1  # what came before is not shifted
    assert time.late_packets == 1


def test_a_topic_with_slow_packets_is_late_once() -> None:
    time = StreamTime(WAIT, LAG)
    for k in range(20):
        time.admit(batch(START + 150 * k * MS, end_ns=START + 150 * (k + 1) * MS - 1), STAMP + 150 * k * MS)
        carry_on(time, STAMP + 150 * k * MS, STAMP + 150 * (k + 1) * MS)
    assert time.late_packets <= 1


def test_a_paused_bag_is_late_once_and_goes_on() -> None:
    time = StreamTime(WAIT, LAG)
    time.admit(batch(START), STAMP)
    carry_on(time, STAMP, STAMP + 10 * S)
    now_ns = STAMP + 10 * S
    for k in range(50):
        admitted = time.admit(batch(START + (1 + 10 * k) * MS), now_ns + 10 * k * MS)
        assert time.sensor_ns(int(admitted.t_ns[0])) == START + (1 + 10 * k) * MS
    assert time.late_packets == 1
    assert time._lag_ns <= LONGEST_LEARNT_LAG_NS


def test_a_packet_without_events_never_takes_the_time_back() -> None:
    time = StreamTime(WAIT, LAG)
    time.admit(batch(START), STAMP)
    announced_ns = carry_on(time, STAMP, STAMP + 200 * MS)[-1]
    assert time.admit(batch(end_ns=START + MS), STAMP + 201 * MS).t_end_ns == announced_ns
    assert time.late_packets == 0


@settings(deadline=None)
@given(
    st.lists(
        st.tuples(
            st.integers(0, 400),  # silence before the packet (ms)
            st.integers(-300, 5),  # how much later or earlier than the silence its events are (ms)
            st.lists(st.integers(0, 10), max_size=4),  # gaps between its events (ms)
        ),
        min_size=1,
        max_size=12,
    )
)
def test_the_stream_never_breaks_its_word(packets: list[tuple[int, int, list[int]]]) -> None:
    time = StreamTime(WAIT, LAG)
    now_ns, sensor_ns, announced_ns = STAMP, START, -(2**63)
    for silence_ms, offset_ms, gaps_ms in packets:
        for end_ns in carry_on(time, now_ns, now_ns + silence_ms * MS):
            assert end_ns > announced_ns
            announced_ns = end_ns
        now_ns += silence_ms * MS
        sensor_ns += max(0, silence_ms + offset_ms) * MS
        times = (sensor_ns + np.cumsum(np.array(gaps_ms, np.int64)) * MS).tolist()
        sensor_ns = times[-1] if times else sensor_ns
        admitted = time.admit(batch(*times, end_ns=sensor_ns), now_ns)
        assert admitted.t_end_ns >= announced_ns
        assert all(announced_ns <= t <= admitted.t_end_ns for t in admitted.t_ns.tolist())
        assert [time.sensor_ns(int(t)) for t in admitted.t_ns] == times
        announced_ns = admitted.t_end_ns


def test_what_is_missing_is_shifted_with_its_packet() -> None:
    time = StreamTime(WAIT, LAG)
    time.admit(batch(START), STAMP)
    announced_ns = carry_on(time, STAMP, STAMP + 200 * MS)[-1]
    late = replace(batch(START + 1 * MS, START + 4 * MS), missing_until_ns=START + 1 * MS)
    assert time.admit(late, STAMP + 205 * MS).missing_until_ns == announced_ns


def test_a_topic_whose_packets_are_shed_is_not_silent() -> None:
    time = StreamTime(WAIT, LAG)
    time.hear(STAMP)
    time.admit(batch(START), STAMP)
    now_ns = STAMP
    for _ in range(100):
        now_ns += 20 * MS
        time.hear(now_ns)
        assert not carry_on(time, now_ns, now_ns + 20 * MS)
