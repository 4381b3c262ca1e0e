"""A place for the compiled kernels that can be written, and a place of its own for each version of the sources.

numba keeps them in ``NUMBA_CACHE_DIR``, beside the source, or in the user's cache folder, and refuses to *import* a
cached function where none of the three can be written: a robot that installs to a read-only disk and runs the node as
a user without a home.  Then they go to the temporary folder, and where there is none, either, they are not kept.  It has to be
called before numba is imported.

Whether a kernel is out of date numba asks of the file alone that it stands in, not of what that imports, and it fails
where a type that it remembers is gone.  So every version of the sources has a folder of its own, named after them (and after
``NUMBA_BOUNDSCHECK``, which numba does not ask of either).

Nor does numba expect two processes to save kernels of one function at the same time: the list that one of them writes may name
the other's code, which then runs on arguments of other types.  So they are saved one at a time.
"""

from __future__ import annotations

import contextlib
import fcntl
import functools
import hashlib
import os
import re
import shutil
import stat
import tempfile
from pathlib import Path

PACKAGE = Path(__file__).absolute().parents[1]
ROOMS = ('core', 'wire', 'simulation')
_PREFIX = 'beacon_comm_kernels_'
_LOCK = 'saving'
_PROBE_BYTES = 4096  # a full disk takes a file, but nothing into it
_A_VERSION = re.compile(_PREFIX + '[0-9a-f]{16}')  # other folders are somebody's, and stay


def ensure_compiler_cache() -> Path | None:
    """Set ``NUMBA_CACHE_DIR`` to the folder of this version where it can be written; return the folder, None without any."""
    given = os.environ.get('NUMBA_CACHE_DIR')
    user = Path(os.environ.get('XDG_CACHE_HOME') or os.path.expanduser('~/.cache')) / 'numba'
    choices = [Path(given)] if given else []
    choices = [choice.parent if _A_VERSION.fullmatch(choice.name) else choice for choice in choices]
    version = _version()
    for choice in (*choices, PACKAGE / '__pycache__', *([user] if user.is_absolute() else [])):  # else there is no home
        folder = choice / version
        if _is_writable(folder):
            break
    else:
        try:
            folder = _temporary_folder() / version
            folder.mkdir(exist_ok=True)
        except OSError:
            _keep_nothing()
            return None
    _delete_other_versions(folder)
    os.environ['NUMBA_CACHE_DIR'] = str(folder)
    return folder


def _version() -> str:
    """Return a name for the present sources."""
    digest = hashlib.sha256()
    for path in sorted(path for room in ROOMS for path in (PACKAGE / room).glob('*.py')):
        with contextlib.suppress(OSError):  # an editor's link to nowhere
            digest.update(path.read_bytes())
    digest.update(os.environ.get('NUMBA_BOUNDSCHECK', '').encode())
    return _PREFIX + digest.hexdigest()[:16]


def save_one_at_a_time() -> None:
    """Let this process save kernels while no other one does that calls this, too; it imports numba."""
    from numba.core.caching import IndexDataCacheFile

    save = IndexDataCacheFile.save
    if hasattr(save, 'alone'):
        return

    @functools.wraps(save)
    def save_alone(self: IndexDataCacheFile, key: object, data: object) -> None:
        # Where the disk is full the kernel runs all the same, and is compiled again at the next start.
        with contextlib.suppress(OSError), open(Path(self._cache_path) / _LOCK, 'wb') as lock:
            fcntl.flock(lock, fcntl.LOCK_EX)
            save(self, key, data)

    save_alone.alone = True  # type: ignore[attr-defined]
    IndexDataCacheFile.save = save_alone


def _keep_nothing() -> None:
    """Let numba compile at every start; it imports numba."""
    from numba.core.dispatcher import Dispatcher

    Dispatcher.enable_caching = lambda self: None  # type: ignore[method-assign]


def _delete_other_versions(folder: Path) -> None:
    """Delete the kernels of other versions; a process that still runs one has them in memory."""
    with contextlib.suppress(OSError):
        for other in folder.parent.glob(f'{_PREFIX}*'):
            if other != folder and _A_VERSION.fullmatch(other.name) and other.is_dir() and not other.is_symlink():
                shutil.rmtree(other, ignore_errors=True)


def _is_writable(folder: Path) -> bool:
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder, buffering=0) as file:
            return file.write(bytes(_PROBE_BYTES)) == _PROBE_BYTES
    except OSError:
        return False


def _temporary_folder() -> Path:
    """Return the same folder at every start, so that kernels are compiled once; never one that another user made."""
    folder = Path(tempfile.gettempdir()) / f'{_PREFIX}{os.getuid()}'
    try:
        folder.mkdir(mode=0o700, exist_ok=True)
        state = folder.lstat()
        if stat.S_ISDIR(state.st_mode) and state.st_uid == os.getuid() and _is_writable(folder):
            return folder
    except OSError:
        pass
    return Path(tempfile.mkdtemp(prefix=_PREFIX))
