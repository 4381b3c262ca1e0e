"""Soft decisions against all words there are: 2 to the 11."""


import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from beacon_comm.core.character import Status
from beacon_comm.core.framing import CharacterFrame
from beacon_comm.core.likelihood import CONTEXTS, MEMORY_BITS
from beacon_comm.core.soft_decision import bit_ratios, confidence_of, margins
from beacon_comm.core.trellis import frame_layout

FRAMES = [
    CharacterFrame(),
    CharacterFrame(parity='odd'),
    CharacterFrame(data_bits=8, parity='none', stop_bits=1),
    CharacterFrame(data_bits=5, stop_bits=1, bit_order='lsb_first'),
    CharacterFrame(data_bits=8),
]


def word_values(likelihoods, before, after, length):
    """Return the log likelihood of every word between the bits before and after it, ``(2 ** length,)``."""
    words = np.arange(1 << length)
    context, value = np.full(1 << length, before), np.zeros(1 << length)
    shifts = [words >> (length - 1 - n) & 1 for n in range(length)]
    shifts += [np.full(1 << length, after >> (MEMORY_BITS - 2 - k) & 1) for k in range(MEMORY_BITS - 1)]
    for n, bit in enumerate(shifts):
        context = (context << 1 | bit) & (CONTEXTS - 1)
        value = value + likelihoods[n, context]
    return value


def is_frame(frame):
    """Return which words are frames, ``(2 ** length,)`` bool."""
    return np.array([status is Status.OK for _, status in frame.decoding_table()])


cases = st.tuples(
    st.integers(0, 2**32 - 1),
    st.sampled_from([0.1, 2.0, 15.0]),
    st.integers(0, CONTEXTS - 1),
    st.integers(0, CONTEXTS // 2 - 1),
    st.sampled_from(FRAMES),
)


def likelihoods_for(seed, spread, frame):
    return np.random.default_rng(seed).normal(-20.0, spread, (frame.length + MEMORY_BITS - 1, CONTEXTS))


@settings(max_examples=80, deadline=None)
@given(cases)
def test_bit_ratios_against_all_words(case):
    seed, spread, before, after, frame = case
    likelihoods = likelihoods_for(seed, spread, frame)
    values = word_values(likelihoods, before, after, frame.length)
    ratios = np.empty(frame.length)
    bit_ratios(likelihoods, before, after, frame.length, ratios)
    ones = np.arange(1 << frame.length)[:, None] >> np.arange(frame.length - 1, -1, -1) & 1 == 1
    expected = [values[is_one].max() - values[~is_one].max() for is_one in ones.T]
    assert ratios == pytest.approx(expected, abs=1e-9)
    best = int(values.argmax())
    assert int(''.join('1' if ratio > 0 else '0' for ratio in ratios), 2) == best


@settings(max_examples=80, deadline=None)
@given(cases, st.booleans(), st.integers(0, 2**32 - 1))
def test_margins_against_all_words(case, decides_the_best, choice):
    seed, spread, before, after, frame = case
    likelihoods = likelihoods_for(seed, spread, frame)
    values = word_values(likelihoods, before, after, frame.length)
    frames = is_frame(frame)
    candidates = np.flatnonzero(frames)
    word = candidates[values[candidates].argmax()] if decides_the_best else candidates[choice % len(candidates)]
    frame_margin, word_margin = margins(likelihoods, before, after, int(word), frame_layout(frame)[0])
    rivals = frames.copy()
    rivals[word] = False
    assert frame_margin == pytest.approx(values[word] - values[~frames].max(), abs=1e-9)
    assert word_margin == pytest.approx(values[word] - values[rivals].max(), abs=1e-9)
    assert word_margin >= 0.0 or not decides_the_best


@pytest.mark.parametrize('frame', FRAMES, ids=str)
def test_layout_allows_the_frames_and_no_other_word(frame):
    layout = frame_layout(frame)[0]
    assert layout['length'] == frame.length
    fixed, checked = layout['fixed'][: frame.length], layout['checked'][: frame.length] == 1
    bits = np.arange(1 << frame.length)[:, None] >> np.arange(frame.length - 1, -1, -1) & 1
    allowed = ((fixed < 0) | (bits == fixed)).all(axis=1)
    if layout['parity'] >= 0:
        allowed &= bits[:, checked].sum(axis=1) % 2 == layout['parity']
    assert allowed.tolist() == is_frame(frame).tolist() == (layout['words'][: len(bits)] == 1).tolist()


def test_no_evidence_is_no_margin():
    layout = frame_layout(CharacterFrame())[0]
    assert margins(np.zeros((13, CONTEXTS)), 7, 3, CharacterFrame().frame_of(ord('S')), layout) == (0.0, 0.0)


def test_confidence_grows_with_the_margin():
    confidences = [confidence_of(margin) for margin in (0.0, 1.0, 3.0, 8.0, 15.0, 30.0)]
    assert confidences == sorted(set(confidences))
    assert 0.0 < confidences[0] < 0.5 and 0.9 < confidences[3] < 0.99 and 0.998 < confidences[5] < 1.0
    assert confidence_of(-5.0) == confidences[0] and confidence_of(1e3) == confidences[5]
