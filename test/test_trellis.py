"""The free and the framed trellis: the most likely bits, and the frames among them."""

from functools import lru_cache
from itertools import product

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from line_events import text_bits
from sequence_lines import BEFORE, idle, likelihoods_of, line_of_parts

from beacon_comm.core.framing import CharacterFrame
from beacon_comm.core.likelihood import CONTEXTS
from beacon_comm.core.trellis import (
    IDLE_COST,
    IDLE_STAY_COST,
    NOISE_COST,
    NOISE_EXIT_COST,
    NOISE_STAY_COST,
    frame_layout,
    framed_path,
    free_bits,
    place_margin,
)

TEXT = "Rough winds do shake the darling buds of May,\nAnd summer's lease hath all too short a date:"
FRAMES = [
    CharacterFrame(),
    CharacterFrame(parity='odd'),
    CharacterFrame(bit_order='lsb_first'),
    CharacterFrame(stop_bits=1),
    CharacterFrame(data_bits=8, parity='none', stop_bits=1, bit_order='lsb_first'),
    CharacterFrame(data_bits=8, parity='odd', stop_bits=2),
    CharacterFrame(data_bits=7, parity='none'),
]
SHORT_FRAMES = [
    CharacterFrame(data_bits=5, parity='none', stop_bits=1),
    CharacterFrame(data_bits=5, stop_bits=1),
    CharacterFrame(data_bits=5, parity='odd', stop_bits=2),
]


def path_of(likelihoods, frame):
    """Return positions and bits of the framed path."""
    path, _ = framed_path(frame_layout(frame), likelihoods)
    return path // (2 * CONTEXTS), path & 1


def words_of(positions, bits, frame):
    """Return the frames of a path that are complete in it, and where each starts."""
    ends = [n for n in np.flatnonzero(positions == frame.length - 1) if n >= frame.length - 1]
    starts = [int(n) - frame.length + 1 for n in ends]
    return [int(''.join(map(str, bits[s : s + frame.length])), 2) for s in starts], starts


def read(likelihoods, frame):
    """Return the text of the framed path."""
    words, _ = words_of(*path_of(likelihoods, frame), frame)
    return ''.join(chr(frame.decode_frame(word)[0]) for word in words)


# --- what was sent is read back -----------------------------------------------------------------------------------


@settings(max_examples=40, deadline=None)
@given(st.lists(st.integers(0, 1), min_size=1, max_size=120))
def test_free_bits_are_the_likely_ones(bits):
    assert free_bits(likelihoods_of(bits)).tolist() == bits


@pytest.mark.parametrize('frame', FRAMES, ids=str)
def test_a_text_is_read_back_in_any_layout(frame):
    line = line_of_parts(idle(BEFORE), text_bits(TEXT, frame), idle(5))
    likelihoods = likelihoods_of(line)
    assert free_bits(likelihoods).tolist() == line.tolist()
    positions, bits = path_of(likelihoods, frame)
    assert bits.tolist() == line.tolist()
    words, starts = words_of(positions, bits, frame)
    assert [frame.decode_frame(word)[0] for word in words] == list(map(ord, TEXT))
    assert starts == [BEFORE + frame.length * k for k in range(len(TEXT))]
    assert set(positions[:BEFORE]) == set(positions[-5:]) == {frame.length}  # idle


@settings(max_examples=40, deadline=None)
@given(
    st.lists(st.tuples(st.integers(0, 127), st.integers(0, 100)), min_size=1, max_size=15), st.sampled_from(FRAMES)
)
def test_any_number_of_idle_bits_may_lie_between_characters(sent, frame):
    parts = [idle(BEFORE)]
    starts = []
    for code, gap in sent:
        starts.append(sum(map(len, parts)))
        parts += [frame.encode_bits(bytes([code])), idle(gap)]
    positions, bits = path_of(likelihoods_of(line_of_parts(*parts)), frame)
    words, found = words_of(positions, bits, frame)
    assert found == starts
    assert [frame.decode_frame(word)[0] for word in words] == [code for code, _ in sent]


def test_a_start_in_mid_character_finds_the_frame():
    for skipped in range(1, 11):
        line = text_bits(TEXT)[skipped:]
        assert read(likelihoods_of(line), CharacterFrame()) == TEXT[1:]


def test_the_real_gap_slips_the_frame():
    # One 0 and sixteen 1s between two sendings: a character 0x7F and six idle bits.
    line = line_of_parts(idle(BEFORE), text_bits('see.'), [0], idle(16), text_bits('Shall'))
    assert read(likelihoods_of(line), CharacterFrame()) == 'see.\x7fShall'


# --- what the frame knows -----------------------------------------------------------------------------------------


@pytest.mark.parametrize('frame', [frame for frame in FRAMES if frame.parity_bits], ids=str)
def test_a_wrong_parity_is_repaired_under_the_frame_and_kept_without(frame):
    line = line_of_parts(idle(BEFORE), text_bits(TEXT[:20], frame), idle(5))
    for bit in range(1, frame.length - frame.stop_bits):
        at = BEFORE + 7 * frame.length + bit
        seen = line.copy()
        seen[at] ^= 1
        likelihoods = likelihoods_of(seen, unsure=[at])
        assert free_bits(likelihoods).tolist() == seen.tolist()
        assert read(likelihoods, frame) == TEXT[:20]


def test_wrong_start_and_stop_bits_are_repaired():
    frame = CharacterFrame()
    line = line_of_parts(idle(BEFORE), text_bits(TEXT[:20]), idle(5))
    for bit in (0, 9, 10):
        seen = line.copy()
        seen[BEFORE + 77 + bit] ^= 1
        assert read(likelihoods_of(seen, sure=5.0), frame) == TEXT[:20]


def test_garbage_leads_to_noise_and_text_out_of_it():
    frame = CharacterFrame()
    for seed in range(5):
        garbage = np.random.default_rng(seed).integers(0, 2, 150)
        line = line_of_parts(idle(BEFORE), text_bits(TEXT), garbage, idle(BEFORE), text_bits(TEXT), idle(5))
        positions, bits = path_of(likelihoods_of(line), frame)
        begin = BEFORE + 11 * len(TEXT)
        inside = positions[begin + 33 : begin + 150 - 33]
        assert np.mean(inside == frame.length + 1) > 0.9
        words, starts = words_of(positions, bits, frame)
        read_words = dict(zip(starts, words, strict=True))
        for first in (BEFORE, begin + 150 + BEFORE):
            text = [read_words.get(first + 11 * k) for k in range(len(TEXT))]
            assert text == [frame.frame_of(ord(letter)) for letter in TEXT]


def test_no_evidence_costs_nothing_and_is_no_word():
    transitions = frame_layout(CharacterFrame())
    assert framed_path(transitions, np.zeros((60, CONTEXTS)))[1] == 0.0  # begins anywhere and runs on
    assert place_margin(transitions, np.zeros((60, CONTEXTS)), 30) == 0.0


def test_place_margin_tells_text_that_fits_two_places():
    def margin(line, at):
        return place_margin(frame_layout(CharacterFrame()), likelihoods_of(line), at)

    # 0 1101101 1 11: begun three bits later it is 0 1101111 0 11, and so on for ever.
    assert margin(text_bits('m' * 20), 110) == 0.0
    for ending in ([], [1], idle(30), text_bits('L')[:5]):
        assert margin(line_of_parts(text_bits(TEXT[:20]), ending), 110) > 40.0


# --- against exhaustive search ------------------------------------------------------------------------------------

BITS = 9


@lru_cache
def prices(frame, at=BITS - 1):
    """Return the least price of every bit string by the place of its bit ``at``, ``(2 ** BITS, length + 2)``; inf: none.

    Written from the description of the trellis, string by string and label by label.
    """
    found = np.full((1 << BITS, frame.length + 2), np.inf)
    for value, bits in enumerate(product((0, 1), repeat=BITS)):
        labels = {(place, parity): 0.0 for place in range(frame.length + 2) for parity in (0, 1)}
        for bit in bits[: at + 1]:
            labels = after_bit(frame, labels, bit)
        for place in {place for place, _ in labels}:
            after = {label: price for label, price in labels.items() if label[0] == place}
            for bit in bits[at + 1 :]:
                after = after_bit(frame, after, bit)
            found[value, place] = min(after.values(), default=np.inf)
    return found


def after_bit(frame, labels, bit):
    """Return the prices of all labels after one more bit; a label is a place and the parity of the data so far."""
    length, stops, has_parity = frame.length, frame.stop_bits, frame.parity_bits
    idle_at, noise_at = length, length + 1
    fresh = {}

    def lead(place, parity, price):
        fresh[place, parity] = min(price, fresh.get((place, parity), np.inf))

    for (place, parity), price in labels.items():
        may_start = {length - 1: 0.0, idle_at: IDLE_STAY_COST, noise_at: NOISE_EXIT_COST}
        may_idle = {length - 1: IDLE_COST, idle_at: IDLE_STAY_COST, noise_at: NOISE_EXIT_COST}
        if place in may_start:
            if bit == 0:
                lead(0, 0, price + may_start[place])
            else:
                lead(idle_at, 0, price + may_idle[place])
        else:
            following = place + 1
            if following >= length - stops:
                if bit == 1:
                    lead(following, 0, price)
            elif has_parity and following == length - stops - 1:
                if bit == parity ^ (frame.parity == 'odd'):
                    lead(following, 0, price)
            elif place == 0:
                lead(following, bit, price)
            else:
                lead(following, parity ^ bit, price)
        lead(noise_at, 0, price + (NOISE_STAY_COST if place == noise_at else NOISE_COST))
    return fresh


def string_values(likelihoods):
    """Return the log likelihood of every bit string, the best over the bits before it, ``(2 ** BITS,)``."""
    strings = np.arange(1 << BITS)
    best = np.full(1 << BITS, -np.inf)
    for before in range(CONTEXTS):
        context, value = np.full(1 << BITS, before), np.zeros(1 << BITS)
        for n in range(BITS):
            context = (context << 1 | strings >> (BITS - 1 - n) & 1) & (CONTEXTS - 1)
            value = value + likelihoods[n, context]
        best = np.maximum(best, value)
    return best


def as_number(bits):
    return int(''.join(map(str, bits)), 2)


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 2**32 - 1), st.floats(0.1, 30.0))
def test_free_bits_against_all_bits(seed, spread):
    likelihoods = np.random.default_rng(seed).normal(0.0, spread, (BITS, CONTEXTS))
    values = string_values(likelihoods)
    assert values[as_number(free_bits(likelihoods))] == pytest.approx(values.max(), abs=1e-9)


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 2**32 - 1), st.sampled_from([0.3, 3.0, 10.0, 30.0]), st.sampled_from(SHORT_FRAMES))
def test_framed_path_against_all_bits_and_all_frames(seed, spread, frame):
    likelihoods = np.random.default_rng(seed).normal(0.0, spread, (BITS, CONTEXTS))
    path, total = framed_path(frame_layout(frame), likelihoods)
    values = string_values(likelihoods)[:, None] - prices(frame)
    assert total == pytest.approx(values.max(), abs=1e-9)
    assert values[as_number(path & 1), path[-1] // (2 * CONTEXTS)] == pytest.approx(values.max(), abs=1e-9)


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 2**32 - 1), st.sampled_from([0.3, 3.0, 10.0, 30.0]), st.sampled_from(SHORT_FRAMES[:2]))
def test_place_margin_against_all_bits_and_all_frames(seed, spread, frame):
    likelihoods = np.random.default_rng(seed).normal(0.0, spread, (BITS, CONTEXTS))
    places = (string_values(likelihoods)[:, None] - prices(frame, 4)).max(axis=0)
    best, second = np.sort(places)[[-1, -2]]
    assert place_margin(frame_layout(frame), likelihoods, 4) == pytest.approx(best - second, abs=1e-9)
