"""``beacon_simulate``: from a scene file to a bag that the receiver reads, with its truth."""

import hashlib
import json
from pathlib import Path

import numpy as np
import pytest

from beacon_comm.cli import evaluate
from beacon_comm.cli.simulate import main, own_scenes
from beacon_comm.core.bearing import CameraModel
from beacon_comm.core.events import EventBatch
from beacon_comm.evaluation.truth import load_truth
from beacon_comm.recordings.bags import open_recording
from beacon_comm.recordings.truth import read_truth
from beacon_comm.simulation.description import page, read_description
from beacon_comm.simulation.scene import SimulatedScene
from beacon_comm.wire.stream import EventStream

PROJECT = Path(__file__).resolve().parents[1]
SCENES = sorted((PROJECT / 'config' / 'scenes').glob('*.yaml'))
SCENE = """\
duration_s: 1.5
sensor: {width: 96, height: 80}
camera: {focal_px: 120, distortion: [-0.1, 0.02, 0, 0]}
shake: {amplitude_px: 3, frequency_hz: 4}
beacons:
  - name: front
    text: "Hello, robot. "
    bit_rate_bps: 1000
    path: {kind: line, from_px: [30, 30], speed_px_per_s: 40, direction_deg: 30, margin_px: 20}
distractors:
  - {kind: lamp, path: {kind: still, at_px: [80, 12]}, radius_px: 2}
"""


@pytest.fixture
def scene(tmp_path: Path) -> Path:
    path = tmp_path / 'scene.yaml'
    path.write_text(SCENE)
    return path


def events_of(bag: Path) -> EventBatch:
    with open_recording(bag) as opened:
        topic = opened.event_topic()
        stream = EventStream(topic.type)
        parts = [stream.push(cdr).batch for _, cdr in opened.messages(topic)]
    some = [part for part in parts if part is not None]
    joined = (np.concatenate([getattr(part, name) for part in some]) for name in ('x', 'y', 'polarity', 't_ns'))
    return EventBatch(*joined, some[-1].t_end_ns)


def test_a_simulated_bag_is_read_by_the_receiver_and_its_truth_is_true(scene: Path, tmp_path: Path, capsys) -> None:
    bag = tmp_path / 'bag'
    assert main([str(scene), '--output', str(bag), '--seed', '4']) == 0
    assert '1 beacons, 1 distractors' in capsys.readouterr().err
    truth = read_truth(bag)
    (front,) = truth.beacons
    assert (front.name, front.text, truth.seed, truth.duration_s) == ('front', 'Hello, robot. ', 4, 1.5)
    assert bytes(front.codes).decode() == ('Hello, robot. ' * 20)[: len(front.codes)]
    # The events are where the truth says, and their first is there when it says.
    events = events_of(bag)
    x, y = front.centre(events.t_ns)
    near = np.hypot(events.x - x, events.y - y) < front.radius_px(events.t_ns)
    assert near.sum() > 50_000
    assert np.mean((events.x - x)[near]) == pytest.approx(0.0, abs=0.2)
    assert np.mean((events.y - y)[near]) == pytest.approx(0.0, abs=0.2)
    # What the receiver reads is what was sent.
    result = tmp_path / 'result.json'
    arguments = [str(bag), '--truth', front.text, '--json', str(result), '--camera', str(bag / 'camera.yaml')]
    assert evaluate.main([*arguments, '--set', 'bit_rates=[1000.0]']) == 0
    confirmed = [one for one in json.loads(result.read_text())['beacons'] if one['state'] == 'confirmed']
    assert len(confirmed) == 1
    read_ns = np.array([one['t_s'] * 1e9 for one in confirmed[0]['characters']])
    codes = np.array([one['code'] for one in confirmed[0]['characters']])
    nearest = np.abs(read_ns - front.characters_ns[:, None]).argmin(axis=1)
    right = (codes[nearest] == front.codes) & (np.abs(read_ns[nearest] - front.characters_ns) < 2 * 1e6)
    assert right.mean() > 0.95


def test_the_same_seed_gives_the_same_bytes_in_every_format(scene: Path, tmp_path: Path) -> None:
    digests, found = set(), []
    for name, arguments in {
        'a': [], 'b': [], 'c': ['--seed', '1'], 'd': ['--format', 'dvs_msgs'],
    }.items():  # fmt: skip
        assert main([str(scene), '--output', str(tmp_path / name), '--duration', '0.1', *arguments]) == 0
        with open_recording(tmp_path / name) as opened:
            topic = opened.event_topic()
            content = b''.join(bytes(cdr) for _, cdr in opened.messages(topic))
        digests.add(hashlib.sha256(content).hexdigest())
        found.append((topic.type, events_of(tmp_path / name)))
    assert len(digests) == 3
    assert found[3][0] == 'dvs_msgs/msg/EventArray'
    for name in ('x', 'y', 'polarity', 't_ns'):
        assert np.array_equal(getattr(found[0][1], name), getattr(found[3][1], name))


def test_the_camera_is_written_as_the_node_reads_it(scene: Path, tmp_path: Path) -> None:
    assert main([str(scene), '--output', str(tmp_path / 'bag'), '--duration', '0.01']) == 0
    camera = CameraModel.from_yaml(tmp_path / 'bag' / 'camera.yaml')
    assert (camera.width, camera.k[0, 0], camera.k[0, 2]) == (96, 120.0, 47.5)
    assert np.array_equal(camera.d, [-0.1, 0.02, 0, 0])


def test_a_recorded_background_is_mixed_in(scene: Path, tmp_path: Path, capsys) -> None:
    assert main([str(scene), '--output', str(tmp_path / 'under'), '--duration', '0.05']) == 0
    scene.write_text(SCENE + 'background: {bag: under}\n')
    assert main([str(scene), '--output', str(tmp_path / 'both'), '--duration', '0.05']) == 0
    assert len(events_of(tmp_path / 'both')) > 1.9 * len(events_of(tmp_path / 'under'))
    scene.write_text(SCENE.replace('96', '97') + 'background: {bag: under}\n')
    assert main([str(scene), '--output', str(tmp_path / 'no')]) == 2
    assert "background.bag = 'under': has 96×80 pixels, the sensor 97×80" in capsys.readouterr().err


@pytest.mark.parametrize(
    ('content', 'arguments', 'reason'),
    [
        (SCENE.replace('40,', '-1,'), [], 'scene.yaml: beacons[0].path.speed_px_per_s = -1: must lie in [0, 50000]'),
        (SCENE.replace('30, 30]', '3, 30]'), [], 'scene.yaml: beacons[0].path.from_px = [3.0, 30.0]: x must lie in'),
        ('beacons: [', [], 'scene.yaml: no YAML (while parsing'),
        (SCENE, ['--duration', '-2'], '--duration -2: duration_s = -2.0: must lie in'),
        (SCENE.replace('"Hello, robot. "', 'absent.txt'), [], 'scene.yaml: beacons: text: absent.txt: no such file'),
        (SCENE, ['--format', 'raw'], "argument --format: invalid choice: 'raw'"),
        (SCENE, ['--output', '{tmp}'], 'exists already, nothing is overwritten'),
        (None, [], 'scene.yaml: no such file, nor one of the scenes circle, crossing'),
    ],
)
def test_errors_are_one_line_and_exit_code_2(content, arguments, reason, scene: Path, tmp_path: Path, capsys) -> None:
    scene.unlink() if content is None else scene.write_text(content)
    try:
        code = main([str(scene), '--output', str(tmp_path / 'out'), *(one.format(tmp=tmp_path) for one in arguments)])
    except SystemExit as leaving:
        code = leaving.code
    printed = capsys.readouterr()
    assert code == 2 and reason in printed.err and printed.err.count('\n') == 1


def test_a_text_file_lies_beside_the_scene_and_the_bag_is_called_as_that(scene: Path, tmp_path: Path, monkeypatch) -> None:
    scene.write_text(SCENE.replace('"Hello, robot. "', 'words.txt'))
    (scene.parent / 'words.txt').write_text('robots')
    elsewhere = tmp_path / 'elsewhere'
    elsewhere.mkdir()
    monkeypatch.chdir(elsewhere)
    assert main([str(scene), '--duration', '0.05']) == 0
    assert read_truth(elsewhere / scene.stem).beacons[0].text == 'robots'


def test_a_beacon_that_is_never_in_sight_is_told_of(scene: Path, tmp_path: Path, capsys) -> None:
    still = 'duration_s: 0.02\nbeacons: [{path: {kind: still, at_px: [9999, 20]}}, {path: {kind: still, at_px: [50, 20]}}]\n'
    scene.write_text(still)
    assert main([str(scene), '--output', str(tmp_path / 'bag')]) == 0
    assert capsys.readouterr().err.count('beacon 1 is never in sight') == 1


@pytest.mark.parametrize('path', SCENES, ids=lambda path: path.stem)
def test_the_packages_own_scenes_can_be_read(path: Path) -> None:
    description, _ = read_description(path, load_truth)
    SimulatedScene(description)
    assert path.read_text().startswith('# ')
    assert path.stem in own_scenes()


def test_the_own_scenes_are_listed(capsys) -> None:
    assert main(['--list']) == 0
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) == len(SCENES) and lines[0].startswith('circle ')


def test_the_page_of_the_keys_is_that_of_the_code() -> None:
    assert (PROJECT / 'docs' / 'scenes_format.md').read_text() == page()
