"""docs/paper_experiments.py: its parts on small cases; the page itself is made by hand."""

from dataclasses import replace

import numpy as np
import pytest
from docs_script import load

from beacon_comm.core.character import Character, Status
from beacon_comm.evaluation.scoring import not_found
from beacon_comm.evaluation.truth import SONNET18

paper = load('paper_experiments')
START_NS = 50_000_000


def read(text: str, bit_rate_bps: float) -> list[Character]:
    """Return the characters of a text, all right."""
    length_ns = paper.FRAME.duration_ns(bit_rate_bps)
    return [
        Character(round(START_NS + k * length_ns), ord(c), Status.OK, 1.0, paper.FRAME.frame_of(ord(c)), bit_rate_bps)
        for k, c in enumerate(text)
    ]


@pytest.mark.parametrize(('bit_rate_bps', 'count'), [(20.0, 30), (500.0, 363), (3125.0, 618), (10_000.0, 618)])
def test_how_much_is_sent(bit_rate_bps, count) -> None:
    assert paper.characters_at(bit_rate_bps, 8.0) == count


def test_what_comes_first_does_not_count() -> None:
    text = SONNET18[:100]
    right = read(text, 500.0)
    lead_in = paper.lead_in(500.0)
    assert (lead_in, paper.lead_in(10_000.0)) == (16, 272)
    score = paper.scored_as_the_paper(right[5:], text, lead_in, START_NS, 500.0)
    assert (score.characters, score.wrong) == (100 - lead_in, 0)
    wrong = [*right[: lead_in + 3], replace(right[lead_in + 3], code=1), *right[lead_in + 5 :]]
    score = paper.scored_as_the_paper(wrong, text, lead_in, START_NS, 500.0)
    assert (score.wrong, score.missing) == (2, 1)


@pytest.mark.parametrize('characters', [[], read('U' * 60, 500.0)])
def test_without_a_start_accuracy_is_set(characters) -> None:
    """The paper's section IV: message error rate 1 and bit error rate 0.5."""
    score = paper.scored_as_the_paper(characters, SONNET18[:100], 16, START_NS, 500.0)
    assert (score.message_accuracy, score.bit_accuracy) == (0.0, 0.5)
    assert paper.accuracy(score) == 'no start: 0, 0.5'


def test_a_near_bright_beacon_is_read_by_all() -> None:
    points = paper.run_point(paper.rooms()['outdoor'], 20.0, 500.0, 0.1, 1)
    assert [point.receiver for point in points] == list(paper.ALL)
    assert [(point.transmission.characters, point.transmission.wrong) for point in points] == 3 * [(30, 0)]
    assert 5.0 < points[0].events_a_bit < 2000.0


def test_the_inverse_square_law_carries_the_contrast_indoors() -> None:
    """By hand: 0.03 of 34 cd, (5.714 / 12.5)² of the light, a background of 0.24."""
    room = paper.rooms()['indoor']
    outdoor = paper.make_description({'beacons': [{}]}).beacons[0].led.contrast
    assert room.brightness == pytest.approx(0.24)
    assert room.led['contrast'] / outdoor == pytest.approx(0.03 / 34.0 * (8.0 / 1.4 / 12.5) ** 2)


def test_the_binarised_line_follows_the_square_wave() -> None:
    wave = paper.run_square_wave(1, 500.0)
    assert wave.agreement > 0.98
    spacing = np.diff(wave.trace.edges_ns)
    assert np.median(spacing) == pytest.approx(1_000_000, rel=0.15)
    assert np.all(np.diff(wave.trace.rising.astype(int)) != 0)


def test_the_page_says_what_was_set_and_what_was_counted() -> None:
    room = 'outdoor'
    found = replace(not_found(SONNET18[:50]), start_ns=0, bit_rate_bps=500.0, wrong=5, missing=5, wrong_bits=55, bits=550)
    points = [
        paper.Point(room, 100.0, 500.0, 'sequence', found, 3.0),
        paper.Point(room, 100.0, 3125.0, 'sequence', not_found(SONNET18), 1.0),
    ]
    table = paper.grid(points, room, 'sequence')
    assert '| 100 m | 0.900, 0.900 | 0, 0.5 (no start) |' in table
    rows = {row[1]: row for row in paper.statement_rows(points)}
    assert rows['outdoor, 100 m, 500 bps'][3].startswith('0.900, 0.9000 (45 of 50, [')
    assert rows['outdoor, 100 m, 500 bps'][2] == '–'
