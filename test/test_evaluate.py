"""beacon_evaluate: recordings in, tables and JSON out; the published figures; errors."""

import json
import math
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.io import savemat

from beacon_comm.cli.evaluate import main
from beacon_comm.cli.offline import cut_batch
from beacon_comm.cli.parameter_arguments import add_parameter_arguments, parameters_from
from beacon_comm.core.character import Status
from beacon_comm.core.errors import ParameterError
from beacon_comm.core.events import EventBatch
from beacon_comm.core.parameters import Parameters
from beacon_comm.evaluation.near_path import NearPath
from beacon_comm.evaluation.report import table
from beacon_comm.evaluation.result import PathPoint
from beacon_comm.recordings.bag_writer import BagWriter
from beacon_comm.recordings.disc import Disc
from beacon_comm.recordings.scene import Scene
from beacon_comm.recordings.sources import Beacon
from beacon_comm.recordings.truth import write_truth
from beacon_comm.simulation.led import simulate_text

PROJECT = Path(__file__).resolve().parents[1]
TEXT = 'A beacon of one line. '
STATES = {'waiting', 'demodulating', 'confirmed', 'demoted', 'lost'}


def run(capsys, *arguments: object) -> tuple[int, str, str]:
    try:
        code = main([str(argument) for argument in arguments])
    except SystemExit as exit_:
        code = int(exit_.code or 0)
    captured = capsys.readouterr()
    return code, captured.out, captured.err


def check_schema(result: object, receiver: str = 'sequence') -> None:
    """Check every key and type of docs/evaluation.md; no key more."""
    number = (int, float)
    assert isinstance(result, dict)
    assert list(result) == [
        'schema', 'recording', 'receiver', 'events', 'seconds', 'mev_per_s', 'lost_packets', 'skipped_words', 'beacons',
        'scene',
    ]  # fmt: skip
    assert result['schema'] == 2
    assert isinstance(result['recording'], str)
    assert result['receiver'] == receiver
    assert all(type(result[key]) is int for key in ('events', 'lost_packets', 'skipped_words'))
    assert isinstance(result['seconds'], number)
    assert isinstance(result['mev_per_s'], number)
    for beacon in result['beacons']:
        assert list(beacon) == [
            'track_id', 'state', 'confirmed_at_s', 'bit_rate_bps', 'text', 'path', 'characters', 'transmissions',
        ]  # fmt: skip
        assert type(beacon['track_id']) is int
        assert beacon['state'] in STATES
        assert beacon['confirmed_at_s'] is None or 0.0 <= beacon['confirmed_at_s'] <= result['seconds'] + 0.1
        assert beacon['bit_rate_bps'] is None or isinstance(beacon['bit_rate_bps'], number)
        assert beacon['text'] == ''.join(chr(character['code']) for character in beacon['characters'])
        for point in beacon['path']:
            assert len(point) == 3
            assert all(math.isfinite(value) for value in point)
        for character in beacon['characters']:
            assert list(character) == ['t_s', 'code', 'status', 'confidence']
            assert -0.5 <= character['t_s'] <= result['seconds']
            assert character['status'] in {status.name.lower() for status in Status}
            assert 0.0 <= character['confidence'] <= 1.0
        times = [character['t_s'] for character in beacon['characters']]
        assert times == sorted(times)
        for transmission in beacon['transmissions']:
            assert list(transmission) == [
                'start_s', 'characters', 'wrong', 'wrong_ok', 'repaired', 'inserted', 'message_accuracy', 'bit_accuracy',
            ]  # fmt: skip
            assert 0 <= transmission['wrong_ok'] <= transmission['wrong'] <= transmission['characters']
            if transmission['start_s'] is not None:
                lost = transmission['wrong'] + transmission['inserted']
                assert transmission['message_accuracy'] == pytest.approx(max(0, 1 - lost / transmission['characters']))
            assert 0.0 <= transmission['bit_accuracy'] <= 1.0


def check_scene(scene: dict) -> None:
    """Check every key of a scene's scores."""
    assert list(scene) == [
        'sent', 'confirmed', 'tracks', 'false_confirmations', 'on_reflections', 'stray_characters',
        'double_characters', 'beacons',
    ]  # fmt: skip
    tracking = [
        'objects', 'reports', 'matches', 'misses', 'false_positives', 'id_switches', 'fragmentations', 'swaps',
        'mostly_tracked', 'partly_tracked', 'mostly_lost', 'mota', 'motp_px', 'idf1', 'id_precision', 'id_recall', 'hota',
        'detection_accuracy', 'association_accuracy',
    ]  # fmt: skip
    assert list(scene['tracks']) == tracking
    assert list(scene['confirmed']) == [*tracking, 'mota_interval', 'motp_interval_px']
    count = [
        'characters', 'wrong', 'missing', 'inserted', 'wrong_ok', 'bits', 'wrong_bits',
        'message_accuracy', 'message_interval', 'bit_accuracy', 'bit_interval',
    ]  # fmt: skip
    assert list(scene['sent']) == count
    for beacon in scene['beacons']:
        assert list(beacon) == [
            'name', 'kind', 'bit_rate_bps', 'seen_s', 'tracks', 'sent', 'locks', 'confirm_s', 'position',
        ]  # fmt: skip
        assert beacon['sent'] is None or list(beacon['sent']) == count
        assert all(list(lock) == ['begin_s', 'lock_s', 'lost'] for lock in beacon['locks'])
        if beacon['position'] is not None:
            assert list(beacon['position']) == [
                'instants', 'rms_px', 'rms_interval_px', 'median_px', 'p95_px', 'speed_px_per_s', 'lag_s',
                'nees', 'nees_interval', 'bearing_rms_rad', 'bearing_nees', 'bearing_nees_interval',
            ]  # fmt: skip


@pytest.fixture(scope='module')
def mat_file(tmp_path_factory) -> Path:
    """Return a recording of four sendings of a short text at 3125 bit/s."""
    t_ns, polarity = simulate_text(TEXT * 4, 3125.0, lead_s=0.0, tail_s=0.02, t0_ns=10**9)
    path = tmp_path_factory.mktemp('mat') / 'one line.mat'
    savemat(path, {'event': polarity[None, :].astype(np.int16), 'event_t': t_ns[None, :] / 1e9})
    return path


def beacon(text: str, bit_rate_bps: float, disc: Disc, seed: int) -> Beacon:
    t_ns, polarity = simulate_text(text, bit_rate_bps, lead_s=0.0, tail_s=0.0, t0_ns=0, seed=seed)
    return Beacon('made up', 'simulated', t_ns, polarity, int(t_ns[-1]), disc, text=text, bit_rate_bps=bit_rate_bps)


@pytest.fixture(scope='module')
def bag(tmp_path_factory) -> Path:
    """Return a bag of 1 s: one beacon that moves and stops sending in mid-text, one that stands still."""
    return write_scene(tmp_path_factory.mktemp('bag') / 'scene', truth=False)


@pytest.fixture(scope='module')
def scene(tmp_path_factory) -> Path:
    """Return the same bag with its truth beside it."""
    return write_scene(tmp_path_factory.mktemp('scene') / 'scene', truth=True)


def write_scene(folder: Path, truth: bool) -> Path:
    moving = beacon((TEXT * 6)[:100], 3125.0, Disc(40.0, 60.0, 4.0, 50.0, 20.0, 200, 160), 1)
    still = beacon('Another text, and a longer one. ' * 8, 3125.0, Disc(140.0, 100.0, 4.0, 0.0, 0.0, 200, 160), 2)
    made = Scene((moving, still), 200, 160)
    with BagWriter(folder) as writer:
        writer.add_topic('/event_camera/events', 'event_camera_msgs/msg/EventPacket')
        for recorded_ns, cdr in made.packets():
            writer.write('/event_camera/events', recorded_ns, cdr)
    if truth:
        write_truth(folder / 'truth.json', made)
    return folder


def test_the_published_figures(data_folder, capsys, tmp_path) -> None:
    """One set of defaults for both recordings; the parts that they hold are known."""
    files = [data_folder / '504hz_30m.mat', data_folder / '3125hz_30m.mat']
    out_file = tmp_path / 'out.json'
    code, out, err = run(
        capsys, *files, '--truth', 'sonnet18', '--receiver', 'threshold', '--bit-rate', '504,3125', '--json', out_file
    )
    assert (code, err) == (0, '')
    slow, fast = json.loads(out_file.read_text())
    check_schema(slow, 'threshold')
    check_schema(fast, 'threshold')
    assert (slow['events'], fast['events']) == (1_258_621, 1_107_543)
    assert slow['seconds'] == pytest.approx(19.579724)
    (slow_beacon,), (fast_beacon,) = slow['beacons'], fast['beacons']
    assert [transmission['characters'] for transmission in slow_beacon['transmissions']] == [565, 264]
    assert [transmission['characters'] for transmission in fast_beacon['transmissions']] == [302, 618]
    assert slow_beacon['transmissions'][1]['message_accuracy'] == 1.0
    published = fast_beacon['transmissions'][1]
    assert published['characters'] - published['wrong'] - published['inserted'] >= 542
    assert published['bit_accuracy'] >= 0.9865
    assert (slow_beacon['bit_rate_bps'], fast_beacon['bit_rate_bps']) == (504.0, 3125.0)
    assert 'paper: message' in out
    assert '264 of 264' in out


def test_a_recording_of_one_beacon(mat_file, capsys, tmp_path) -> None:
    out_file = tmp_path / 'out.json'
    code, out, err = run(capsys, mat_file, '--truth', TEXT, '--bit-rate', '3125', '--json', out_file)
    assert (code, err) == (0, '')
    result = json.loads(out_file.read_text())
    check_schema(result)
    assert result['recording'] == str(mat_file)
    (found,) = result['beacons']
    assert found['state'] == 'confirmed'
    assert found['path'] == []
    assert TEXT in found['text']
    assert len(found['transmissions']) == 4
    assert sum(transmission['characters'] for transmission in found['transmissions']) == 4 * len(TEXT)
    assert sum(transmission['wrong'] for transmission in found['transmissions']) <= 2
    assert 'one line.mat' in out
    assert 'paper' not in out


def test_a_part_of_a_recording_keeps_its_times(mat_file, capsys, tmp_path) -> None:
    out_file = tmp_path / 'out.json'
    code, _, _ = run(
        capsys, mat_file, '--truth', TEXT, '--bit-rate', '3125', '--json', out_file, '--start', 0.1, '--duration', 0.12
    )
    result = json.loads(out_file.read_text())
    assert code == 0
    assert result['seconds'] == pytest.approx(0.12, abs=0.002)
    times = [character['t_s'] for character in result['beacons'][0]['characters']]
    assert 0.09 < times[0] < 0.12
    assert times[-1] < 0.22
    held = sum(transmission['characters'] for transmission in result['beacons'][0]['transmissions'])
    assert held <= 0.12 * 3125 / 11 + 1


def test_without_a_truth_there_are_no_scores(mat_file, capsys, tmp_path) -> None:
    out_file = tmp_path / 'out.json'
    code, out, _ = run(capsys, mat_file, '--bit-rate', '3125', '--json', out_file)
    assert code == 0
    assert json.loads(out_file.read_text())['beacons'][0]['transmissions'] == []
    assert 'message accuracy' not in out


def test_another_text_is_not_found(mat_file, capsys, tmp_path) -> None:
    out_file = tmp_path / 'out.json'
    code, out, _ = run(capsys, mat_file, '--truth', 'sonnet18', '--bit-rate', '3125', '--json', out_file)
    assert code == 0
    result = json.loads(out_file.read_text())
    check_schema(result)
    (transmission,) = result['beacons'][0]['transmissions']
    assert transmission['start_s'] is None
    assert (transmission['message_accuracy'], transmission['bit_accuracy']) == (0.0, 0.5)
    assert 'not found' in out


def test_a_bag_with_two_beacons(bag, capsys, tmp_path) -> None:
    out_file = tmp_path / 'out.json'
    code, out, err = run(capsys, bag, '--truth', TEXT, '--bit-rate', '3125', '--json', out_file)
    assert (code, err) == (0, '')
    result = json.loads(out_file.read_text())
    check_schema(result)
    by_text = {TEXT in found['text']: found for found in result['beacons'] if found['confirmed_at_s'] is not None}
    moving, still = by_text[True], by_text[False]
    for found, (x0, y0, vx, vy) in ((moving, (40, 60, 50, 20)), (still, (140, 100, 0, 0))):
        times = np.array([point[0] for point in found['path']])
        seen = times < 0.35
        assert seen.sum() >= 10
        assert np.diff(times).max() == pytest.approx(0.02, abs=1e-6)
        for t_s, x_px, y_px in np.array(found['path'])[seen][5:]:
            assert math.hypot(x_px - x0 - vx * t_s, y_px - y0 - vy * t_s) < 2.0
    # Four sendings and the part of the fifth that was sent; what the bag holds beyond that is no fault.
    held = [transmission['characters'] for transmission in moving['transmissions']]
    assert held in ([22, 22, 22, 22], [22, 22, 22, 22, 12])
    assert sum(transmission['wrong'] for transmission in moving['transmissions']) <= 2
    assert still['transmissions'][0]['start_s'] is None
    assert 'not found' in out


def test_a_truth_beside_the_bag_is_found(scene, capsys, tmp_path) -> None:
    out_file = tmp_path / 'out.json'
    code, out, err = run(capsys, scene, '--bit-rate', '3125', '--json', out_file)
    assert (code, err) == (0, '')
    result = json.loads(out_file.read_text())
    check_schema(result)
    check_scene(result['scene'])
    moving, still = result['scene']['beacons']
    assert moving['sent']['wrong'] + still['sent']['wrong'] <= 3
    assert (moving['sent']['characters'], still['sent']['characters']) == (pytest.approx(100, abs=2), pytest.approx(256, abs=2))
    assert moving['position']['rms_px'] < 1.0 and still['position']['rms_px'] < 0.3
    assert all(0.0 < beacon['locks'][0]['lock_s'] < beacon['confirm_s'] < 0.3 for beacon in (moving, still))
    confirmed = result['scene']['confirmed']
    assert (confirmed['id_switches'], confirmed['swaps'], result['scene']['false_confirmations']) == (0, 0, [])
    assert confirmed['matches'] + confirmed['misses'] == confirmed['objects']
    assert 'MOTA' in out and 'IDF1' in out
    path = result['beacons'][0]['path']
    assert np.diff([point[0] for point in path]).max() == pytest.approx(0.009, abs=1e-6)


def test_no_truth_means_none(scene, capsys, tmp_path) -> None:
    out_file = tmp_path / 'out.json'
    code, out, _ = run(capsys, scene, '--bit-rate', '3125', '--truth', 'none', '--json', out_file)
    assert code == 0
    assert json.loads(out_file.read_text())['scene'] is None
    assert 'MOTA' not in out and 'message accuracy' not in out


def test_a_damaged_truth_is_one_line(scene, capsys, tmp_path) -> None:
    copy = tmp_path / 'copy'
    shutil.copytree(scene, copy)
    (copy / 'truth.json').write_text('{"schema": 1')
    code, _, err = run(capsys, copy, '--bit-rate', '3125')
    assert (code, err.count('\n')) == (2, 1)
    assert 'truth.json: cannot be read' in err


def test_one_that_cannot_be_read_does_not_keep_the_others(mat_file, capsys, tmp_path) -> None:
    out_file = tmp_path / 'out.json'
    absent = tmp_path / 'absent.mat'
    code, out, err = run(capsys, absent, mat_file, mat_file, '--bit-rate', '3125', '--json', out_file)
    assert code == 2
    assert err.splitlines() == [f'beacon_evaluate: {absent}: no such file']
    assert len(json.loads(out_file.read_text())) == 2
    assert out.count('one line.mat') == 4


def test_a_damaged_bag_keeps_what_could_be_read(bag, capsys, tmp_path) -> None:
    (file,) = bag.glob('*.mcap')
    damaged = tmp_path / 'damaged.mcap'
    damaged.write_bytes(file.read_bytes()[: file.stat().st_size * 2 // 3])
    code, out, err = run(capsys, damaged, '--bit-rate', '3125')
    assert code == 2
    assert err.count('\n') == 1
    assert 'damaged.mcap' in out


def test_a_refused_json_file_costs_no_evaluation(mat_file, capsys, tmp_path) -> None:
    code, out, err = run(capsys, mat_file, '--bit-rate', '3125', '--json', tmp_path / 'absent' / 'out.json')
    assert (code, out) == (2, '')
    assert 'no such folder' in err
    assert run(capsys, tmp_path / 'absent.mat', '--json', tmp_path / 'out.json')[0] == 2
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ('arguments', 'complaint'),
    [
        ((), 'RECORDING'),
        (('x.mat', '--sideways'), '--sideways'),
        (('x.mat',), 'x.mat: no such file'),
        (('x.mat', '--truth', 'café'), "'é' (U+00E9) at position 3"),
        (('x.mat', '--truth', 'absent.txt'), 'absent.txt: no such file'),
        (('x.mat', '--bit-rate', '504;3125'), '--bit-rate 504;3125'),
        (('x.mat', '--bit-rate', '5'), 'bit_rates = 5.0: must lie in [20, 10000] bps'),
        (('x.mat', '--receiver', 'oracle'), 'receiver = '),
        (('x.mat', '--set', 'hop_s=fast'), 'hop_s = '),
        (('x.mat', '--set', 'hop'), '--set hop: must be NAME=VALUE'),
        (('x.mat', '--set', 'hops=1'), 'hops: no such parameter'),
        (('x.mat', '--params', 'absent.yaml'), 'absent.yaml: cannot be read'),
        (('x.mat', '--truth', '/nonexist'), '/nonexist: no such file'),
        (('x.mat', '--camera', 'absent.yaml'), '--camera absent.yaml: cannot be read (No such file or directory)\n'),
        (('x.mat', '--camera', str(PROJECT / 'setup.cfg')), f'--camera {PROJECT / "setup.cfg"}: '),
        (('x.mat', '--json', '/absent/out.json'), '--json /absent/out.json: cannot be written (no such folder)'),
        (('x.mat', '--json', str(PROJECT)), f'--json {PROJECT}: cannot be written (is a folder)'),
        (('x.mat', '--duration', '-1'), '--duration -1: must be above 0'),
        (('x.mat', '--duration', 'nan'), '--duration nan: must be above 0'),
        (('x.mat', '--duration', '1e300'), '--duration 1e+300: must be above 0, at most 1e+09 s'),
        (('x.mat', '--start', 'nan'), '--start nan: must be from 0'),
        (('x.mat', '--start', '1e300'), '--start 1e+300: must be from 0 to 1e+09 s'),
    ],
)
def test_errors_are_one_line_and_exit_code_2(capsys, arguments, complaint) -> None:
    code, out, err = run(capsys, *arguments)
    assert code == 2
    assert out == ''
    assert err.count('\n') == 1
    assert err.startswith('beacon_evaluate: ')
    assert complaint in err


def parameters(*arguments: str) -> tuple[Parameters, list[str]]:
    import argparse

    parser = argparse.ArgumentParser()
    add_parameter_arguments(parser)
    return parameters_from(parser.parse_args(arguments))


def test_parameters_from_a_nodes_file_settings_and_flags(tmp_path) -> None:
    file = tmp_path / 'beacon.yaml'
    file.write_text('/**:\n  ros__parameters:\n    hop_s: 0.02\n    bit_rates: [100.0]\n    publish_rate_hz: 50.0\n')
    found, passed_over = parameters('--params', str(file), '--set', 'closing_px=5', '--bit-rate', '504,3125')
    assert (found.hop_s, found.closing_px, found.bit_rates) == (0.02, 5, (504.0, 3125.0))
    assert passed_over == ['publish_rate_hz']
    assert parameters()[0] == Parameters()
    assert parameters('--set', 'bit_rates=504')[0].bit_rates == (504.0,)
    assert parameters('--set', 'bit_rates=[504, 20]', '--set', 'idle_start=false')[0].idle_start is False


def test_a_flat_file_must_name_parameters(tmp_path) -> None:
    file = tmp_path / 'flat.yaml'
    file.write_text('hop_s: 0.02\nhopps: 3\n')
    with pytest.raises(ParameterError, match='hopps: no such parameter'):
        parameters('--params', str(file))
    file.write_text('- 1\n')
    with pytest.raises(ParameterError, match='not a mapping'):
        parameters('--params', str(file))
    file.write_text('a: [')
    with pytest.raises(ParameterError, match='no YAML'):
        parameters('--params', str(file))


@settings(deadline=None)
@given(
    st.lists(st.integers(0, 10_000), max_size=40),
    st.integers(0, 3000),
    st.sampled_from([7, 100, 1000]),
    st.one_of(st.none(), st.just((1 << 40) - 777)),
)
def test_cut_batches_are_the_batch(steps, tail, grid_ns, reached_ns) -> None:
    t_ns = (1 << 40) + np.sort(np.array(steps, np.int64))
    n = len(t_ns)
    end_ns = int(t_ns[-1]) + tail if n else (1 << 40) + tail
    x = np.arange(n, dtype=np.uint16)
    parts = list(cut_batch(EventBatch(x, x, np.ones(n, np.int8), t_ns, end_ns), grid_ns, reached_ns))
    assert np.array_equal(np.concatenate([part.x for part in parts]), x)
    assert parts[-1].t_end_ns == end_ns
    assert all(part.t_end_ns % grid_ns == 0 for part in parts[:-1])
    assert all(not len(part) or part.t_ns[-1] < part.t_end_ns for part in parts[:-1])
    assert all(
        not len(after) or after.t_ns[0] >= before.t_end_ns for before, after in zip(parts[:-1], parts[1:], strict=True)
    )


def test_a_missing_stretch_is_not_cut() -> None:
    t_ns = np.array([1250, 1260, 1330])
    x = np.arange(3, dtype=np.uint16)
    parts = list(cut_batch(EventBatch(x, x, np.ones(3, np.int8), t_ns, 1350, missing_until_ns=1250), 100, 1010))
    assert [(len(part), part.t_end_ns, part.missing_until_ns) for part in parts] == [(2, 1300, 1250), (1, 1350, None)]
    (part,) = cut_batch(replace(EventBatch.empty(1350), missing_until_ns=1350), 100, 1010)
    assert part.missing_until_ns == part.t_end_ns == 1350


def test_events_near_a_path() -> None:
    path = [PathPoint(0, 10.0, 10.0, 4.0), PathPoint(10**9, 110.0, 10.0, 4.0)]
    near = NearPath(path, 1.5, 2.0)
    x = np.array([10, 60, 60, 69, 110, 110], np.uint16)
    y = np.array([10, 10, 17, 10, 10, 30], np.uint16)
    t_ns = np.array([0, 5, 5, 5, 20, 20], np.int64) * 10**8 + 77
    near.push(EventBatch(x, y, np.array([1, -1, 1, 1, -1, 1], np.int8), t_ns, int(t_ns[-1])), 77)
    signal = near.signal()
    assert signal.t_ns.tolist() == [0, 5 * 10**8, 5 * 10**8, 20 * 10**8]
    assert signal.polarity.tolist() == [1, -1, 1, -1]


def test_the_table_is_aligned() -> None:
    drawn = table(('recording', 'wrong'), [('a', '1'), ('longer one', '123')]).splitlines()
    assert drawn[0] == 'recording   wrong'
    assert drawn[2] == 'a               1'
    assert drawn[3] == 'longer one    123'


def test_the_document_names_every_key() -> None:
    document = (PROJECT / 'docs' / 'evaluation.md').read_text()
    keys = (
        'recording receiver events seconds mev_per_s lost_packets skipped_words beacons track_id state confirmed_at_s'
        ' bit_rate_bps text path characters transmissions t_s code status confidence start_s wrong wrong_ok repaired'
        ' inserted message_accuracy bit_accuracy schema scene sent confirmed tracks false_confirmations on_reflections'
        ' stray_characters double_characters'
        ' objects reports matches misses false_positives id_switches fragmentations swaps mostly_tracked'
        ' partly_tracked mostly_lost mota motp_px idf1 id_precision id_recall hota detection_accuracy association_accuracy'
        ' mota_interval motp_interval_px message_interval bit_interval bits wrong_bits missing name kind seen_s locks begin_s'
        ' lock_s lost confirm_s position instants rms_px rms_interval_px median_px p95_px speed_px_per_s lag_s nees'
        ' nees_interval bearing_rms_rad bearing_nees bearing_nees_interval'
    )
    assert [key for key in keys.split() if f'`{key}`' not in document] == []
