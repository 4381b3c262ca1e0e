"""Makes the environment's installed copy of the package follow the checkout.

pip installs copies.  Each installed file that comes straight from the checkout (a Python module, a
configuration or launch file) is replaced by a link to it, so that an edit counts at once and the
messages are compiled only when they change.  ``--remove`` takes the links away again, which has to come
before pip installs anew: it must not follow a link and write into the checkout.

numba's caches of compiled functions know the file of the function alone, not those of the functions it
calls: all caches older than the newest module are deleted.
"""

import argparse
import os
import sys
import sysconfig
from collections.abc import Iterator
from pathlib import Path

HERE = Path(__file__).resolve().parents[1]
PACKAGE = 'beacon_comm'
SITE = Path(sysconfig.get_path('platlib')) / PACKAGE
SHARE = Path(sys.prefix) / 'share' / PACKAGE
LINKED = (
    (HERE / PACKAGE, SITE),
    (HERE / 'config', SHARE / 'config'),
    (HERE / 'launch', SHARE / 'launch'),
)


def sources(folder: Path) -> Iterator[Path]:
    """Yield the files of a folder of the checkout that are installed as they are."""
    for path in sorted(folder.rglob('*')):
        if path.is_file() and '__pycache__' not in path.parts and path.suffix != '.pyc':
            yield path


def remove_links(installed: Path) -> None:
    """Delete every link below an installed folder, and folders that this leaves empty."""
    for path in sorted(installed.rglob('*'), reverse=True):
        if path.is_symlink():
            path.unlink()
        elif path.is_dir() and not any(path.iterdir()):
            path.rmdir()


def is_generated(path: Path) -> bool:
    """Tell whether an installed file is the build's own: the message modules and their libraries."""
    return path.suffix == '.so' or (SITE / 'msg') in path.parents


def make_links(folder: Path, installed: Path) -> None:
    """Link an installed folder to the checkout's; what the checkout no longer has goes."""
    wanted = {installed / path.relative_to(folder): path for path in sources(folder)}
    for path in sorted(installed.rglob('*')):
        if (path.is_symlink() or path.is_file()) and '__pycache__' not in path.parts and path not in wanted \
                and not is_generated(path):
            path.unlink()
    for link, target in wanted.items():
        if link.is_symlink() and os.readlink(link) == str(target):
            continue
        link.parent.mkdir(parents=True, exist_ok=True)
        link.unlink(missing_ok=True)
        link.symlink_to(target)


def clear_stale_caches() -> None:
    """Delete compiled functions that are older than any module they may have been compiled from."""
    newest = max(path.stat().st_mtime for path in (HERE / PACKAGE).rglob('*.py'))
    for folder in (SITE, HERE / PACKAGE):
        for path in folder.rglob('__pycache__/*.nb[ci]'):
            if path.stat().st_mtime < newest:
                path.unlink()


def main() -> None:
    """Run as a step of ``make setup``."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument('--remove', action='store_true', help='take the links away')
    remove = parser.parse_args().remove
    for folder, installed in LINKED:
        if remove:
            remove_links(installed)
        else:
            make_links(folder, installed)
    clear_stale_caches()


if __name__ == '__main__':
    main()
