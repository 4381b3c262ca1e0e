"""MATLAB recordings of one beacon: the aggregated events of its blob, without pixels.

    event    1 × N   ±1
    event_t  1 × N   seconds, in whole microseconds, non-decreasing

Source of the format: github.com/ziweiWWANG/Event-Beacon-Communication (recordings of the paper).
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from beacon_comm.core.errors import RecordingError
from beacon_comm.recordings.mat5 import is_mat5, variables

# Beyond this a double no longer holds whole microseconds with room to round: some 34 years.
MAX_TIME_S = 2.0**30
DAY_S = 86_400.0


def read_mat(path: str | Path) -> tuple[NDArray[np.int64], NDArray[np.int8]]:
    """Read a ``.mat`` recording.

    Args:
        path: MATLAB file of version 7 or older.

    Returns:
        ``(t_ns, polarity)``: sensor time (ns, whole microseconds, non-decreasing), ``(n,)`` int64, and +1 / -1,
        ``(n,)`` int8.

    Raises:
        RecordingError: the file is missing, is no such file, or its variables are not as drawn above; or it spans more
            than a day.
    """
    path = Path(path)
    variables = _load(path)
    for name in ('event', 'event_t'):
        if name not in variables:
            present = ', '.join(sorted(variables)) or 'nothing'
            raise RecordingError(f'{path}: no variable {name!r} (the file holds {present})')
    polarity = _vector(path, 'event', variables['event'])
    t_s = _vector(path, 'event_t', variables['event_t']).astype(np.float64)
    if len(polarity) != len(t_s):
        raise RecordingError(f'{path}: {len(polarity)} polarities in event, but {len(t_s)} times in event_t')
    if len(t_s) == 0:
        raise RecordingError(f'{path}: no events')
    if not np.all((polarity == 1) | (polarity == -1)):
        raise RecordingError(f'{path}: event holds values other than 1 and -1')
    if not np.all(np.isfinite(t_s)) or np.abs(t_s).max() > MAX_TIME_S:
        raise RecordingError(f'{path}: event_t holds times that are not finite seconds')
    # Rounding to microseconds first: 0.000098 s has no exact double, 98 µs has an exact integer.
    t_ns = np.rint(t_s * 1e6).astype(np.int64) * 1000
    steps_back = np.flatnonzero(np.diff(t_ns) < 0)
    if len(steps_back):
        k = int(steps_back[0]) + 1
        raise RecordingError(f'{path}: event_t steps back at event {k} ({t_s[k - 1]:.6f} s to {t_s[k]:.6f} s)')
    if t_s[-1] - t_s[0] > DAY_S:
        raise RecordingError(
            f'{path}: event_t spans {t_s[-1] - t_s[0]:g} s, more than a day (times have to be in seconds)'
        )
    return t_ns, polarity.astype(np.int8)


def _load(path: Path) -> dict[str, object]:
    if not path.is_file():
        raise RecordingError(f'{path}: no such file')
    content = path.read_bytes()
    if is_mat5(content):
        try:
            return dict(variables(content))
        except ValueError as error:
            raise RecordingError(f'{path}: not a readable MATLAB file ({error})') from error
    if content[124:128] in (b'\x00\x02IM', b'\x02\x00MI'):
        raise RecordingError(f"{path}: a MATLAB 7.3 (HDF5) file; save it with save(…, '-v7') to read it here")
    if 0 not in content[:4]:
        raise RecordingError(f'{path}: not a readable MATLAB file (its head is of no known version)')
    from scipy.io import loadmat  # for version 4; slow to import, and hardly a file is that old

    try:
        loaded = loadmat(path, variable_names=['event', 'event_t'])
        if not {'event', 'event_t'} <= loaded.keys():
            loaded = loadmat(path)
    except Exception as error:  # scipy raises whatever its parsing stumbles over
        raise RecordingError(f'{path}: not a readable MATLAB file ({error})') from error
    return {name: value for name, value in loaded.items() if not name.startswith('__')}


def _vector(path: Path, name: str, value: object) -> NDArray[np.generic]:
    if not isinstance(value, np.ndarray) or value.dtype.kind not in 'iuf':
        raise RecordingError(f'{path}: {name} is not numeric')
    if value.ndim != 2 or 1 not in value.shape and value.size:
        raise RecordingError(f'{path}: {name} has shape {value.shape}, not 1 × N')
    return value.reshape(-1)
