"""A place for the compiled kernels where the usual ones cannot be written.

numba keeps them in ``NUMBA_CACHE_DIR``, beside the source, or in the user's cache folder, and refuses to *import* a
cached function where none of the three can be written: a robot that installs to a read-only disk and runs the node as
a user without a home.  Then they go to the temporary folder.  It has to be called before numba is imported.
"""

from __future__ import annotations

import os
import stat
import tempfile
from pathlib import Path

PACKAGE = Path(__file__).resolve().parents[1]


def ensure_compiler_cache() -> Path | None:
    """Set ``NUMBA_CACHE_DIR`` where nothing else can be written; return the folder if it was needed."""
    given = os.environ.get('NUMBA_CACHE_DIR')
    user = Path(os.environ.get('XDG_CACHE_HOME') or Path('~/.cache').expanduser()) / 'numba'
    in_tree = [PACKAGE / room / '__pycache__' for room in ('core', 'wire')]
    if (given and _is_writable(Path(given))) or all(map(_is_writable, in_tree)) or _is_writable(user):
        return None
    folder = _temporary_folder()
    os.environ['NUMBA_CACHE_DIR'] = str(folder)
    return folder


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
