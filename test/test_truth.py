"""The built-in text, and what a --truth argument stands for."""

import hashlib

import numpy as np
import pytest

from beacon_comm.core.errors import RecordingError
from beacon_comm.core.framing import CharacterFrame
from beacon_comm.evaluation.truth import SONNET18, load_truth
from beacon_comm.recordings.mat import read_mat


def test_the_sonnet_is_the_one_that_was_sent() -> None:
    lines = SONNET18.split('\n')
    assert len(SONNET18) == 618
    assert len(lines) == 14
    assert all(line == line.strip() for line in lines)
    assert SONNET18.isascii()
    assert hashlib.sha256(SONNET18.encode()).hexdigest() == (
        'dc2c84612862a9f9206b7a00794138541755fde29bca12cb55ef09d862669e11'
    )


def test_every_character_fits_the_frame() -> None:
    assert len(CharacterFrame().encode_bits(SONNET18)) == 6798  # the paper's number of bits


def test_a_name_a_file_or_the_text_itself(tmp_path) -> None:
    file = tmp_path / 'sent.txt'
    file.write_bytes(b'two lines\nand an end\n')
    assert load_truth('sonnet18') is SONNET18
    assert load_truth(str(file)) == 'two lines\nand an end\n'
    assert load_truth('Hello, beacon!') == 'Hello, beacon!'
    assert load_truth('a' * 5000) == 'a' * 5000


def test_what_is_no_text_is_named(tmp_path) -> None:
    binary = tmp_path / 'image.png'
    binary.write_bytes(bytes(range(128, 256)))
    (tmp_path / 'empty.txt').touch()
    with pytest.raises(RecordingError, match=r'image\.png: not a readable text file'):
        load_truth(str(binary))
    with pytest.raises(RecordingError, match='no text'):
        load_truth(str(tmp_path / 'empty.txt'))
    with pytest.raises(RecordingError, match=r'absent\.txt: no such file'):
        load_truth(str(tmp_path / 'absent.txt'))
    with pytest.raises(RecordingError, match='no text'):
        load_truth('')


@pytest.mark.parametrize('path', ['/nonexist', 'texts/absent', '/' + 300 * 'a'])
def test_a_path_is_not_taken_for_a_text(path) -> None:
    with pytest.raises(RecordingError, match=f'^{path}: no such file'):
        load_truth(path)


@pytest.mark.parametrize('text', ['on / off', 'on/off, and on', 'on/off\n', 300 * 'a', 'a/' * 600])
def test_a_text_may_hold_a_slash(text) -> None:
    assert load_truth(text) == text


# Start of truth character `first` (s), bit rate, first and stop: measured on the recordings.
PARTS = {
    '504hz_30m': ((0.0109, 503.82, 53, 618), (12.3804, 503.83, 0, 264)),
    '3125hz_30m': ((0.00186, 3123.8, 316, 618), (1.07076, 3123.74, 0, 618)),
}
FRAMES = np.array([[CharacterFrame().frame_of(code) >> (10 - j) & 1 for j in range(11)] for code in range(128)])


def read_openly(t_ns, polarity, start_s, bit_rate_bps, sent):
    """Read characters without any of the receiver's stages: for each, the best of all 128 codes.

    A bit's events (ON minus OFF) are Gaussian with a mean and variance that depend on the last three bits.
    """
    sums = np.concatenate(([0], np.cumsum(polarity, dtype=np.int64)))
    edges_ns = (start_s + np.arange(11 * len(sent) + 1) / bit_rate_bps) * 1e9
    events = np.diff(sums[np.searchsorted(t_ns, edges_ns)]).astype(float).reshape(-1, 11)
    line = np.concatenate((np.ones((128, 2), int), FRAMES), axis=1)
    context = line[:, :-2] * 4 + line[:, 1:-1] * 2 + line[:, 2:]
    of_sent = context[sent]
    mean = np.array([events[of_sent == c].mean() for c in range(8)])
    variance = np.array([events[of_sent == c].var() + 25.0 for c in range(8)])
    misfit = (events[:, None, :] - mean[context]) ** 2 / variance[context] + np.log(variance[context])
    return misfit.sum(axis=2).argmin(axis=1)


def test_the_recordings_say_it_character_by_character(data_folder) -> None:
    sent = np.frombuffer(SONNET18.encode(), np.uint8).astype(int)
    vouched: set[int] = set()
    for name, parts in PARTS.items():
        t_ns, polarity = read_mat(data_folder / f'{name}.mat')
        for start_s, bit_rate_bps, first, stop in parts:
            read = read_openly(t_ns, polarity, start_s, bit_rate_bps, sent[first:stop])
            wrong = np.count_nonzero(read != sent[first:stop])
            assert wrong <= (0 if name == '504hz_30m' else 8), (name, first)
            vouched |= {first + int(k) for k in np.flatnonzero(read == sent[first:stop])}
    assert vouched == set(range(618))
