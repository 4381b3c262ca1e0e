"""The live receiver without DDS: messages and time in, characters with both clocks' times out."""

import os
import stat
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from live_session import BIT_RATE, MS, PACKET_NS, STAMP_NS, START_NS, TEXT, TYPE, Heard, Session, beacon_events, packets

from beacon_comm.compiling.warm_up import warm_up
from beacon_comm.core.bearing import CameraModel
from beacon_comm.core.character import Status
from beacon_comm.core.detection import Detector
from beacon_comm.core.events import NS_PER_S
from beacon_comm.core.framing import CharacterFrame
from beacon_comm.core.parameters import Parameters
from beacon_comm.ros.live import Step
from beacon_comm.ros.report import Report


def test_the_last_character_needs_no_further_packet() -> None:
    session = Session()
    session.push(packets(beacon_events()))
    assert session.text() == TEXT[:-3]  # what is complete is decided two characters later
    session.wait(0.2)
    assert session.text() == TEXT


def test_characters_are_given_before_the_work_of_the_hop_that_ends_their_interval(monkeypatch: pytest.MonkeyPatch) -> None:
    whole, early = Session(), Session()
    whole.push(packets(beacon_events()))
    hop, before = Detector.hop, 0
    for message in packets(beacon_events()):
        done: list[str] = []
        monkeypatch.setattr(Detector, 'hop', lambda *given, done=done: (done.append('hop'), hop(*given))[1])

        def give(step: Step, done: list[str] = done) -> None:
            early.steps.append(step)
            done.append('given')

        rest = early.live.push(message, early.now_ns, give)
        assert not rest.characters
        early.steps.append(rest)
        early.now_ns += PACKET_NS
        before += done[:2] == ['given', 'hop']
    assert before > 10
    assert early.characters() == whole.characters()
    assert any(step.due_ns for step in early.steps)
    assert [due for step in early.steps for due in step.due_ns] == [due for step in whole.steps for due in step.due_ns]
    assert [step.confirmed_changed for step in whole.steps].count(True) == [
        step.confirmed_changed for step in early.steps
    ].count(True) == 1


def test_flush_gives_out_what_was_held_until_the_bit_rate_is_settled() -> None:
    session = Session(bit_rates=(504.0, BIT_RATE))
    session.push(packets(beacon_events(TEXT[:8])))
    session.wait(0.1)
    held = session.text()
    assert len(held) < 8
    session.steps.append(session.live.flush(session.now_ns))
    assert session.text() == TEXT[:8]


def test_flush_does_not_wait_for_late_packets() -> None:
    session = Session()
    session.push(packets(beacon_events()))
    session.wait(0.05)
    assert session.text() == TEXT[:-3]
    session.steps.append(session.live.flush(session.now_ns))
    assert session.text() == TEXT


def test_without_a_publisher_the_last_character_comes_out_sooner() -> None:
    session = Session()
    session.push(packets(beacon_events()))
    session.live.publisher_gone()
    session.wait(0.1)
    assert session.text() == TEXT


def test_every_stamp_is_its_own_packets() -> None:
    session = Session()
    session.push(packets(beacon_events()))
    session.wait(3.0)
    for step in session.steps[1:]:
        assert step.at.ros_ns - step.at.sensor_ns == STAMP_NS - START_NS
        for stamped in step.characters:
            assert stamped.at.ros_ns - stamped.at.sensor_ns == STAMP_NS - START_NS
            assert stamped.at.sensor_ns == stamped.character.t_ns
    times = [step.at.ros_ns for step in session.steps[1:]]
    assert times == sorted(times)
    assert len([lost for step in session.steps for lost in step.lost]) == 1


def test_a_driver_that_stamps_zero_gets_the_time_of_arrival() -> None:
    session = Session()
    session.now_ns = STAMP_NS + 7
    session.push(packets(beacon_events(), offset_ns=-(10**18)))
    first = next(stamped for step in session.steps for stamped in step.characters)
    assert first.at.ros_ns == pytest.approx(STAMP_NS + 7, abs=2 * MS)


def test_a_stalled_publisher_costs_some_characters_and_no_more() -> None:
    """The packets after a pause of 0.4 s hold events of a time that had been announced as silent."""
    session = Session()
    stream = packets(beacon_events(4 * TEXT))
    session.push(stream[:82])
    session.wait(0.4)
    session.push(stream[82:])
    session.wait(1.0)  # it waits longer now that it has seen a stall
    assert session.live.counts['late_packets'] == 1
    text = session.text()
    assert text[:100] == (4 * TEXT)[:100] and text[-100:] == (4 * TEXT)[-100:]
    assert len(session.track_ids()) == 1
    for step in session.steps:
        for stamped in step.characters:
            # True sensor time all through: the n-th bit of the text is where it was sent.
            position = (stamped.at.sensor_ns - START_NS) * BIT_RATE / NS_PER_S / 11
            assert position % 1.0 < 0.1 or position % 1.0 > 0.9 or 115 < position < 200


@pytest.mark.parametrize('receiver', ['sequence', 'threshold'])
def test_half_a_character_before_a_silence_is_not_ok(receiver: str) -> None:
    """The rest of it would be taken for a line that is held high, and half of these have the right parity."""
    events = beacon_events()
    length_ns = CharacterFrame().duration_ns(BIT_RATE)
    halves = 0
    for eighth in range(1, 9):
        stop = int(np.searchsorted(events.t_ns, START_NS + (60 + eighth / 8.5) * length_ns))
        session = Session(receiver=receiver)
        session.push(packets(events.slice(0, stop, int(events.t_ns[stop - 1]))))
        session.wait(0.5)
        last = session.characters()[-1].character
        halves += last.status is Status.REPAIRED and last.confidence <= 0.5
        assert not Heard(session.characters(), TEXT).wrong_ok
    assert halves > 1


@pytest.mark.parametrize('lost', [0, 7])
@pytest.mark.parametrize('receiver', ['sequence', 'threshold'])
def test_a_silence_in_which_packets_were_lost_or_late_tears_the_stream(receiver: str, lost: int) -> None:
    every = packets(beacon_events())
    for cut in range(25, 37):
        session = Session(receiver=receiver)
        session.push(every[:cut])
        session.wait(0.5)
        session.push(every[cut + lost :])
        session.wait(0.5)
        heard = Heard(session.characters(), TEXT)
        assert not heard.wrong_ok
        assert len(heard.right) > len(TEXT) - 8 - 2 * lost


def test_another_publisher_begins_a_new_stream_and_labels_go_on() -> None:
    session = Session()
    session.push(packets(beacon_events()))
    before = len(session.steps)
    session.steps.append(session.live.open(TYPE, session.now_ns))
    assert [lost.track_id for lost in session.steps[-1].lost] == list(session.track_ids(0))
    session.push(packets(beacon_events(start_ns=NS_PER_S), frame_id='another', offset_ns=STAMP_NS))
    session.wait(0.2)
    assert session.text(before).endswith(TEXT)
    assert min(session.track_ids(before + 1)) > max(session.track_ids() - session.track_ids(before + 1))
    assert session.live.frame_id == 'another'
    assert session.steps[-1].at.sensor_ns < START_NS


def test_a_restarted_sensor_begins_a_new_time_and_labels_go_on() -> None:
    session = Session()
    session.push(packets(beacon_events()))
    before = len(session.steps)
    session.push(packets(beacon_events(start_ns=NS_PER_S), offset_ns=STAMP_NS))
    session.wait(0.2)
    assert session.live.counts['restarts'] == 1
    assert session.text(before).endswith(TEXT[10:])
    times = [step.at.ros_ns for step in session.steps[1:]]
    assert times == sorted(times)


def test_a_changed_sensor_size_loses_the_tracks() -> None:
    session = Session()
    session.push(packets(beacon_events()))
    later = beacon_events(start_ns=START_NS + NS_PER_S)
    session.push(packets(later, size=(128, 96)))
    assert session.live.sensor_size == (128, 96)
    assert sum(len(step.lost) for step in session.steps) == 1
    assert session.live.beacons()


def test_a_bad_message_is_told_and_forgotten() -> None:
    session = Session()
    stream = packets(beacon_events())
    session.push([*stream[:3], b'\x00\x01', stream[3][:50], *stream[3:]])
    session.wait(0.2)
    assert session.text() == TEXT
    problems = [step for step in session.steps if step.problem is not None]
    assert [step.problem_kind for step in problems] == ['bad_messages'] * 2
    report = Report()
    for step in session.steps:
        report.message(step, waited_s=0.001)
    traffic, events, values = report.look(session.live, NS_PER_S)
    assert (traffic.bad_messages, traffic.problem_text()) == (2, 'bad_messages (2)')
    assert events == len(beacon_events()) == values['events']


def test_a_calibration_of_another_sensor_is_not_used() -> None:
    k = [50.0, 0.0, 32.0, 0.0, 50.0, 24.0, 0.0, 0.0, 1.0]
    fitting = Session(CameraModel.from_camera_info(64, 48, 'plumb_bob', [], k))
    other = Session(CameraModel.from_camera_info(640, 480, 'plumb_bob', [], k))
    for session in (fitting, other):
        session.push(packets(beacon_events()))
    assert fitting.live.calibrated and fitting.live.beacons()[0].bearing is not None
    assert not other.live.calibrated and other.live.beacons()[0].bearing is None
    assert '640' in other.live.camera_problem
    other.live.set_camera(CameraModel.from_camera_info(64, 48, 'plumb_bob', [], k))
    assert other.live.calibrated and other.live.beacons()[0].bearing is not None


def test_without_messages_there_is_nothing() -> None:
    session = Session()
    session.wait(1.0)
    assert len(session.steps) == 1
    assert session.live.flush(STAMP_NS).characters == ()
    assert session.live.beacons() == () and session.live.confirmed == ()


@pytest.mark.parametrize('bit_rates', [(20.0,), (504.0, 3125.0), (10_000.0,)])
def test_the_warm_up_takes_every_bit_rate(bit_rates: tuple[float, ...]) -> None:
    warm_up(Parameters(bit_rates=bit_rates))


def test_a_cache_that_cannot_be_made_is_replaced(tmp_path: Path) -> None:
    """Where neither the source's folder nor the user's can be written, the temporary folder takes the kernels."""
    blocked = tmp_path / 'a file'
    blocked.write_text('')
    folder = Path(_cache_folder(blocked / 'cache', tmp_path))
    assert folder.parent.parent == tmp_path and stat.S_IMODE(folder.parent.stat().st_mode) == 0o700


@pytest.mark.parametrize('disk', ['full', 'read-only'])
def test_kernels_that_cannot_be_kept_run_all_the_same(tmp_path: Path, disk: str) -> None:
    """The disk runs full, or there is no folder to write to, the temporary ones included."""
    program = (
        'import resource, signal, sys, tempfile\n'
        'from pathlib import Path\n'
        'import beacon_comm.compiling.cache as cache\n'
        'cache.PACKAGE = Path("/proc/nowhere")\n'
        'full = sys.argv[1] == "full"\n'
        'if not full:\n'
        '    tempfile._candidate_tempdir_list = lambda: ["/proc/nowhere"]\n'
        'folder = cache.ensure_compiler_cache()\n'
        'assert full == (folder is not None), folder\n'
        'if full:\n'
        '    signal.signal(signal.SIGXFSZ, signal.SIG_IGN)\n'
        '    resource.setrlimit(resource.RLIMIT_FSIZE, (0, 0))\n'
        'cache.save_one_at_a_time()\n'
        'from beacon_comm.core.motion import fading_s\n'
        'assert fading_s(0.5) == fading_s.py_func(0.5)\n'
    )
    environment = {
        **os.environ, 'XDG_CACHE_HOME': '/proc/nowhere', 'NUMBA_CACHE_DIR': '/proc/nowhere', 'TMPDIR': str(tmp_path),
    }
    subprocess.run([sys.executable, '-P', '-c', program, disk], env=environment, check=True)


def test_every_version_has_kernels_of_its_own(tmp_path: Path) -> None:
    """A kernel that was compiled against a type that is gone would keep the node from starting."""
    package = tmp_path / 'beacon_comm'
    (package / 'core').mkdir(parents=True)
    (package / 'core' / '.#stage.py').symlink_to('nowhere')
    workspaces = [package / '__pycache__' / name for name in ('beacon_comm_ws', 'beacon_comm_kernels_1000')]
    for workspace in workspaces:
        workspace.mkdir(parents=True)
    folders = []
    for source in ('LEVEL = 1', 'LEVEL = 1', 'LEVEL = 2'):
        (package / 'core' / 'stage.py').write_text(source)
        folders.append(Path(_cache_folder(package, tmp_path, given='')))
        assert folders[-1].is_dir() and folders[-1].parent == package / '__pycache__'
    assert folders[0] == folders[1] != folders[2] and not folders[0].exists()
    assert all(workspace.is_dir() for workspace in workspaces)  # somebody's, whatever the name begins with
    # One that is given is kept, and a process's children have the same.
    given = Path(_cache_folder(package, tmp_path, given=str(tmp_path / 'given')))
    assert given == tmp_path / 'given' / folders[2].name
    assert Path(_cache_folder(package, tmp_path, given=str(given))) == given


def _cache_folder(cache: Path, temporary: Path, given: str | None = None) -> str:
    program = (
        'from pathlib import Path\n'
        'import beacon_comm.compiling.cache as cache\n'
        f'cache.PACKAGE = Path({str(cache)!r})\n'
        'print(cache.ensure_compiler_cache())\n'
    )
    environment = {
        **os.environ, 'XDG_CACHE_HOME': str(cache), 'NUMBA_CACHE_DIR': str(cache) if given is None else given,
        'TMPDIR': str(temporary),
    }
    done = subprocess.run([sys.executable, '-c', program], env=environment, capture_output=True, text=True, check=True)
    return done.stdout.strip()


def test_processes_that_save_kernels_of_one_function_at_once_get_their_own(tmp_path: Path) -> None:
    (tmp_path / 'kernels.py').write_text(
        'from numba import njit\n'
        '@njit(cache=True)\n'
        'def twice(x):\n'
        '    return x + x\n'
    )
    program = (
        'import sys\n'
        'from beacon_comm.compiling.cache import save_one_at_a_time\n'
        'save_one_at_a_time()\n'
        'import numpy as np\n'
        'from kernels import twice\n'
        'for name in sys.argv[1:]:\n'
        '    result = twice(np.dtype(name).type(3))\n'
        '    assert result == 6, (name, result)\n'
        'print(sum(twice.stats.cache_hits.values()))\n'
    )
    integers, others = ['int8', 'int16', 'int32', 'int64'], ['float32', 'float64', 'complex64', 'uint8']
    environment = {**os.environ, 'PYTHONPATH': str(tmp_path), 'NUMBA_CACHE_DIR': str(tmp_path / 'cache')}
    environment.pop('PYTHONSAFEPATH', None)
    command = [sys.executable, '-c', program]
    both = [
        subprocess.Popen([*command, *names], env=environment, stdout=subprocess.PIPE, text=True) for names in (integers, others)
    ]
    for process in both:
        process.communicate()
        assert process.returncode == 0
    done = subprocess.run([*command, *integers, *others], env=environment, capture_output=True, text=True, check=True)
    assert int(done.stdout) == len(integers) + len(others)
