"""The rooms import one another only as the README's architecture section allows."""

import ast
from pathlib import Path

import pytest

import beacon_comm

PACKAGE = Path(__file__).resolve().parents[1] / 'beacon_comm'

ALLOWED_ROOMS = {
    'core': set(),
    'wire': {'core'},
    'compiling': {'core', 'wire'},
    'reference': {'core', 'wire'},
    'simulation': {'core'},
    'recordings': {'core', 'wire', 'simulation'},
    'evaluation': {'core'},
    'ros': {'core', 'wire', 'compiling'},
    'cli': {'core', 'wire', 'simulation', 'recordings', 'evaluation', 'compiling'},
}
ROS_MODULES = {
    'rclpy', 'rosidl_runtime_py', 'std_msgs', 'sensor_msgs', 'geometry_msgs', 'diagnostic_msgs', 'builtin_interfaces',
    'rosgraph_msgs', 'event_camera_msgs', 'ament_index_python', 'launch', 'launch_ros',
}
MAY_USE_ROS = {'ros', 'cli'}
CORE_AND_WIRE_THIRD_PARTY = {'numpy', 'numba', 'cv2', 'scipy', 'yaml'}
STANDARD_LIBRARY_NOT_IN_CORE = {'time', 'datetime', 'logging', 'socket', 'threading', 'random'}


def modules(room: str) -> list[Path]:
    return sorted((PACKAGE / room).rglob('*.py'))


def imported(path: Path) -> set[str]:
    """Return the dotted names a module imports anywhere, also inside functions."""
    names = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            names.update(alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f'{path}: relative import'
            names.update(f'{node.module}.{alias.name}' for alias in node.names)
    return names


def test_every_room_has_a_rule_and_modules() -> None:
    rooms = {path.name for path in PACKAGE.iterdir() if path.is_dir() and any(path.glob('*.py'))}
    assert rooms == set(ALLOWED_ROOMS)


@pytest.mark.parametrize('room', ALLOWED_ROOMS)
def test_a_room_imports_only_the_rooms_it_may(room: str) -> None:
    for path in modules(room):
        for name in imported(path):
            parts = name.split('.')
            if parts[0] != beacon_comm.__name__ or len(parts) < 2:
                continue
            if parts[1] == 'msg':
                assert room in MAY_USE_ROS, f'{path} imports {name}'
            else:
                assert parts[1] == room or parts[1] in ALLOWED_ROOMS[room], f'{path} imports {name}'


@pytest.mark.parametrize('room', sorted(set(ALLOWED_ROOMS) - MAY_USE_ROS))
def test_only_the_node_and_the_command_lines_import_ros(room: str) -> None:
    for path in modules(room):
        roots = {name.split('.')[0] for name in imported(path)}
        assert not roots & ROS_MODULES, f'{path} imports {roots & ROS_MODULES}'


@pytest.mark.parametrize('room', ['core', 'wire'])
def test_the_core_is_pure(room: str) -> None:
    """No wall clock, no printing, no logging, no third party beyond the numeric ones."""
    import sys

    for path in modules(room):
        roots = {name.split('.')[0] for name in imported(path)}
        assert not roots & STANDARD_LIBRARY_NOT_IN_CORE, f'{path} imports {roots & STANDARD_LIBRARY_NOT_IN_CORE}'
        foreign = roots - set(sys.stdlib_module_names) - {beacon_comm.__name__}
        assert foreign <= CORE_AND_WIRE_THIRD_PARTY, f'{path} imports {foreign}'
        for node in ast.walk(ast.parse(path.read_text())):
            assert not (isinstance(node, ast.Name) and node.id == 'print'), f'{path} prints'


def test_no_float32_in_the_core() -> None:
    for path in modules('core') + modules('wire'):
        assert 'float32' not in path.read_text(), f'{path} uses float32'
