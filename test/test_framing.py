"""The character frame: golden vectors, round trips, refusals, level transitions."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from beacon_comm.core.character import Status
from beacon_comm.core.errors import FramingError
from beacon_comm.core.framing import BIT_ORDERS, PARITIES, CharacterFrame, transitions
from beacon_comm.core.parameters import Parameters

FRAMES = st.builds(
    CharacterFrame, st.integers(5, 8), st.sampled_from(PARITIES), st.integers(1, 2), st.sampled_from(BIT_ORDERS)
)


def text_of(bits):
    return ''.join(map(str, bits))


@pytest.mark.parametrize(
    ('text', 'bits'),
    [
        ('S', '0' '1010011' '0' '11'),  # the paper's Figure 1
        ('\n', '0' '0001010' '0' '11'),
        ('\x7f', '0' '1111111' '1' '11'),
        ('ab', '0' '1100001' '1' '11' '0' '1100010' '1' '11'),
        ('', ''),
    ],
)
def test_golden_vectors(text, bits):
    frame = CharacterFrame()
    assert text_of(frame.encode_bits(text)) == bits
    assert text_of(frame.encode_bits(text.encode())) == bits


def test_golden_vectors_of_other_layouts():
    assert text_of(CharacterFrame(8, 'none', 1, 'lsb_first').encode_bits(b'\x53')) == '0' '11001010' '1'
    assert text_of(CharacterFrame(7, 'odd', 1, 'lsb_first').encode_bits('S')) == '0' '1100101' '1' '1'
    assert text_of(CharacterFrame(8, 'even', 2).encode_bits('é')) == '0' '11101001' '1' '11'


def test_layout_comes_from_the_parameters():
    parameters = Parameters(data_bits=8, parity='none', stop_bits=1, bit_order='lsb_first')
    assert CharacterFrame.from_parameters(parameters) == CharacterFrame(8, 'none', 1, 'lsb_first')
    assert CharacterFrame.from_parameters(Parameters()) == CharacterFrame()
    assert CharacterFrame().length == 11
    assert CharacterFrame(8, 'none', 1).length == 10
    assert CharacterFrame().duration_ns(1000.0) == 11e6


@given(FRAMES, st.data())
def test_every_code_comes_back_ok(frame, data):
    code = data.draw(st.integers(0, (1 << frame.data_bits) - 1))
    bits = frame.frame_of(code)
    assert frame.decode_frame(bits) == (code, Status.OK)
    assert text_of(frame.encode_bits(bytes([code]))) == f'{bits:0{frame.length}b}'


@given(st.integers(0, 127), st.integers(0, 10))
def test_one_wrong_bit_is_always_noticed(code, bit):
    frame = CharacterFrame()
    status = frame.decode_frame(frame.frame_of(code) ^ 1 << bit)[1]
    # Bits 0 and 1 are the stop bits, 10 is the start bit: the parity says nothing about them.
    assert status == (Status.FRAMING_ERROR if bit in (0, 1, 10) else Status.PARITY_ERROR)


def test_parity_is_judged_first():
    assert CharacterFrame().decode_frame(0b1_0000001_0_00)[1] == Status.PARITY_ERROR
    assert CharacterFrame().decode_frame(0b1_1111111_1_11) == (127, Status.FRAMING_ERROR)  # an idle line
    assert CharacterFrame(parity='none').decode_frame(0b0_1010011_11) == (0x53, Status.OK)


@pytest.mark.parametrize(
    ('text', 'message'),
    [
        ('abcé', r"'é' \(U\+00E9\) at position 3 does not fit into 7 data bits"),
        ('\U0001f600', r"'😀' \(U\+1F600\) at position 0 does not fit into 7 data bits"),
        (b'a\x80', r'byte 0x80 at position 1 does not fit into 7 data bits'),
    ],
)
def test_character_outside_the_data_bits_is_refused_by_name(text, message):
    with pytest.raises(FramingError, match=message):
        CharacterFrame().encode_bits(text)


@pytest.mark.parametrize(
    ('values', 'message'),
    [
        ((4,), r'data_bits = 4: must lie in \[5, 8\]'),
        ((7, 'mark'), "parity = 'mark': must be one of even, odd, none"),
        ((7, 'even', 3), r'stop_bits = 3: must lie in \[1, 2\]'),
        ((7, 'even', 2, 'msb'), "bit_order = 'msb': must be one of msb_first, lsb_first"),
    ],
)
def test_impossible_layout_is_refused(values, message):
    with pytest.raises(FramingError, match=message):
        CharacterFrame(*values)


def test_code_outside_the_data_bits_is_refused():
    with pytest.raises(FramingError, match='code 128 does not fit into 7 data bits'):
        CharacterFrame().frame_of(128)


def test_transitions_of_a_golden_vector():
    t_ns, level = transitions(CharacterFrame().encode_bits('S'), 1000.0, t0_ns=5)  # 0 1 0 1 0 0 1 1 0 1 1
    assert t_ns.dtype == np.int64 and level.dtype == np.uint8
    assert t_ns.tolist() == [5 + k * 1_000_000 for k in (0, 1, 2, 3, 4, 6, 8, 9)]
    assert level.tolist() == [0, 1] * 4


def test_line_returns_to_idle():
    t_ns, level = transitions(np.array([0, 0], np.uint8), 1000.0)
    assert (t_ns.tolist(), level.tolist()) == ([0, 2_000_000], [0, 1])
    t_ns, level = transitions(np.array([0, 1], np.uint8), 1000.0, idle_high=False)
    assert (t_ns.tolist(), level.tolist()) == ([1_000_000, 2_000_000], [1, 0])
    assert len(transitions(np.array([], np.uint8), 1000.0)[0]) == 0


@given(st.binary(min_size=1, max_size=20), st.floats(20.0, 10_000.0), st.sampled_from([0, 2**40]))
def test_transitions_hold_all_bits(text, bit_rate_bps, t0_ns):
    frame = CharacterFrame(data_bits=8)
    bits = frame.encode_bits(text)
    t_ns, level = transitions(bits, bit_rate_bps, t0_ns)
    assert np.all(np.diff(t_ns) > 0) and np.all(np.diff(level.astype(int)) != 0)
    centres = t0_ns + (np.arange(len(bits)) + 0.5) * 1e9 / bit_rate_bps
    assert np.array_equal(level[np.searchsorted(t_ns, centres, side='right') - 1], bits)
