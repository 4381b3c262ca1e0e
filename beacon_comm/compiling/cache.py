"""A place for the compiled kernels where the usual ones cannot be written, and none of another version there.

numba keeps them in ``NUMBA_CACHE_DIR``, beside the source, or in the user's cache folder, and refuses to *import* a
cached function where none of the three can be written: a robot that installs to a read-only disk and runs the node as
a user without a home.  Then they go to the temporary folder.  It has to be called before numba is imported.

Whether a kernel is out of date numba asks of the file alone that it stands in, not of what that imports, and it fails
where a type that it remembers is gone.  So after any change of the sources all of them are compiled anew.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
import stat
import tempfile
from pathlib import Path

PACKAGE = Path(__file__).absolute().parents[1]
ROOMS = ('core', 'wire', 'simulation')


def ensure_compiler_cache() -> Path | None:
    """Set ``NUMBA_CACHE_DIR`` where nothing else can be written; return the folder if it was needed."""
    given = os.environ.get('NUMBA_CACHE_DIR')
    user = Path(os.environ.get('XDG_CACHE_HOME') or Path('~/.cache').expanduser()) / 'numba'
    in_tree = [PACKAGE / room / '__pycache__' for room in ROOMS]
    if given and _is_writable(Path(given)):
        return None
    if all(map(_is_writable, in_tree)):
        _forget_other_versions(in_tree)
        return None
    if _is_writable(user):
        return None
    folder = _temporary_folder()
    _forget_other_versions([folder])
    os.environ['NUMBA_CACHE_DIR'] = str(folder)
    return folder


def _forget_other_versions(folders: list[Path]) -> None:
    """Delete the kernels that were compiled from other sources than the present ones."""
    sources = sorted(path for room in ROOMS for path in (PACKAGE / room).glob('*.py'))
    version = hashlib.sha256(b''.join(path.read_bytes() for path in sources)).digest()
    for folder in folders:
        stamp = folder / 'beacon_comm_kernels'
        if stamp.is_file() and stamp.read_bytes() == version:
            continue
        for kernel in folder.rglob('*.nb[ic]'):
            with contextlib.suppress(OSError):  # another process was faster
                kernel.unlink()
        stamp.write_bytes(version)


def _is_writable(folder: Path) -> bool:
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            return True
    except OSError:
        return False


def _temporary_folder() -> Path:
    """Return the same folder at every start, so that kernels are compiled once; never one that another user made."""
    folder = Path(tempfile.gettempdir()) / f'beacon_comm_kernels_{os.getuid()}'
    try:
        folder.mkdir(mode=0o700, exist_ok=True)
        state = folder.lstat()
        if stat.S_ISDIR(state.st_mode) and state.st_uid == os.getuid() and _is_writable(folder):
            return folder
    except OSError:
        pass
    return Path(tempfile.mkdtemp(prefix='beacon_comm_kernels_'))
