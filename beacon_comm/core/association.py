"""Association: which blob is of which track, all together.

Of all ways to give blobs to the tracks in whose gates they lie, each at most once, the one with the most pairs, and of these
the likeliest, the one with the least sum of costs.  Tracks and blobs that can be given to nobody else
are matched at once; the assignment problem (Kuhn, 1955) is solved for each group that competes.
"""

from __future__ import annotations

from collections.abc import Callable

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
    ends = np.concatenate((first, second + shape[0]))
    graph = coo_array((np.ones(len(first)), (first, second + shape[0])), shape=(sum(shape), sum(shape)))
    _, group = connected_components(graph, directed=False)
    alone = np.bincount(group[ends], minlength=group.max() + 1)[group[first]] == 2
    pairs = list(zip(first[alone].tolist(), second[alone].tolist(), strict=True))
    for g in np.unique(group[first[~alone]]):
        of = np.flatnonzero(group[first] == g)
        rows, i = np.unique(first[of], return_inverse=True)
        columns, j = np.unique(second[of], return_inverse=True)
        costs = np.full((len(rows), len(columns)), _NO_PAIR)
        costs[i, j] = cost[of]
        for a, b in zip(*linear_sum_assignment(costs), strict=True):
            if costs[a, b] < _NO_PAIR:
                pairs.append((int(rows[a]), int(columns[b])))
    return pairs
