"""Core values to messages, the printable text, the reasons for silence, and where a calibration is found."""

import math
import re
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip('rclpy')

from beacon_comm.msg import Character as CharacterMessage  # noqa: E402
from beacon_comm.msg import Characters  # noqa: E402
from hypothesis import given  # noqa: E402
from hypothesis import strategies as st  # noqa: E402
from rclpy.serialization import deserialize_message  # noqa: E402
from sensor_msgs.msg import CameraInfo  # noqa: E402
from std_msgs.msg import Header  # noqa: E402

from beacon_comm.core.candidates import BeaconState  # noqa: E402
from beacon_comm.core.character import Character, Status  # noqa: E402
from beacon_comm.core.errors import CalibrationError  # noqa: E402
from beacon_comm.core.events import NS_PER_S  # noqa: E402
from beacon_comm.core.receiver import BeaconSnapshot  # noqa: E402
from beacon_comm.ros import conversions  # noqa: E402
from beacon_comm.ros.beacon_node import FAILED_IN_A_ROW, BeaconNode, guarded  # noqa: E402
from beacon_comm.ros.camera import camera_of_message, load_camera, resolve_url  # noqa: E402
from beacon_comm.ros.overload import Shedder  # noqa: E402
from beacon_comm.ros.report import Report  # noqa: E402
from beacon_comm.ros.silence import Cause, Situation, why_silent  # noqa: E402
from beacon_comm.ros.stamped import Instant, StampedCharacter  # noqa: E402
from beacon_comm.ros.text import Texts, printable  # noqa: E402
from beacon_comm.ros.throttled_log import ThrottledLog  # noqa: E402
from beacon_comm.ros.topic import choose_type, message_class  # noqa: E402

AT = Instant(1_700_000_000_123_456_789, 2**40)


def character(code: int = ord('S'), track_id: int = 7, status: Status = Status.OK) -> StampedCharacter:
    return StampedCharacter(track_id, Character(2**40, code, status, 0.75, 0b01010011011, 503.8), AT)


def beacon(**changes: object) -> BeaconSnapshot:
    values: dict[str, object] = {
        'track_id': 3, 'state': BeaconState.CONFIRMED, 'quiet': False, 't_ns': 2**40, 'x_px': 100.5, 'y_px': 50.25,
        'vx_px_per_s': 1.0, 'vy_px_per_s': -2.0, 'extent_px': 4.0, 'index': 6.0, 'bit_rate_bps': 504.0,
        'bit_rate_std_bps': 0.01,
        'confirmed_at_ns': 2**40, 'characters': 20, 'characters_ok': 18, 'parity_errors': 1, 'framing_errors': 1,
        'bearing': np.array([0.0, 0.6, 0.8]), 'azimuth_rad': 0.1, 'elevation_rad': -0.2, 'age_s': 0.03,
        'pixel_covariance': ((0.01, 0.001), (0.001, 0.02)), 'angle_covariance': ((4e-8, 1e-9), (1e-9, 5e-8)),
    }
    return BeaconSnapshot(**{**values, **changes})  # type: ignore[arg-type]


# --- messages ---


@given(st.integers(-(2**31) * 10**9, (2**31 - 1) * 10**9))
def test_a_time_survives(t_ns: int) -> None:
    message = conversions.time_message(t_ns)
    assert message.sec * 10**9 + message.nanosec == t_ns
    assert 0 <= message.nanosec < 10**9


def test_a_time_beyond_the_message_is_cut() -> None:
    assert conversions.time_message(2**62).sec == 2**31 - 1


def test_a_character_keeps_every_field() -> None:
    characters = [character(), character(10, 8, Status.PARITY_ERROR)]
    message = deserialize_message(conversions.characters_cdr(AT, 'camera', characters), Characters)
    assert message.header.frame_id == 'camera'
    assert message.sensor_time_ns == 2**40
    first, second = message.characters
    assert (first.track_id, first.code, first.status) == (7, ord('S'), first.OK)
    assert (second.track_id, second.code, second.status) == (8, 10, second.PARITY_ERROR)
    assert (first.confidence, first.sensor_time_ns) == (0.75, 2**40)
    assert first.bit_rate_bps == pytest.approx(503.8)
    assert (first.stamp.sec, first.stamp.nanosec) == (1_700_000_000, 123_456_789)


@given(
    frame_id=st.text(st.characters(exclude_characters='\0', codec='utf-8'), max_size=20),
    t_ns=st.integers(-(2**31) * 10**9, (2**31 - 1) * 10**9),
    codes=st.lists(st.integers(0, 255), max_size=4),
    ratios=st.lists(st.floats(width=32, allow_nan=False), max_size=13),
    rate_bps=st.floats(width=32, allow_nan=False),
)
def test_the_bytes_of_characters_are_read_as_the_message_that_they_stand_for(
    frame_id: str, t_ns: int, codes: list[int], ratios: list[float], rate_bps: float
) -> None:
    at = Instant(t_ns, -t_ns)
    characters = [
        StampedCharacter(k, Character(t_ns, code, Status.REPAIRED, 0.5, 0, rate_bps, tuple(ratios[: code % 14])), at)
        for k, code in enumerate(codes)
    ]
    stamp = conversions.time_message(t_ns)
    expected = Characters(header=Header(stamp=stamp, frame_id=frame_id), sensor_time_ns=-t_ns)
    expected.characters = [
        CharacterMessage(
            track_id=k, code=code, status=CharacterMessage.REPAIRED, confidence=0.5, stamp=stamp, sensor_time_ns=-t_ns,
            bit_rate_bps=rate_bps, bit_llr=ratios[: code % 14],
        )
        for k, code in enumerate(codes)
    ]  # fmt: skip
    assert deserialize_message(conversions.characters_cdr(at, frame_id, characters), Characters) == expected


def test_the_states_and_statuses_are_those_of_the_messages() -> None:
    for state in BeaconState:
        assert getattr(conversions.Beacon, state.name) == state
    for status in Status:
        assert getattr(CharacterMessage, status.name) == status


def test_a_calibrated_beacon_has_a_bearing() -> None:
    message = conversions.beacons_message(AT, 'camera', [beacon()], slots_full=True)
    assert message.slots_full
    assert message.beacons[0].has_bearing
    assert (message.beacons[0].bearing.y, message.beacons[0].bearing.z) == (0.6, 0.8)
    assert message.beacons[0].beacon_id == ''
    (bearing,) = conversions.bearings_message(AT, 'camera', [beacon()]).bearings
    assert (bearing.azimuth_rad, bearing.elevation_rad, bearing.age_s) == (0.1, -0.2, 0.03)
    assert bearing.covariance.tolist() == [4e-8, 1e-9, 1e-9, 5e-8]
    assert message.beacons[0].pixel_covariance.tolist() == pytest.approx([0.01, 0.001, 0.001, 0.02])


def test_an_unknown_covariance_says_so() -> None:
    unknown = beacon(pixel_covariance=None, angle_covariance=None)
    (bearing,) = conversions.bearings_message(AT, 'camera', [unknown]).bearings
    (message,) = conversions.beacons_message(AT, 'camera', [unknown], slots_full=False).beacons
    assert bearing.covariance[0] == message.pixel_covariance[0] == -1.0


def test_an_uncalibrated_beacon_says_so() -> None:
    without = beacon(bearing=None, azimuth_rad=None, elevation_rad=None, bit_rate_bps=None)
    (message,) = conversions.beacons_message(AT, '', [without], slots_full=False).beacons
    assert not message.has_bearing and math.isnan(message.bearing.x) and math.isnan(message.bit_rate_bps)
    (bearing,) = conversions.bearings_message(AT, '', [without]).bearings
    assert not bearing.has_bearing and math.isnan(bearing.azimuth_rad) and bearing.x_px == 100.5


def test_only_confirmed_beacons_have_bearings() -> None:
    beacons = [beacon(track_id=k, state=state) for k, state in enumerate(BeaconState)]
    message = conversions.bearings_message(AT, 'camera', beacons)
    assert [bearing.track_id for bearing in message.bearings] == [BeaconState.CONFIRMED]


def test_a_value_too_large_for_its_field_is_no_error() -> None:
    (message,) = conversions.beacons_message(AT, '', [beacon(index=1e300, x_px=-1e300)], False).beacons
    assert message.index == math.inf and message.x_px == -math.inf


# --- text ---


def test_what_cannot_be_printed_is_escaped() -> None:
    assert printable(b'Shall I\n\r\t\\ \x00\x7f\xff~') == r'Shall I\n\r\t\\ \x00\x7f\xff~'


@given(st.binary(max_size=50))
def test_a_printable_text_can_be_read_back(codes: bytes) -> None:
    text = printable(codes)
    assert text.isascii() and text.isprintable()
    assert text.encode().decode('unicode_escape').encode('latin1') == codes


def test_a_text_keeps_its_last_codes_and_counts_all() -> None:
    texts = Texts(kept=4)
    for code in b'ABCDEF':
        texts.add(character(code))
    texts.add(character(ord('z'), track_id=9, status=Status.PARITY_ERROR))
    first, second = texts.take_changed()
    assert (first.track_id, first.first_index, first.codes, first.statuses) == (7, 2, b'CDEF', bytes(4))
    assert (second.track_id, second.first_index, second.codes, second.statuses) == (9, 0, b'z', b'\x02')
    assert texts.take_changed() == []
    message = conversions.text_message('camera', first)
    assert (bytes(message.codes), message.text, message.first_index) == (b'CDEF', 'CDEF', 2)


def test_a_lost_beacons_text_is_dropped() -> None:
    texts = Texts(kept=4)
    texts.add(character())
    texts.add(character(track_id=8))
    texts.keep([8])
    assert [text.track_id for text in texts.take_changed()] == [8]
    for track_id in (7, 8):
        texts.add(character(track_id=track_id))
    assert [(text.track_id, len(text.codes)) for text in texts.take_changed()] == [(7, 1), (8, 2)]


# --- silence ---

TYPE = 'event_camera_msgs/msg/EventPacket'
HEARD = {'topic': '/events', 'advertised': (TYPE,), 'supported': True, 'messages': 100, 'events': 1000}
CASES = [
    (Cause.NO_PUBLISHER, {'advertised': (), 'similar': ('/cam/events (x)',)}, r'no publisher on /events.*/cam/events'),
    (Cause.WRONG_TYPE, {'advertised': ('sensor_msgs/msg/Image',), 'supported': False}, 'sensor_msgs/msg/Image'),
    (Cause.NOT_INSTALLED, {'not_installed': 'dvs_msgs/msg/EventArray'}, 'package dvs_msgs is not installed'),
    (Cause.INCOMPATIBLE_QOS, {'messages': 0, 'incompatible': 'driver publishes best_effort'}, 'best_effort'),
    (Cause.NO_MESSAGES, {'messages': 0}, 'no messages come'),
    (Cause.UNREADABLE, {'bad_messages': 100, 'events': 0, 'problems': 'encoding (100)'}, r'encoding \(100\)'),
    (Cause.OVERLOADED, {'shed': 40, 'tracks': (beacon(),)}, 'overloaded: 40 of 100 messages on /events shed'),
    (Cause.NO_EVENTS, {'events': 0}, 'hold no events'),
    (Cause.BELOW_THRESHOLD, {'index_threshold': 1.5}, 'index_threshold = 1.5'),
    (
        Cause.UNCONFIRMED,
        {'tracks': (beacon(state=BeaconState.DEMODULATING),)},
        'track 3 has 18 of 20 characters ok, 1 parity and 1 framing errors',
    ),
    (Cause.UNCONFIRMED, {'tracks': (beacon(state=BeaconState.WAITING, characters=0),)}, 'none has given a character'),
]


@pytest.mark.parametrize(('cause', 'changes', 'text'), CASES)
def test_a_silence_has_its_reason(cause: Cause, changes: dict[str, object], text: str) -> None:
    silence = why_silent(Situation(**{**HEARD, **changes}))  # type: ignore[arg-type]
    assert silence is not None and silence.cause is cause
    assert re.search(text, silence.text)


def test_a_confirmed_beacon_is_no_silence() -> None:
    assert why_silent(Situation(**{**HEARD, 'tracks': (beacon(),)})) is None  # type: ignore[arg-type]


def test_an_empty_scene_is_no_fault() -> None:
    assert [cause.is_fault for cause in Cause] == [True] * 7 + [False] * 3


def test_a_throttled_log_says_how_often_it_kept_quiet() -> None:
    lines: list[str] = []
    log = ThrottledLog(lines.append, period_ns=100)
    for now_ns in (0, 10, 99, 100, 150):
        log('a', 'text', now_ns)
    log('b', 'other', 150)
    assert lines == ['text', 'text (and 2 more since the last such line)', 'other']


def test_whatever_goes_wrong_in_a_callback_the_node_goes_on() -> None:
    lines: list[str] = []

    class Node:
        survive = BeaconNode.survive
        report = Report()
        log_error = staticmethod(ThrottledLog(lines.append, NS_PER_S))

        @guarded
        def callback(self, divisor: int) -> None:
            1 / divisor  # noqa: B018

    node = Node()
    for divisor in (0, 1, 0):
        node.callback(divisor)
    assert node.report.totals['internal_errors'] == 2
    (line,) = lines
    assert 'in callback' in line and 'ZeroDivisionError' in line


@pytest.mark.parametrize('failures', [FAILED_IN_A_ROW - 1, FAILED_IN_A_ROW, 3 * FAILED_IN_A_ROW])
def test_a_state_that_every_message_fails_in_is_begun_anew(failures: int) -> None:
    class Live:
        def push(self, *_: object) -> None:
            raise KeyError('a track')

    class Node:
        _read, survive = BeaconNode._read, BeaconNode.survive
        _live, _shedder, _failed, opened = Live(), Shedder(NS_PER_S), 0, 0
        report = Report()
        log_error = staticmethod(ThrottledLog([].append, NS_PER_S))

        def _now_ns(self) -> int:
            return 0

        def _open_stream(self) -> None:
            self.opened += 1

    node = Node()
    for _ in range(failures):
        node._read(b'', {'received_timestamp': 0})
    assert node.report.totals['internal_errors'] == failures
    assert node.opened == failures // FAILED_IN_A_ROW


# --- the type of the topic ---

PACKETS, ARRAYS = 'event_camera_msgs/msg/EventPacket', 'dvs_msgs/msg/EventArray'


@pytest.mark.parametrize(
    ('advertised', 'current', 'not_installed', 'chosen'),
    [
        ((), None, '', None),
        (('sensor_msgs/msg/Image',), None, '', None),
        (('sensor_msgs/msg/Image', PACKETS), None, '', PACKETS),
        ((PACKETS, ARRAYS), ARRAYS, '', ARRAYS),
        ((PACKETS,), ARRAYS, '', PACKETS),
        ((ARRAYS, PACKETS), None, ARRAYS, PACKETS),
        ((ARRAYS,), None, ARRAYS, None),
        (('someone_msgs/msg/EventArray',), None, '', 'someone_msgs/msg/EventArray'),
    ],
)
def test_the_reader_follows_the_advertised_type(
    advertised: tuple[str, ...], current: str | None, not_installed: str, chosen: str | None
) -> None:
    assert choose_type(advertised, current, not_installed) == chosen


def test_a_types_class_is_found_by_its_name() -> None:
    assert message_class('sensor_msgs/msg/CameraInfo').__name__ == 'CameraInfo'
    with pytest.raises(ImportError, match='no_such_msgs'):
        message_class('no_such_msgs/msg/EventArray')
    with pytest.raises(ImportError, match='sensor_msgs.msg has no EventArray'):
        message_class('sensor_msgs/msg/EventArray')


# --- calibration ---


def test_a_calibration_is_a_path_or_a_url(tmp_path: Path) -> None:
    assert resolve_url(str(tmp_path / 'c.yaml')) == tmp_path / 'c.yaml'
    assert resolve_url(f'file://{tmp_path}/a%20b.yaml') == tmp_path / 'a b.yaml'
    assert resolve_url('package://rclpy/config/c.yaml').parts[-4:] == ('share', 'rclpy', 'config', 'c.yaml')


@pytest.mark.parametrize(
    'url', ['http://host/c.yaml', 'package://no_such_package/c.yaml', '/no/such/file.yaml', 'file://[x', 'a\0b']
)
def test_a_calibration_that_is_not_there_is_refused_by_name(url: str) -> None:
    with pytest.raises(CalibrationError, match=re.escape(url)):
        load_camera(url)


def test_no_calibration_is_none() -> None:
    assert load_camera('') is None


def test_the_same_camera_info_is_the_same_camera() -> None:
    k = [500.0, 0.0, 320.0, 0.0, 500.0, 240.0, 0.0, 0.0, 1.0]
    message = CameraInfo(width=640, height=480, distortion_model='plumb_bob', d=[0.0] * 5, k=k)
    camera = camera_of_message(message)
    assert camera_of_message(message) is camera is not None
    other = camera_of_message(CameraInfo(width=640, height=480, distortion_model='plumb_bob', d=[0.1] * 5, k=k))
    assert other is not None and other.d.tolist() == [0.1] * 5
    for refused in ({'d': [1e300] * 5}, {'k': [1e-320, *k[1:]]}, {'distortion_model': 'x' * 4_000_000}):
        fields = {'width': 640, 'height': 480, 'distortion_model': 'plumb_bob', 'd': [0.0] * 5, 'k': k} | refused
        with pytest.raises(CalibrationError) as caught:
            camera_of_message(CameraInfo(**fields))
        assert len(str(caught.value)) < 200
