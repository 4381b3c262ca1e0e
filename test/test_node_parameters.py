"""The node's parameters: one declaration for the YAML file, the table, the ROS side and the checks."""

import ast
import math
from pathlib import Path

import pytest
import yaml

from beacon_comm.core.errors import ParameterError
from beacon_comm.core.parameters import Parameters, declarations
from beacon_comm.ros.parameters import (
    NodeParameters,
    all_declarations,
    markdown_text,
    read_parameters,
    unknown_parameters,
    yaml_text,
)

PROJECT = Path(__file__).resolve().parents[1]


class FakeNode:
    """Takes declarations as rclpy's Node does, as far as they matter here."""

    def __init__(self, **given: object) -> None:
        self.given = given
        self.stored: dict[str, object] = {}
        self.descriptors: dict[str, object] = {}

    def declare_parameter(self, name: str, value: object, descriptor: object, ignore_override: bool = False) -> object:
        assert name not in self.stored
        self.stored[name] = value if ignore_override else self.given.get(name, value)
        self.descriptors[name] = descriptor
        return type('Parameter', (), {'value': self.stored[name]})

    def undeclare_parameter(self, name: str) -> None:
        del self.stored[name]


def test_the_yaml_file_holds_the_defaults() -> None:
    assert (PROJECT / 'config' / 'beacon.yaml').read_text() == yaml_text(), (
        'run: python -m beacon_comm.ros.parameters > config/beacon.yaml'
    )


def test_the_page_of_parameters_is_up_to_date() -> None:
    assert (PROJECT / 'docs' / 'parameters.md').read_text() == markdown_text(), (
        'run: python -m beacon_comm.ros.parameters --markdown > docs/parameters.md'
    )


def test_the_yaml_file_reads_back_to_the_defaults() -> None:
    values = yaml.safe_load(yaml_text())['/**']['ros__parameters']
    assert list(values) == [declaration.name for declaration in all_declarations()]
    for declaration in all_declarations():
        value = values[declaration.name]
        assert declaration.check(value) == declaration.default
        expected = list if isinstance(declaration.default, tuple) else type(declaration.default)
        assert type(value) is expected, declaration.name  # ROS takes its parameter types from the file


def test_every_parameter_has_a_meaning_and_its_own_name() -> None:
    names = [declaration.name for declaration in all_declarations()]
    assert len(names) == len(set(names))
    assert all(declaration.meaning for declaration in all_declarations())


def test_the_table_has_a_row_for_every_parameter() -> None:
    rows = markdown_text().splitlines()[6:]
    assert [row.split('`')[1] for row in rows] == [declaration.name for declaration in all_declarations()]
    assert all(row.replace('\\|', '').count('|') == 5 for row in rows)


def test_whole_numbers_are_taken_for_real_ones() -> None:
    pytest.importorskip('rclpy')
    node = FakeNode(bit_rates=[504, 3125], publish_rate_hz=10, candidate_slots=2)
    core, own = read_parameters(node)  # type: ignore[arg-type]
    assert core.bit_rates == (504.0, 3125.0) and core.candidate_slots == 2
    assert own.publish_rate_hz == 10.0 and isinstance(node.stored['publish_rate_hz'], float)
    assert node.stored['bit_rates'] == [504.0, 3125.0]


def test_everything_is_declared_with_its_range_and_read_only() -> None:
    pytest.importorskip('rclpy')
    node = FakeNode()
    assert read_parameters(node) == (Parameters(), NodeParameters())  # type: ignore[arg-type]
    assert set(node.stored) == {declaration.name for declaration in all_declarations()}
    for name, descriptor in node.descriptors.items():
        assert descriptor.read_only and descriptor.description, name  # type: ignore[attr-defined]
    rate = node.descriptors['publish_rate_hz'].floating_point_range[0]  # type: ignore[attr-defined]
    assert (rate.from_value, rate.to_value) == (0.1, 1000.0)
    depth = node.descriptors['min_area_px'].integer_range[0]  # type: ignore[attr-defined]
    assert (depth.from_value, depth.to_value) == (1, 2**63 - 1)
    assert node.descriptors['index_threshold'].floating_point_range[0].to_value == math.inf  # type: ignore[attr-defined]


@pytest.mark.parametrize(
    ('given', 'line'),
    [
        ({'publish_rate_hz': 0.0}, r'publish_rate_hz = 0.0: must lie in \[0.1, 1000\] Hz'),
        ({'qos_reliability': 'sometimes'}, 'qos_reliability = .sometimes.: must be one of best_effort, reliable'),
        ({'bit_rates': 504}, 'bit_rates = 504: must be a list'),
        ({'bit_rates': []}, r'bit_rates = \[\]: must be a list of at least one'),
        ({'use_camera_info': 1}, 'use_camera_info = 1: must be true or false'),
        ({'index_threshold': math.nan}, 'index_threshold = nan: must be a number'),
        ({'candidate_slots': 2, 'reserved_candidate_slots': 3}, 'reserved_candidate_slots = 3: more than'),
        ({'qos_depth': 1.5}, 'qos_depth = 1.5: must be a whole number'),
    ],
)
def test_a_wrong_value_is_refused_by_name(given: dict[str, object], line: str) -> None:
    pytest.importorskip('rclpy')
    with pytest.raises(ParameterError, match=line):
        read_parameters(FakeNode(**given))  # type: ignore[arg-type]


def test_an_unknown_name_is_told_with_its_neighbour() -> None:
    given = ['bitrates', 'use_sim_time', 'qos_overrides./events.subscription.depth', 'hop_s', 'zzz']
    assert unknown_parameters(given) == ['bitrates: no such parameter; did you mean bit_rates?', 'zzz: no such parameter']


def test_the_launch_file_passes_only_what_there_is() -> None:
    tree = ast.parse((PROJECT / 'launch' / 'beacon.launch.py').read_text())
    words = {node.value for node in ast.walk(tree) if isinstance(node, ast.Constant) and isinstance(node.value, str)}
    assert {'beacon_node', 'events', 'beacon.yaml', 'fastdds_shm.xml', 'camera_info_file'} <= words
    for name in ('beacon.yaml', 'fastdds_shm.xml'):
        assert (PROJECT / 'config' / name).is_file()
    assert 'camera_info_file' in {declaration.name for declaration in declarations(NodeParameters)}
