"""Discretisation: spans and edges become characters."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from line_events import line_edges, text_bits

from beacon_comm.core.character import Status
from beacon_comm.core.discretisation import CharacterReader, EdgeRecord
from beacon_comm.core.framing import CharacterFrame
from beacon_comm.core.high_pass import Edges
from beacon_comm.core.synchronisation import Span

RATE_BPS = 1000.0
BIT = 1_000_000
FRAME = CharacterFrame()


def span(start_bits, stop_bits, stop_seen=True, t0_ns=0):
    return Span(t0_ns + round(start_bits * BIT), t0_ns + round(stop_bits * BIT), True, stop_seen, 0)


def read(edges, where):
    record = EdgeRecord()
    record.append(edges)
    return CharacterReader(RATE_BPS, FRAME).read(where, record)


def edges_at(t_bits, rising):
    return Edges(np.array([round(t * BIT) for t in t_bits], np.int64), np.array(rising, bool))


@pytest.mark.parametrize('t0_ns', [0, 2**40])
def test_golden_vector(t0_ns):
    character = read(line_edges(text_bits('S'), RATE_BPS, t0_ns), span(0, 11, t0_ns=t0_ns))
    assert character.frame == 0b0_1010011_0_11
    assert (character.t_ns, character.code, character.status) == (t0_ns, ord('S'), Status.OK)
    assert character.confidence == 1.0
    assert character.bit_rate_bps == RATE_BPS


@given(st.integers(0, 127), st.floats(0.93, 1.07))
def test_slots_stretch_with_the_span_where_the_end_edge_was_seen(code, stretch):
    edges = line_edges(FRAME.encode_bits(bytes([code])), RATE_BPS / stretch)
    character = read(edges, span(0, 11 * stretch))
    assert (character.code, character.status) == (code, Status.OK)
    assert character.confidence > 0.999


def test_slots_are_nominal_where_the_end_edge_was_not_seen():
    # Stretched by 6 % the last transition of '\x01' (0 0000001 1 11) moves over the middle of a nominal slot.
    edges = edges_at([0, 7 * 1.08], [False, True])
    assert read(edges, span(0, 11 * 1.08)).frame == 0b0_0000001_1_11
    assert read(edges, span(0, 11, stop_seen=False)).frame == 0b0_0000000_1_11


def test_parity_is_judged_first():
    wrong_parity = line_edges([0, 1, 0, 1, 0, 0, 1, 1, 1, 0, 1], RATE_BPS)  # the stop bit is wrong, too
    assert read(wrong_parity, span(0, 11)).status == Status.PARITY_ERROR
    wrong_stop = line_edges([0, 1, 0, 1, 0, 0, 1, 1, 0, 0, 1], RATE_BPS)
    assert read(wrong_stop, span(0, 11)).status == Status.FRAMING_ERROR


@pytest.mark.parametrize(('rise_bits', 'confidence'), [(4.0, 1.0), (4.25, 0.5), (3.9, 0.8), (4.49, 0.02), (4.51, 0.02)])
def test_confidence_is_the_distance_of_the_nearest_edge_to_a_middle(rise_bits, confidence):
    character = read(edges_at([0, rise_bits], [False, True]), span(0, 11))
    assert character.confidence == pytest.approx(confidence, abs=1e-9)
    assert character.frame == (0b00001111111 if rise_bits <= 4.5 else 0b00000111111)


def test_level_before_the_first_edge():
    assert read(edges_at([], []), span(0, 11)).frame == 0b11111111111  # the line starts high
    record = EdgeRecord()
    record.append(edges_at([0, 20, 23], [False, True, False]))
    record.forget(10 * BIT)
    assert record.count == 2
    assert CharacterReader(RATE_BPS, FRAME).read(span(12, 23), record).frame == 0b00000000111


@settings(max_examples=30, deadline=None)
@given(st.lists(st.integers(1, 400), min_size=1, max_size=20), st.integers(0, 1000))
def test_record_keeps_what_was_not_forgotten(sizes, forgotten):
    total = sum(sizes)
    all_edges = Edges(np.arange(total, dtype=np.int64), np.arange(total) % 2 == 1)
    record = EdgeRecord()
    done = 0
    for size in sizes:
        edges = Edges(all_edges.t_ns[done : done + size], all_edges.rising[done : done + size])
        if record.lacks_room(edges):
            record.forget(min(forgotten, done))
        record.append(edges)
        done += size
    first = int(record.t_ns[0])
    assert first <= forgotten
    assert np.array_equal(record.t_ns[: record.count], all_edges.t_ns[first:])
    assert np.array_equal(record.rising[: record.count], all_edges.rising[first:])
    assert record.level_before == (first % 2 == 0)
