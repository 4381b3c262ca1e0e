"""Reliability: characters judged by place and code, bins, expected calibration error."""

import numpy as np
import pytest

from beacon_comm.core.character import Character, Status
from beacon_comm.evaluation.reliability import (
    BIN_EDGES,
    OUTSIDE,
    Due,
    expected_calibration_error,
    judged,
    reliability_bins,
)

PERIOD_NS = 1_000_000
START_NS = 2**60


def due(text: str, start_ns: int = START_NS) -> Due:
    return Due(start_ns + np.arange(len(text)) * PERIOD_NS, np.array([ord(symbol) for symbol in text]))


def at(position: float, symbol: str) -> Character:
    return Character(START_NS + round(position * PERIOD_NS), ord(symbol), Status.OK, 0.5, 0, 11_000.0)


@pytest.mark.parametrize(
    ('characters', 'verdicts'),
    [
        ([], []),
        ([at(0, 'a'), at(1, 'b'), at(2, 'c'), at(3, 'd')], [1, 1, 1, 1]),
        ([at(0.2, 'a'), at(0.9, 'b'), at(2, 'x')], [1, 1, 0]),  # another code
        ([at(1.0, 'b'), at(1.4, 'b')], [1, 0]),  # between two places
        ([at(1.2, 'b'), at(0.95, 'b')], [0, 1]),  # two in one place: the nearer one
        ([at(1.2, 'b'), at(0.95, 'x')], [0, 0]),
        ([at(-0.2, 'a'), at(3.2, 'd'), at(3.6, 'd')], [1, 1, 0]),
        ([at(-0.5, 'a'), at(-70, 'a'), at(3.8, 'd'), at(9, 'd')], [OUTSIDE] * 4),
    ],
)
def test_a_character_is_right_in_its_place_only(characters: list[Character], verdicts: list[int]) -> None:
    assert judged(characters, [due('abcd')]).tolist() == verdicts


def test_each_sending_judges_its_own_time() -> None:
    sendings = [due('abcd'), due('abcd', START_NS + 6 * PERIOD_NS)]
    characters = [at(0, 'a'), at(5, 'a'), at(6, 'a'), at(7, 'a')]
    assert judged(characters, sendings).tolist() == [1, OUTSIDE, 1, 0]


def test_bins_hold_every_confidence_once() -> None:
    confidence = np.array([0.0, 0.05, 0.5, 0.55, 0.9999995, 1.0])
    right = np.array([False, True, True, False, True, True])
    bins = reliability_bins(confidence, right)
    assert [(one.low, one.high) for one in bins] == [(0.0, 0.05), (0.05, 0.1), (0.5, 0.6), (0.999999, 1.0)]
    assert sum(one.characters for one in bins) == len(confidence)
    assert bins[2].share == 0.5 and bins[2].confidence == pytest.approx(0.525)
    assert bins[2].interval.low < 0.5 < bins[2].interval.high
    assert all(np.diff(BIN_EDGES) > 0)


def test_calibration_error_is_the_mean_distance() -> None:
    confidence = np.array([0.75] * 4 + [0.92] * 4)
    right = np.array([True, True, True, False] + [True, True, False, False])
    bins = reliability_bins(confidence, right)
    assert expected_calibration_error(bins) == pytest.approx((4 * 0.0 + 4 * 0.42) / 8)
    assert expected_calibration_error(()) == 0.0
