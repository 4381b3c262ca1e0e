"""Assignment against trying every way."""

import itertools

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from beacon_comm.core.association import assign


def best_of_all(pairs: dict[tuple[int, int], float], m: int, n: int) -> tuple[int, float]:
    """Return how many pairs the best assignment has, and its cost."""
    best = (0, 0.0)
    for chosen in itertools.product([-1, *range(n)], repeat=m):
        used = [j for j in chosen if j >= 0]
        if len(used) != len(set(used)) or any(j >= 0 and (i, j) not in pairs for i, j in enumerate(chosen)):
            continue
        cost = sum(pairs[i, j] for i, j in enumerate(chosen) if j >= 0)
        best = max(best, (len(used), -cost))
    return best[0], -best[1]


@settings(max_examples=100, deadline=None)
@given(st.dictionaries(st.tuples(st.integers(0, 3), st.integers(0, 3)), st.integers(0, 50).map(float), max_size=10))
def test_the_most_pairs_at_the_least_cost(pairs: dict[tuple[int, int], float]) -> None:
    first, second = (np.array([pair[k] for pair in pairs], np.int64) for k in range(2))
    found = assign(first, second, lambda: np.array(list(pairs.values())), (4, 4))
    assert len({i for i, _ in found}) == len({j for _, j in found}) == len(found)
    assert (len(found), sum(pairs[pair] for pair in found)) == best_of_all(pairs, 4, 4)


def test_nearest_first_would_leave_one_alone() -> None:
    """Track 0 is nearer to blob 0, but so is track 1, which has no other."""
    found = assign(np.array([0, 0, 1]), np.array([0, 1, 0]), lambda: np.array([1.0, 4.0, 2.0]), (2, 2))
    assert sorted(found) == [(0, 1), (1, 0)]
