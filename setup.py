"""The pip side of the package: builds the same CMake project as ``colcon build`` does.

colcon ignores this file (package.xml says ament_cmake).  ``pip install .`` uses it to put the ROS
interfaces, share/ and lib/beacon_comm/ into the environment's prefix.
"""

import os
import shutil
import subprocess
import sys
from pathlib import Path

from setuptools import Distribution, setup
from setuptools.command.build_py import build_py

HERE = Path(__file__).resolve().parent
PACKAGE = 'beacon_comm'

# Read by Python's start-up: ament's index then finds share/ of the environment by itself.  A sourced
# workspace keeps precedence.  It sorts before the ROS wheels' own start-up file, which re-executes Python.
PREFIX_HOOK = (
    "import os, sys; v = os.environ.get('AMENT_PREFIX_PATH', ''); sys.prefix in v.split(os.pathsep) or "
    "os.environ.__setitem__('AMENT_PREFIX_PATH', v + os.pathsep + sys.prefix if v else sys.prefix)\n"
)


def ros_prefix() -> str:
    """Return the prefix of the ROS packages that pip has given this build."""
    import ament_package
    # <prefix>/lib/pythonX.Y/site-packages/ament_package/__init__.py
    return str(Path(ament_package.__file__).resolve().parents[4])


class BuildPy(build_py):
    """Builds and stages the CMake project, then hands the staged files to the wheel."""

    def run(self) -> None:
        """Fill build_lib with the Python part and data_files with the rest."""
        shutil.rmtree(Path(self.build_lib) / PACKAGE, ignore_errors=True)  # deleted modules stay deleted
        super().run()
        stage = self._cmake_stage()
        site = next(stage.glob('**/*-packages'))
        shutil.copytree(site / PACKAGE, Path(self.build_lib) / PACKAGE, dirs_exist_ok=True,
                        ignore=shutil.ignore_patterns('__pycache__', '*.c'))
        (Path(self.build_lib) / f'{PACKAGE}_prefix.pth').write_text(PREFIX_HOOK)
        files: dict[str, list[str]] = {}
        for top in ('lib', 'share'):
            for path in sorted((stage / top).rglob('*')):
                if path.is_file() and site not in path.parents:
                    files.setdefault(str(path.relative_to(stage).parent), []).append(str(path))
        self.distribution.data_files[:] = sorted(files.items())

    def _cmake_stage(self) -> Path:
        work = Path(self.get_finalized_command('build').build_temp).resolve() / 'cmake'
        shutil.rmtree(work, ignore_errors=True)
        prefix = ros_prefix()
        tools = os.pathsep.join([str(Path(sys.executable).parent), os.environ.get('PATH', '')])
        env = dict(os.environ, AMENT_PREFIX_PATH=prefix, PATH=tools)
        generator = ['-G', 'Ninja'] if shutil.which('ninja', path=tools) else []
        for command in (
            ['cmake', '-S', str(HERE), '-B', str(work / 'build'), *generator,
             '-DCMAKE_BUILD_TYPE=Release', '-DBUILD_TESTING=OFF',
             f'-DCMAKE_INSTALL_PREFIX={work / "stage"}',
             f'-DCMAKE_PREFIX_PATH={prefix}',
             f'-DPython3_EXECUTABLE={sys.executable}',
             f'-DCMAKE_PROJECT_INCLUDE={HERE / "cmake" / "ros_wheels.cmake"}'],
            ['cmake', '--build', str(work / 'build'), '--parallel'],
            ['cmake', '--install', str(work / 'build')],
        ):
            subprocess.run(command, check=True, env=env)
        return work / 'stage'


class BinaryDistribution(Distribution):
    """The generated type support is compiled, so the wheel is for one Python and one platform."""

    def has_ext_modules(self) -> bool:
        """Say so to setuptools, which looks for extensions of its own only."""
        return True


setup(
    cmdclass={'build_py': BuildPy},
    distclass=BinaryDistribution,
    data_files=[('share/beacon_comm', ['package.xml'])],  # replaced by all of the staged files
)
