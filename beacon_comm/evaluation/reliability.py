"""Whether confidences are true: decoded characters judged right or wrong, and binned by what they claimed.

::

    share right ▲ 1             ·/      a calibrated confidence lies on the diagonal:
                │         ·  /          of the characters with confidence c a share c is right
                │      / ·
                └──────────────► confidence, in bins of the log odds: near 1 they are as narrow as they have to be

A character is right if the truth character due where it was decoded has its code; a second one in the same place is
wrong, and so is one between two places: inserted.  What was decoded outside every sending is not judged.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from beacon_comm.core.character import Character
from beacon_comm.evaluation.alignment import MATCH_DISTANCE
from beacon_comm.evaluation.scoring import Interval, wilson_interval

OUTSIDE = -1

BIN_EDGES = (
    0.0, 0.05, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 0.95, 0.98, 0.99, 0.995, 0.998, 0.999, 0.9995, 0.9998,
    0.9999, 0.99999, 0.999999, 1.0,
)  # fmt: skip
"""Borders of the bins; the last one holds 1 as well."""


@dataclass(frozen=True, slots=True)
class Due:
    """Characters that were sent in a row.

    Attributes:
        t_ns: when each was due (ns, sensor clock), increasing, ``(n,)`` int64; n at least 2.
        codes: what was sent, ``(n,)`` int64.
    """

    t_ns: NDArray[np.int64]
    codes: NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class Bin:
    """Characters whose confidences lie between two borders.

    Attributes:
        low, high: the borders.
        characters: how many there are, at least 1.
        right: how many of them are right.
        confidence: mean of what they claimed.
    """

    low: float
    high: float
    characters: int
    right: int
    confidence: float

    @property
    def share(self) -> float:
        """Share of the characters that are right."""
        return self.right / self.characters

    @property
    def interval(self) -> Interval:
        """95 % confidence interval of the share (Wilson), as if characters erred independently."""
        return wilson_interval(self.share, self.characters)


def judged(characters: Sequence[Character], sendings: Sequence[Due]) -> NDArray[np.int8]:
    """Return for each decoded character, in the order given, 1 right, 0 wrong or -1 outside every sending, ``(m,)``.

    Args:
        characters: what was decoded.
        sendings: what was sent when; they do not overlap.
    """
    t_ns = np.array([character.t_ns for character in characters], np.int64)
    codes = np.array([character.code for character in characters], np.int64)
    verdicts = np.full(len(characters), OUTSIDE, np.int8)
    for due in sendings:
        position = _positions(t_ns, due.t_ns)
        inside = np.flatnonzero((position >= -MATCH_DISTANCE) & (position < len(due.t_ns) - MATCH_DISTANCE))
        verdicts[inside] = 0
        place = np.minimum(np.rint(position[inside]).astype(np.int64), len(due.t_ns) - 1)
        distance = np.abs(position[inside] - place)
        order = np.lexsort((distance, place))
        _, firsts = np.unique(place[order], return_index=True)
        nearest = order[firsts]  # of each place that anything was decoded near
        matched = nearest[distance[nearest] < MATCH_DISTANCE]
        verdicts[inside[matched]] = codes[inside[matched]] == due.codes[place[matched]]
    return verdicts


def reliability_bins(
    confidence: NDArray[np.float64], right: NDArray[np.bool_], edges: Sequence[float] = BIN_EDGES
) -> tuple[Bin, ...]:
    """Return the bins that are not empty.

    Args:
        confidence: what was claimed, 0 to 1, ``(n,)``.
        right: whether it was right, ``(n,)``.
        edges: borders of the bins, increasing, from 0 to 1.
    """
    place = np.clip(np.searchsorted(edges, confidence, side='right') - 1, 0, len(edges) - 2)
    bins = []
    for k in np.unique(place):
        own = place == k
        count, hits = int(own.sum()), int(right[own].sum())
        bins.append(Bin(edges[k], edges[k + 1], count, hits, float(confidence[own].mean())))
    return tuple(bins)


def expected_calibration_error(bins: Sequence[Bin]) -> float:
    """Return the mean distance of confidence and share right over the characters' bins; 0 without any."""
    characters = sum(one.characters for one in bins)
    return sum(one.characters * abs(one.share - one.confidence) for one in bins) / max(characters, 1)


def _positions(t_ns: NDArray[np.int64], due_ns: NDArray[np.int64]) -> NDArray[np.float64]:
    """Return where times lie among due times, in characters; beyond the ends by the outermost spacing."""
    first, last = (due_ns[1] - due_ns[0]), (due_ns[-1] - due_ns[-2])
    padded = np.concatenate(([due_ns[0] - first], due_ns, [due_ns[-1] + last]))
    origin = padded[0]  # a double holds differences to the nanosecond, not the times
    position = np.interp((t_ns - origin).astype(np.float64), (padded - origin).astype(np.float64), np.arange(len(padded)))
    position[t_ns <= padded[0]] = 0.0
    position[t_ns >= padded[-1]] = len(padded) - 1
    return position - 1.0
