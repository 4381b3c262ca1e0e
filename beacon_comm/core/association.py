"""Association: which blob is of which track, all together.

Of all ways to give blobs to the tracks in whose gates they lie, each at most once, the one with the most pairs, and of these
the likeliest, the one with the least sum of costs.  Tracks and blobs that can be given to nobody else
are matched at once; the assignment problem (Kuhn, 1955) is solved for each group that competes.
"""

from __future__ import annotations

from collections.abc import Callable
from itertools import groupby

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

_NO_PAIR = 1e12


def assign(
    first: NDArray[np.int64], second: NDArray[np.int64], costs_of_all: Callable[[], NDArray[np.float64]], shape: tuple[int, int]
) -> list[tuple[int, int]]:
    """Return the pairs ``(i, j)`` of the best assignment.

    Args:
        first, second: the pairs that may be, ``(n,)``.
        costs_of_all: returns of each -2 log of its likelihood and a constant, from 0 to far below 10¹², ``(n,)``; called only
            where some compete.
        shape: how many first and second ones there are.
    """
    firsts, seconds = first.tolist(), second.tolist()
    if len(set(firsts)) == len(set(seconds)) == len(firsts):
        return list(zip(firsts, seconds, strict=True))
    cost = costs_of_all()
    graph = coo_array((np.ones(len(first)), (first, second + shape[0])), shape=(sum(shape), sum(shape)))
    _, group = connected_components(graph, directed=False)
    of = group[first]
    order = np.argsort(of, kind='stable')
    entries = zip(of[order].tolist(), first[order].tolist(), second[order].tolist(), cost[order].tolist(), strict=True)
    return [pair for _, some in groupby(entries, key=lambda entry: entry[0]) for pair in _best([one[1:] for one in some])]


def _best(pairs: list[tuple[int, int, float]]) -> list[tuple[int, int]]:
    """Return the best assignment of a group, each of its pairs with its cost."""
    rows, columns = ({label: k for k, label in enumerate(dict.fromkeys(pair[side] for pair in pairs))} for side in (0, 1))
    if len(rows) == 1 or len(columns) == 1:
        i, j, _ = min(pairs, key=lambda pair: pair[2])
        return [(i, j)]
    costs = np.full((len(rows), len(columns)), _NO_PAIR)
    for i, j, cost in pairs:
        costs[rows[i], columns[j]] = cost
    firsts, seconds = list(rows), list(columns)
    chosen = zip(*linear_sum_assignment(costs), strict=True)
    return [(firsts[a], seconds[b]) for a, b in chosen if costs[a, b] < _NO_PAIR]
