"""How well tracks follow true objects: the field's standard measures, over instants.

::

    instant       1     2     3     4     5     6           objects and tracks are matched anew at every instant:
    object A     t1    t1     –    t1    t2    t2           4 → 5 an ID switch, 2 → 4 a fragmentation, 3 a miss
    object B     t2    t2    t2    t2     –    t1           t1, t2 on another object than before: two swaps
    track t3      ×     ×                                   a track on no object: false positives

- *CLEAR MOT* (K. Bernardin and R. Stiefelhagen, "Evaluating Multiple Object Tracking Performance: The CLEAR MOT Metrics",
  2008): an object's last match is kept where it is within the gate; what is left is matched by the smallest sum of distances.
  MOTA = 1 - (misses + false positives + ID switches) / objects, MOTP = mean distance of the matches (px).
- *IDF1* (E. Ristani et al., "Performance Measures and a Data Set for Multi-Target, Multi-Camera Tracking", 2016): one track
  for each object over the whole time, so that most instants agree; IDF1 = 2 IDTP / (objects + reports).
- *HOTA* (J. Luiten et al., "HOTA: A Higher Order Metric for Evaluating Multi-Object Tracking", 2021): the root of detection
  and association accuracy, mean over 19 thresholds of the similarity 1 - distance / (2 gates); at 0.5 it is the gate.

*Swaps* are no standard measure: how often a track that was on one object comes to be on another.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

ALPHAS = np.arange(1, 20) * 0.05
# Of the instants it was there, an object is "mostly tracked" in at least, "mostly lost" in less than these shares.
MOSTLY_TRACKED, MOSTLY_LOST = 0.8, 0.2

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class Instants:
    """Where objects and tracks were at ``T`` instants; NaN where one was not there.

    Attributes:
        objects: true centres (px), ``(T, B, 2)``.
        tracks: reported centres (px), ``(T, M, 2)``.
        gate_px: how near a track is to be on an object, ``(T, B)``.
    """

    objects: Floats
    tracks: Floats
    gate_px: Floats

    @property
    def there(self) -> NDArray[np.bool_]:
        """Where objects were, ``(T, B)``."""
        return np.isfinite(self.objects[..., 0])

    @property
    def reported(self) -> NDArray[np.bool_]:
        """Where tracks were, ``(T, M)``."""
        return np.isfinite(self.tracks[..., 0])


@dataclass(frozen=True, slots=True)
class Matches:
    """Which track was on which object, by CLEAR MOT.

    Attributes:
        track: for each instant and object the place of its track, -1: none, ``(T, B)`` int64.
        distance_px: its distance, NaN: none, ``(T, B)``.
        false_positives: tracks on no object, for each instant ``(T,)`` int64.
        switches: objects whose track is another than their last one, for each instant ``(T,)`` int64.
    """

    track: Ints
    distance_px: Floats
    false_positives: Ints
    switches: Ints


@dataclass(frozen=True, slots=True)
class TrackingScore:
    """The measures of the module's head.

    Attributes:
        objects, reports: instants at which an object, a track was there, summed over all.
        matches, misses, false_positives, id_switches: counts.
        fragmentations: how often an object that was tracked is tracked again after it was missed.
        swaps: how often a track comes to be on another object.
        mostly_tracked, partly_tracked, mostly_lost: objects by the share of their instants with a track.
        mota: None without an object.
        motp_px: mean distance of the matches (px), None without one.
        idf1, id_precision, id_recall: None where nothing can be counted.
        hota, detection_accuracy, association_accuracy: mean over the thresholds, None without an object.
    """

    objects: int
    reports: int
    matches: int
    misses: int
    false_positives: int
    id_switches: int
    fragmentations: int
    swaps: int
    mostly_tracked: int
    partly_tracked: int
    mostly_lost: int
    mota: float | None
    motp_px: float | None
    idf1: float | None
    id_precision: float | None
    id_recall: float | None
    hota: float | None
    detection_accuracy: float | None
    association_accuracy: float | None


def match(instants: Instants) -> Matches:
    """Match tracks with objects instant by instant (Bernardin and Stiefelhagen 2008, section 2.1.1)."""
    there, reported = instants.there, instants.reported
    times, objects = there.shape
    track = np.full((times, objects), -1, np.int64)
    distance_px = np.full((times, objects), np.nan)
    false_positives = np.zeros(times, np.int64)
    switches = np.zeros(times, np.int64)
    last = np.full(objects, -1, np.int64)
    for t in range(times):
        rows, columns = np.flatnonzero(there[t]), np.flatnonzero(reported[t])
        found = np.full(objects, -1, np.int64)
        if len(rows) and len(columns):
            between = _distances(instants.objects[t, rows], instants.tracks[t, columns])
            near = between <= instants.gate_px[t, rows, None]
            for i, j in np.argwhere(near & (last[rows, None] == columns[None, :])):
                if near[i, j]:  # no other object has kept the track
                    found[rows[i]] = columns[j]
                    near[i, :] = near[:, j] = False
            for i, j in _nearest_pairs(between, near):
                found[rows[i]] = columns[j]
            on = found[rows] >= 0
            at = np.searchsorted(columns, found[rows[on]])
            distance_px[t, rows[on]] = between[on, at]
        matched = found >= 0
        switches[t] = np.count_nonzero(matched & (last >= 0) & (found != last))
        false_positives[t] = len(columns) - np.count_nonzero(matched)
        last = np.where(matched, found, last)
        track[t] = found
    return Matches(track, distance_px, false_positives, switches)


def score_tracking(instants: Instants, matches: Matches | None = None) -> TrackingScore:
    """Return all measures; ``matches``: what :func:`match` gave, None: it is called."""
    matches = match(instants) if matches is None else matches
    there, reported = instants.there, instants.reported
    matched = matches.track >= 0
    objects, reports = int(there.sum()), int(reported.sum())
    hits = int(matched.sum())
    misses = objects - hits
    false_positives, switches = int(matches.false_positives.sum()), int(matches.switches.sum())
    lengths = there.sum(axis=0)
    shares = matched.sum(axis=0)[lengths > 0] / lengths[lengths > 0]
    mostly_tracked, mostly_lost = int((shares >= MOSTLY_TRACKED).sum()), int((shares < MOSTLY_LOST).sum())
    identity = identity_true_positives(instants)
    hota, detection, association = _hota(instants)
    return TrackingScore(
        objects=objects,
        reports=reports,
        matches=hits,
        misses=misses,
        false_positives=false_positives,
        id_switches=switches,
        fragmentations=sum(_fragmentations(there[:, b], matched[:, b]) for b in range(there.shape[1])),
        swaps=count_swaps(matches.track),
        mostly_tracked=mostly_tracked,
        partly_tracked=len(shares) - mostly_tracked - mostly_lost,
        mostly_lost=mostly_lost,
        mota=1.0 - (misses + false_positives + switches) / objects if objects else None,
        motp_px=float(np.nanmean(matches.distance_px)) if hits else None,
        idf1=2.0 * identity / (objects + reports) if objects + reports else None,
        id_precision=identity / reports if reports else None,
        id_recall=identity / objects if objects else None,
        hota=hota,
        detection_accuracy=detection,
        association_accuracy=association,
    )


def identity_true_positives(instants: Instants) -> int:
    """Return IDTP: instants that agree if each object has one track, and each track one object, for the whole time."""
    objects, tracks = instants.objects.shape[1], instants.tracks.shape[1]
    agree = np.zeros((objects, tracks))
    for b in range(objects):
        between = np.hypot(*np.moveaxis(instants.tracks - instants.objects[:, b, None], -1, 0))
        agree[b] = (between <= instants.gate_px[:, b, None]).sum(axis=0)
    return int(agree[linear_sum_assignment(agree, maximize=True)].sum())


def count_swaps(track: Ints) -> int:
    """Return how often a track comes to be on another object; ``track`` as in :class:`Matches`."""
    swaps = 0
    for one in np.unique(track[track >= 0]):
        on = np.nonzero(track == one)[1]  # in order of time
        swaps += int(np.count_nonzero(np.diff(on)))
    return swaps


def _distances(a: Floats, b: Floats) -> Floats:
    return np.hypot(a[:, None, 0] - b[None, :, 0], a[:, None, 1] - b[None, :, 1])


def _nearest_pairs(between: Floats, allowed: NDArray[np.bool_]) -> list[tuple[int, int]]:
    """Return as many allowed pairs as can be, with the smallest sum of distances."""
    if not allowed.any():
        return []
    forbidden = 1.0 + between[allowed].max() * (min(between.shape) + 1)  # dearer than all allowed pairs together
    cost = np.where(allowed, between, forbidden)
    return [(int(i), int(j)) for i, j in zip(*linear_sum_assignment(cost), strict=True) if allowed[i, j]]


def _fragmentations(there: NDArray[np.bool_], matched: NDArray[np.bool_]) -> int:
    """Return how often one object is tracked again, of the instants at which it was there."""
    on = matched[there].astype(np.int8)
    begins = int(np.count_nonzero(np.diff(on, prepend=np.int8(0)) == 1))
    return max(0, begins - 1)


def _hota(instants: Instants) -> tuple[float | None, float | None, float | None]:
    """Return HOTA, DetA and AssA, mean over the thresholds (Luiten et al. 2021, sections 4 and 5).

    As they do, objects and tracks are matched once for all thresholds, so that what is matched adds most to association
    first, then to similarity; pairs below a threshold do not count there.
    """
    there, reported = instants.there, instants.reported
    objects, tracks = there.shape[1], reported.shape[1]
    if not there.any():
        return None, None, None
    lengths, track_lengths = there.sum(axis=0), reported.sum(axis=0)
    similarities: list[tuple[Ints, Ints, Floats]] = []
    agreement = np.zeros((objects, tracks))
    for t in np.flatnonzero(there.any(axis=1) & reported.any(axis=1)):
        rows, columns = np.flatnonzero(there[t]), np.flatnonzero(reported[t])
        between = _distances(instants.objects[t, rows], instants.tracks[t, columns])
        similarity = np.maximum(0.0, 1.0 - between / (2.0 * instants.gate_px[t, rows, None]))
        similarities.append((rows, columns, similarity))
        either = similarity.sum(axis=0)[None, :] + similarity.sum(axis=1)[:, None] - similarity
        agreement[np.ix_(rows, columns)] += similarity / np.maximum(either, 1e-12)
    aligned = agreement / np.maximum(lengths[:, None] + track_lengths[None, :] - agreement, 1e-12)
    pairs = np.zeros((len(ALPHAS), objects, tracks))
    for rows, columns, similarity in similarities:
        i, j = linear_sum_assignment(aligned[np.ix_(rows, columns)] * similarity, maximize=True)
        above = similarity[i, j][None, :] >= ALPHAS[:, None] - 1e-12
        pairs[:, rows[i], columns[j]] += above
    hits = pairs.sum(axis=(1, 2))
    detection = hits / (lengths.sum() + track_lengths.sum() - hits)
    either_length = np.maximum(lengths[:, None] + track_lengths[None, :] - pairs, 1.0)
    association = (pairs**2 / either_length).sum(axis=(1, 2)) / np.maximum(hits, 1.0)
    hota = np.sqrt(detection * association)
    return float(hota.mean()), float(detection.mean()), float(association.mean())


def block_counts(instants: Instants, matches: Matches, block: int) -> Floats:
    """Return the sums of blocks of ``block`` instants: objects, errors, matches, distance (px); ``(blocks, 4)``.

    MOTA and MOTP are ratios of their totals, so that resampling the blocks tells how sure they are.
    """
    matched = matches.track >= 0
    each = np.column_stack(
        (
            instants.there.sum(axis=1),
            (instants.there & ~matched).sum(axis=1) + matches.false_positives + matches.switches,
            matched.sum(axis=1),
            np.nansum(matches.distance_px, axis=1),
        )
    ).astype(np.float64)
    return np.add.reduceat(each, np.arange(0, len(each), block)) if len(each) else each

