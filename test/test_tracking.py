"""The field's measures of tracking, on cases small enough to be counted by hand."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from beacon_comm.evaluation.intervals import bootstrap_interval, mean_interval
from beacon_comm.evaluation.tracking import ALPHAS, Instants, block_counts, count_swaps, match, score_tracking

NAN = float('nan')
# Two objects so far apart that a place tells which of them a track is on; None: not there.
PLACES = {'A': (0.0, 0.0), 'B': (100.0, 0.0), 'x': (50.0, 50.0), None: (NAN, NAN)}


def made(objects: list[str], tracks: list[list[str | None]], gate_px: float = 3.0, off_px: float = 0.0) -> Instants:
    """Return instants; each track is on A, on B, on nothing (x) or not there."""
    true = np.array([[PLACES[name] if there != '-' else PLACES[None] for there in row] for name, row in objects])
    at = np.array([[PLACES[place] for place in row] for row in tracks]) + (0.0, off_px)
    return Instants(true.swapaxes(0, 1), at.swapaxes(0, 1), np.full(true.shape[1::-1], gate_px))


def on(text: str) -> list[str | None]:
    return [None if place == '.' else place for place in text]


def test_all_right_is_one() -> None:
    score = score_tracking(made([('A', 'ooooo'), ('B', 'ooooo')], [on('AAAAA'), on('BBBBB')], off_px=0.3))
    assert (score.objects, score.matches, score.misses, score.false_positives) == (10, 10, 0, 0)
    assert (score.mota, score.idf1, score.id_precision, score.id_recall) == (1.0, 1.0, 1.0, 1.0)
    assert score.motp_px == pytest.approx(0.3)
    # Similarity 1 - 0.3 / 6 = 0.95: all 19 thresholds are reached.
    assert (score.hota, score.detection_accuracy, score.association_accuracy) == (1.0, 1.0, 1.0)
    assert (score.mostly_tracked, score.partly_tracked, score.mostly_lost) == (2, 0, 0)
    assert (score.id_switches, score.fragmentations, score.swaps) == (0, 0, 0)


def test_clear_mot_by_hand() -> None:
    """The module's own picture, without its third track."""
    score = score_tracking(made([('A', 'oooooo'), ('B', 'oooooo')], [on('AA.A.B'), on('BBBBAA'), on('xx....')]))
    # A is missed at 3, B at 5; A's track changes at 5, B's at 6.
    assert (score.objects, score.reports, score.misses, score.false_positives) == (12, 12, 2, 2)
    assert score.id_switches == 2
    assert score.fragmentations == 2
    assert score.swaps == 2  # both tracks come to be on another object
    assert score.mota == pytest.approx(1.0 - 6.0 / 12.0)
    # A: 3 instants with either; B: 4 with the second track.  The best pairs agree at 3 + 4 instants.
    assert score.idf1 == pytest.approx(2.0 * 7.0 / 24.0)
    assert (score.id_precision, score.id_recall) == (pytest.approx(7.0 / 12.0), pytest.approx(7.0 / 12.0))


def test_a_track_that_changes_its_name_half_way() -> None:
    """Two tracks share one object evenly: all is detected, half of it is associated."""
    score = score_tracking(made([('A', 'oooooooo')], [on('AAAA....'), on('....AAAA')]))
    assert (score.mota, score.id_switches, score.fragmentations) == (pytest.approx(7.0 / 8.0), 1, 0)
    assert score.idf1 == pytest.approx(0.5)  # 2 · 4 / (8 + 8)
    # Each hit: 4 associated, 0 false positive, 4 false negative associations: A(c) = 4 / 8 (Luiten et al. 2021).
    assert (score.detection_accuracy, score.association_accuracy) == (pytest.approx(1.0), pytest.approx(0.5))
    assert score.hota == pytest.approx(np.sqrt(0.5))


def test_one_track_on_two_objects() -> None:
    """A track goes over from one object to the other: the converse, with false positive associations."""
    score = score_tracking(made([('A', 'oooo----'), ('B', '----oooo')], [on('AAAABBBB')]))
    assert (score.mota, score.id_switches, score.swaps) == (1.0, 0, 1)
    assert score.idf1 == pytest.approx(0.5)
    assert score.hota == pytest.approx(np.sqrt(0.5))


def test_half_of_it_seen() -> None:
    score = score_tracking(made([('A', 'oooo')], [on('AA..')]))
    assert (score.mota, score.idf1) == (0.5, pytest.approx(2.0 * 2.0 / 6.0))
    # DetA = 2 / 4; AssA: 2 associated, 2 false negative associations.
    assert score.hota == pytest.approx(0.5)
    assert (score.mostly_tracked, score.partly_tracked, score.mostly_lost) == (0, 1, 0)


def test_hota_counts_the_thresholds_that_are_reached() -> None:
    """2.1 px off with a gate of 3 px: the similarity is 0.65, 13 of 19 thresholds."""
    score = score_tracking(made([('A', 'oooo')], [on('AAAA')], off_px=2.1))
    assert np.count_nonzero(ALPHAS <= 0.65 + 1e-9) == 13
    assert score.hota == pytest.approx(13.0 / 19.0)
    assert score.motp_px == pytest.approx(2.1)


def test_a_match_holds_though_another_track_comes_nearer() -> None:
    """Bernardin and Stiefelhagen: a correspondence is kept while it is valid."""
    objects = np.zeros((3, 1, 2))
    tracks = np.array([[(0.5, 0.0), (NAN, NAN)], [(2.5, 0.0), (0.1, 0.0)], [(3.5, 0.0), (0.1, 0.0)]])
    matches = match(Instants(objects, tracks, np.full((3, 1), 3.0)))
    assert matches.track[:, 0].tolist() == [0, 0, 1]
    assert matches.switches.tolist() == [0, 0, 1]
    assert matches.false_positives.tolist() == [0, 1, 1]
    assert matches.distance_px[:, 0].tolist() == pytest.approx([0.5, 2.5, 0.1])


def test_as_many_as_can_be_are_matched() -> None:
    """The nearest pair first would leave the other object without a track."""
    objects = np.array([[(0.0, 0.0), (4.0, 0.0)]])
    tracks = np.array([[(2.0, 0.0), (-2.9, 0.0)]])
    matches = match(Instants(objects, tracks, np.full((1, 2), 3.0)))
    assert matches.track.tolist() == [[1, 0]]


def test_nothing_there_and_nothing_said() -> None:
    nothing = score_tracking(Instants(np.full((3, 1, 2), NAN), np.empty((3, 0, 2)), np.full((3, 1), 3.0)))
    assert (nothing.objects, nothing.reports) == (0, 0)
    assert (nothing.mota, nothing.motp_px, nothing.idf1, nothing.hota) == (None, None, None, None)
    silent = score_tracking(made([('A', 'ooo')], [on('...')]))
    assert (silent.mota, silent.motp_px, silent.idf1, silent.hota, silent.mostly_lost) == (0.0, None, 0.0, 0.0, 1)
    false = score_tracking(made([('A', '---')], [on('xxx')]))
    assert (false.mota, false.false_positives, false.idf1) == (None, 3, 0.0)


def test_a_track_that_comes_back_to_its_object_has_not_swapped() -> None:
    assert count_swaps(np.array([[0, -1], [-1, -1], [0, -1], [-1, 0], [0, 1]])) == 2


@settings(deadline=None, max_examples=60)
@given(st.integers(0, 2**32 - 1))
def test_what_is_counted_adds_up(seed: int) -> None:
    random = np.random.default_rng(seed)
    objects = random.uniform(0.0, 12.0, (20, 3, 2))
    objects[random.random((20, 3)) < 0.2] = NAN
    tracks = random.uniform(0.0, 12.0, (20, 4, 2))
    tracks[random.random((20, 4)) < 0.3] = NAN
    instants = Instants(objects, tracks, np.full((20, 3), 3.0))
    matches = match(instants)
    score = score_tracking(instants, matches)
    assert score.matches + score.misses == score.objects == np.isfinite(objects[..., 0]).sum()
    assert score.matches + score.false_positives == score.reports == np.isfinite(tracks[..., 0]).sum()
    assert np.all(matches.distance_px[matches.track >= 0] <= 3.0)
    for row in matches.track:
        assert len(set(row[row >= 0])) == np.count_nonzero(row >= 0)  # no track on two objects
    assert score.idf1 is not None and score.hota is not None
    assert 0.0 <= score.hota <= 1.0 and 0.0 <= score.idf1 <= 1.0
    counts = block_counts(instants, matches, 6)
    assert counts.shape == (4, 4)
    assert score.mota == pytest.approx(1.0 - counts[:, 1].sum() / counts[:, 0].sum())
    assert score.motp_px == pytest.approx(counts[:, 3].sum() / counts[:, 2].sum())


def test_the_interval_of_a_mean_is_that_of_the_normal_distribution() -> None:
    values = np.random.default_rng(3).normal(5.0, 2.0, 400)
    interval = mean_interval(values)
    assert interval is not None
    assert interval.low == pytest.approx(values.mean() - 1.96 * 2.0 / 20.0, abs=0.05)
    assert interval.high == pytest.approx(values.mean() + 1.96 * 2.0 / 20.0, abs=0.05)


def test_a_few_values_have_no_interval() -> None:
    assert mean_interval(np.arange(4.0)) is None
    assert bootstrap_interval(np.zeros((9, 2)), lambda sums: sums[:, 0] / sums[:, 1]) is None
