"""Reading ``.mat`` recordings: exact times, and a clear refusal of everything else."""

from pathlib import Path

import numpy as np
import pytest
from scipy.io import savemat

from beacon_comm.core.errors import RecordingError
from beacon_comm.recordings.mat import read_mat


def write(path: Path, **variables: object) -> Path:
    savemat(path, variables)
    return path


def test_times_are_exact_microseconds(tmp_path: Path) -> None:
    t_us = np.array([98, 100, 100, 3_654_871, 2**40 // 1000], np.int64)
    path = write(tmp_path / 'a.mat', event=np.array([[1, -1, 1, 1, -1]], np.int16), event_t=t_us[None] / 1e6)
    t_ns, polarity = read_mat(path)
    assert t_ns.dtype == np.int64 and polarity.dtype == np.int8
    assert t_ns.tolist() == (t_us * 1000).tolist()
    assert polarity.tolist() == [1, -1, 1, 1, -1]


def test_real_recording(data_folder: Path) -> None:
    t_ns, polarity = read_mat(data_folder / '3125hz_30m.mat')
    assert len(t_ns) == len(polarity) == 1_107_543
    assert (int(t_ns[0]), int(t_ns[-1])) == (98_000, 3_654_871_000)
    assert set(np.unique(polarity)) == {-1, 1}
    assert not np.any(t_ns % 1000)


@pytest.mark.parametrize(
    ('variables', 'reason'),
    [
        ({'event': [[1.0]]}, "no variable 'event_t'"),
        ({'event_t': [[1.0]], 'something': [[2.0]]}, r"no variable 'event' \(the file holds event_t, something\)"),
        ({'event': [[1, -1]], 'event_t': [[1.0]]}, '2 polarities in event, but 1 times'),
        ({'event': [[1, 0]], 'event_t': [[1.0, 2.0]]}, 'other than 1 and -1'),
        ({'event': [[1, -1], [1, 1]], 'event_t': [[1.0, 2.0], [1.0, 2.0]]}, r'shape \(2, 2\), not 1 × N'),
        ({'event': 'text', 'event_t': [[1.0]]}, 'event is not numeric'),
        ({'event': np.empty((1, 0)), 'event_t': np.empty((1, 0))}, 'no events'),
        ({'event': [[1, 1]], 'event_t': [[1.0, np.nan]]}, 'not finite'),
        ({'event': [[1, 1, 1]], 'event_t': [[1.0, 3.0, 2.0]]}, 'steps back at event 2'),
        ({'event': [[1, 1, -1]], 'event_t': [[1.0, 3.0, 1e9]]}, 'spans 1e\\+09 s, more than a day .*in seconds'),
        ({'event': [[1, -1]], 'event_t': [[98.0, 110_000.0]]}, 'spans 109902 s, more than a day .*in seconds'),
    ],
)
def test_wrong_variables_are_refused(tmp_path: Path, variables: dict[str, object], reason: str) -> None:
    path = write(tmp_path / 'wrong.mat', **variables)
    with pytest.raises(RecordingError, match=reason) as caught:
        read_mat(path)
    assert str(path) in str(caught.value)


def test_wrong_files_are_refused(tmp_path: Path) -> None:
    hdf5 = tmp_path / 'new.mat'
    hdf5.write_bytes(b'MATLAB 7.3 MAT-file, Platform: GLNXA64'.ljust(124) + b'\x00\x02IM' + bytes(600))
    with pytest.raises(RecordingError, match=r'7\.3 \(HDF5\)'):
        read_mat(hdf5)
    (tmp_path / 'text.mat').write_text('not a matrix at all, just a line of text\n' * 10)
    with pytest.raises(RecordingError, match='not a readable MATLAB file'):
        read_mat(tmp_path / 'text.mat')
    with pytest.raises(RecordingError, match='no such file'):
        read_mat(tmp_path / 'absent.mat')
    whole = write(tmp_path / 'whole.mat', event=np.ones((1, 1000)), event_t=np.arange(1000.0)[None])
    (tmp_path / 'cut.mat').write_bytes(whole.read_bytes()[:5000])
    with pytest.raises(RecordingError, match='not a readable MATLAB file'):
        read_mat(tmp_path / 'cut.mat')


@pytest.mark.parametrize('compressed', [False, True])
def test_other_variables_beside_them_do_not_matter(tmp_path: Path, compressed: bool) -> None:
    path = tmp_path / 'more.mat'
    wanted = {'event': np.array([[1, -1]], np.int8), 'event_t': np.array([[0.5, 1.5]])}
    others = {'text': 'abc', 'cell': np.array(['a', 2], object), 'complex': 1j * np.ones(2), 'struct': {'a': 1}}
    savemat(path, {**others, **wanted}, do_compression=compressed)
    t_ns, polarity = read_mat(path)
    assert (t_ns.tolist(), polarity.tolist()) == ([500_000_000, 1_500_000_000], [1, -1])


def test_version_4_is_read(tmp_path: Path) -> None:
    savemat(tmp_path / 'old.mat', {'event': np.array([[1, -1]]), 'event_t': np.array([[0.5, 1.5]])}, format='4')
    assert read_mat(tmp_path / 'old.mat')[0].tolist() == [500_000_000, 1_500_000_000]


@pytest.mark.parametrize('compressed', [False, True])
def test_damage_anywhere_is_refused_or_harmless(tmp_path: Path, compressed: bool) -> None:
    """Every byte of a small file, in turn, is another one; scipy's reader ends the process on some of these."""
    path = tmp_path / 'small.mat'
    savemat(path, {'event': np.ones((1, 3), np.int8), 'event_t': np.arange(3.0)[None]}, do_compression=compressed)
    sound = path.read_bytes()
    for at in range(124, len(sound)):
        for value in (0, 0x10, 0xFF):
            path.write_bytes(sound[:at] + bytes([value]) + sound[at + 1 :])
            try:
                t_ns, polarity = read_mat(path)
            except RecordingError:
                continue
            assert len(t_ns) == len(polarity) > 0
