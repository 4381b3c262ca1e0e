"""The package as it is installed: names that agree, files that are found, a colcon build whose node runs."""

import configparser
import importlib
import importlib.metadata
import importlib.util
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterator
from pathlib import Path

import pytest

PROJECT = Path(__file__).resolve().parents[1]
PACKAGE = 'beacon_comm'
EVENT_PACKET_HASH = 'RIHS01_d6fa176260b1f37e5a40845305315e150a0f18191241eb64f407442aa29844aa'
BUILD_TIMEOUT_S = 400
START_TIMEOUT_S = 120  # the first start compiles the kernels
STOP_TIMEOUT_S = 20
SOURCES = ('package.xml', 'CMakeLists.txt', 'setup.cfg', PACKAGE, 'cmake', 'config', 'launch', 'msg', 'test')

# Run beside the node, in an environment of the same workspace: leaves as soon as the node is seen.
WATCHER = """
import sys
import time

import rclpy

rclpy.init()
watcher = rclpy.create_node('packaging_watcher')
deadline = time.monotonic() + float(sys.argv[1])
topics = set()
while time.monotonic() < deadline:
    topics = {name for name, _ in watcher.get_topic_names_and_types()}
    if '/beacon_node/beacons' in topics:
        break
    time.sleep(0.1)
print(*sorted(topics))
sys.exit('/beacon_node/beacons' not in topics)
"""


def setup_cfg() -> configparser.ConfigParser:
    """Return setup.cfg, read."""
    parser = configparser.ConfigParser()
    parser.read(PROJECT / 'setup.cfg', encoding='utf-8')
    return parser


def console_scripts() -> dict[str, str]:
    """Return the executables by name, each with its ``module:function``."""
    lines = setup_cfg()['options.entry_points']['console_scripts'].strip().splitlines()
    return {name.strip(): target.strip() for name, target in (line.split('=') for line in lines)}


def manifest() -> ElementTree.Element:
    """Return the root of package.xml."""
    return ElementTree.parse(PROJECT / 'package.xml').getroot()


def text_of(tag: str) -> str:
    """Return the text of package.xml's element of that name."""
    found = manifest().findtext(tag)
    assert found is not None, f'package.xml has no <{tag}>'
    return found


# ---- names and versions -------------------------------------------------------------------------

def test_name_version_and_licence_agree() -> None:
    metadata = setup_cfg()['metadata']
    assert text_of('name') == metadata['name'] == PACKAGE
    assert text_of('version') == metadata['version']
    assert text_of('license') == metadata['license']
    assert (PROJECT / 'LICENSE').read_text().split()[:2] == ['Apache', 'License']


def test_changelog_begins_with_this_version() -> None:
    changelog = (PROJECT / 'CHANGELOG.rst').read_text()
    assert changelog.splitlines()[1] == f'Changelog for package {PACKAGE}'
    released = re.search(r'^(\d+\.\d+\.\d+)', changelog, re.MULTILINE)
    assert released is not None
    assert released[1] == text_of('version')


def test_installed_version_is_this_one() -> None:
    if importlib.util.find_spec('ros_wheels_bootstrapper') is None:
        pytest.skip('only pip records a version; this is a ROS from apt')
    assert importlib.metadata.version(PACKAGE) == text_of('version')


def test_cmake_project_and_message_packages_are_in_package_xml() -> None:
    cmake = (PROJECT / 'CMakeLists.txt').read_text()
    depends = {element.text for element in manifest() if element.tag.endswith('depend')}
    assert f'project({PACKAGE})' in cmake
    used = {match for path in (PROJECT / 'msg').glob('*.msg')
            for match in re.findall(r'^([a-z0-9_]+)/', path.read_text(), re.MULTILINE)}
    assert used - {PACKAGE} <= depends
    for package in used - {PACKAGE}:
        assert f'find_package({package} REQUIRED)' in cmake


def test_build_files_name_no_wheel() -> None:
    """A robot has ROS from apt: neither the build nor the modules may rely on what PyPI's wheels bring."""
    files = [PROJECT / 'CMakeLists.txt', *(PROJECT / PACKAGE).rglob('*.py'), *(PROJECT / 'launch').glob('*.py')]
    for path in files:
        assert not re.search(r'ros_wheels|ros-jazzy-|site-packages', path.read_text()), path


def test_message_definitions_hold_no_backslash() -> None:
    """The generator pastes comments into Python literals: a backslash in one breaks the build."""
    for path in (PROJECT / 'msg').glob('*.msg'):
        assert '\\' not in path.read_text(), path.name


# ---- the installed package ----------------------------------------------------------------------

@pytest.mark.parametrize('name', sorted(console_scripts()))
def test_executable_is_importable(name: str) -> None:
    module, function = console_scripts()[name].split(':')
    assert callable(getattr(importlib.import_module(module), function))


def test_python_modules_are_all_installed() -> None:
    spec = importlib.util.find_spec(PACKAGE)
    assert spec is not None and spec.submodule_search_locations
    installed = Path(spec.submodule_search_locations[0])
    for path in (PROJECT / PACKAGE).rglob('*.py'):
        assert (installed / path.relative_to(PROJECT / PACKAGE)).is_file(), f'{path} is not installed; make setup'


def test_sub_packages_are_packages() -> None:
    """A folder without __init__.py would be left out by pip's package search."""
    for path in (PROJECT / PACKAGE).rglob('*.py'):
        assert (path.parent / '__init__.py').is_file(), path.parent


def test_share_is_found_and_complete() -> None:
    index = pytest.importorskip('ament_index_python.packages')
    share = Path(index.get_package_share_directory(PACKAGE))
    wanted = [path for folder in ('config', 'launch') for path in (PROJECT / folder).rglob('*')
              if path.is_file() and '__pycache__' not in path.parts]
    wanted.append(PROJECT / 'package.xml')
    assert PROJECT / 'config' / 'fastdds_shm.xml' in wanted
    for path in wanted:
        assert (share / path.relative_to(PROJECT)).read_bytes() == path.read_bytes(), f'{path} is not installed as it is'


def test_messages_are_all_built() -> None:
    messages = importlib.import_module(f'{PACKAGE}.msg')
    for path in (PROJECT / 'msg').glob('*.msg'):
        assert getattr(messages, path.stem)() is not None


def test_fast_dds_profile_is_well_formed() -> None:
    root = ElementTree.parse(PROJECT / 'config' / 'fastdds_shm.xml').getroot()
    sizes = [int(element.text or 0) for element in root.iter() if element.tag.endswith('segment_size')]
    assert sizes == [64 * 1024 * 1024]


def test_event_packet_has_the_drivers_type_hash() -> None:
    index = pytest.importorskip('ament_index_python.packages')
    share = Path(index.get_package_share_directory('event_camera_msgs'))
    hashes = json.loads((share / 'msg' / 'EventPacket.json').read_text())['type_hashes']
    assert {entry['type_name']: entry['hash_string'] for entry in hashes}[
        'event_camera_msgs/msg/EventPacket'] == EVENT_PACKET_HASH
    packet = importlib.import_module('event_camera_msgs.msg').EventPacket
    assert list(packet.get_fields_and_field_types()) == [
        'header', 'height', 'width', 'seq', 'time_base', 'encoding', 'is_bigendian', 'events']


# ---- a colcon workspace -------------------------------------------------------------------------

def ros_prefix() -> Path:
    """Return the folder that the ROS packages in use are installed below."""
    import rclpy
    return Path(rclpy.__file__).resolve().parents[4]


def from_wheels() -> bool:
    """Tell whether ROS comes from PyPI's wheels (else from a sourced workspace)."""
    return importlib.util.find_spec('ros_wheels_bootstrapper') is not None


def build_environment() -> dict[str, str]:
    """Return the environment that ``colcon build`` runs in: that of a sourced ROS."""
    environment = {name: value for name, value in os.environ.items() if name != 'PYTHONSAFEPATH'}
    if from_wheels():
        prefix = str(ros_prefix())
        environment['PATH'] = os.pathsep.join([f'{prefix}/bin', environment['PATH']])
        environment['AMENT_PREFIX_PATH'] = environment['CMAKE_PREFIX_PATH'] = prefix
        environment.pop('PYTHONPATH', None)
    return environment


@pytest.fixture(scope='module')
def workspace(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Build a copy of the package with ``colcon build`` in a scratch workspace; return the workspace."""
    if importlib.util.find_spec('colcon_core') is None and shutil.which('colcon') is None:
        pytest.skip('colcon is not installed')
    root = tmp_path_factory.mktemp('workspace')
    copy = root / 'src' / PACKAGE
    copy.mkdir(parents=True)
    for name in SOURCES:
        source = PROJECT / name
        if source.is_dir():
            shutil.copytree(source, copy / name, ignore=shutil.ignore_patterns('__pycache__', '*.pyc'))
        else:
            shutil.copy(source, copy / name)
    cache = copy / PACKAGE / 'core' / '__pycache__'
    cache.mkdir()
    (cache / 'left_over.nbi').touch()
    command = ['colcon', 'build', '--event-handlers', 'console_direct+']
    if from_wheels():
        command += ['--cmake-args', f'-DPython3_EXECUTABLE={sys.executable}',
                    f'-DCMAKE_PROJECT_INCLUDE={PROJECT / "cmake" / "ros_wheels.cmake"}']
    built = subprocess.run(command, cwd=root, env=build_environment(), stdin=subprocess.DEVNULL, text=True,
                           stdout=subprocess.PIPE, stderr=subprocess.STDOUT, timeout=BUILD_TIMEOUT_S, check=False)
    assert built.returncode == 0, built.stdout[-8000:]
    return root


@pytest.fixture(scope='module')
def sourced(workspace: Path) -> dict[str, str]:
    """Return the environment after ``source install/setup.bash``, in a ROS domain that is not the default."""
    printed = subprocess.run(['bash', '-c', 'source install/setup.bash && env -0'], cwd=workspace,
                             env=build_environment(), capture_output=True, timeout=60, check=True).stdout.decode()
    environment = dict(entry.split('=', 1) for entry in printed.split('\0') if entry)
    environment['ROS_DOMAIN_ID'] = str(60 + os.getpid() % 40)
    environment['ROS_AUTOMATIC_DISCOVERY_RANGE'] = 'LOCALHOST'
    environment['PYTHONUNBUFFERED'] = '1'
    if from_wheels():
        # The wheels' start-up hook puts the libraries in no certain order, and the environment holds a
        # second beacon_comm, installed by pip.  Set by hand, the workspace's come first.
        prefix = ros_prefix()
        environment['LD_LIBRARY_PATH'] = os.pathsep.join(
            [str(workspace / 'install' / PACKAGE / 'lib'), str(prefix / 'lib'),
             *map(str, prefix.glob('lib/python*/site-packages/ros_*.libs'))])
        environment['_ROS_WHEELS_BOOTSTRAP_COMPLETE'] = '1'
    return environment


@pytest.fixture
def node(workspace: Path, sourced: dict[str, str], tmp_path: Path) -> Iterator[subprocess.Popen[bytes]]:
    """Start the node from install/, as ``ros2 run`` does; its output goes to node.log."""
    executable = workspace / 'install' / PACKAGE / 'lib' / PACKAGE / 'beacon_node'
    with (tmp_path / 'node.log').open('wb') as log:
        process = subprocess.Popen([executable], cwd=tmp_path, env=sourced, stdin=subprocess.DEVNULL,
                                   stdout=log, stderr=subprocess.STDOUT)
        try:
            yield process
        finally:
            if process.poll() is None:
                process.kill()
            process.wait(timeout=STOP_TIMEOUT_S)


def test_colcon_installs_every_executable(workspace: Path) -> None:
    installed = workspace / 'install' / PACKAGE / 'lib' / PACKAGE
    assert sorted(path.name for path in installed.iterdir()) == sorted(console_scripts())
    assert all(os.access(path, os.X_OK) for path in installed.iterdir())


def test_colcon_installs_every_module_and_no_cache(workspace: Path) -> None:
    installed = next((workspace / 'install' / PACKAGE / 'lib').glob('python*/site-packages')) / PACKAGE
    for path in (PROJECT / PACKAGE).rglob('*.py'):
        assert (installed / path.relative_to(PROJECT / PACKAGE)).is_file(), path
    assert not list((workspace / 'install').rglob('left_over.nbi'))


def test_node_from_install_starts_and_ends_by_interrupt(
        workspace: Path, sourced: dict[str, str], node: subprocess.Popen[bytes], tmp_path: Path) -> None:
    log = tmp_path / 'node.log'
    with subprocess.Popen([sys.executable, '-c', WATCHER, str(START_TIMEOUT_S)], cwd=tmp_path, env=sourced,
                          stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True) as watcher:
        while watcher.poll() is None and node.poll() is None:
            time.sleep(0.1)
        watcher.terminate()
        seen, _ = watcher.communicate(timeout=STOP_TIMEOUT_S)
    assert node.poll() is None, log.read_text()
    assert watcher.returncode == 0, f'topics seen: {seen}\nthe node said: {log.read_text()}'

    maps = Path(f'/proc/{node.pid}/maps')
    if maps.exists():
        loaded = set(re.findall(rf'/\S*lib{PACKAGE}__\S+', maps.read_text()))
        assert loaded, 'the node has loaded no message library'
        assert all(Path(path).is_relative_to(workspace) for path in loaded), loaded

    started = time.monotonic()
    node.send_signal(signal.SIGINT)
    assert node.wait(timeout=STOP_TIMEOUT_S) == 0, log.read_text()
    assert time.monotonic() - started < STOP_TIMEOUT_S
    assert 'Traceback' not in log.read_text()
