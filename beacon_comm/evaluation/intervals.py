"""Confidence intervals of what is no share: by resampling (B. Efron, 1979); shares have Wilson's, see :mod:`.scoring`.

Values that were measured one after another in one run are alike, so it is *blocks* that are resampled: runs of other seeds
where there are several, else stretches of time longer than what makes the values alike.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from beacon_comm.evaluation.scoring import Interval

RESAMPLED = 1000
FEWEST_BLOCKS = 5

Floats = NDArray[np.float64]


def bootstrap_interval(
    blocks: Floats, statistic: Callable[[Floats], Floats], level: float = 0.95, seed: int = 0
) -> Interval | None:
    """Return the percentile interval of a statistic of the blocks' sums.

    Args:
        blocks: what each block adds, ``(n, k)``.
        statistic: of sums over blocks, ``(m, k)`` to ``(m,)``; NaN where there is none.
        level: of the interval.
        seed: of the resampling.

    Returns:
        None with fewer than 5 blocks, or where the statistic is not to be had.
    """
    if len(blocks) < FEWEST_BLOCKS:
        return None
    picks = np.random.default_rng(seed).integers(len(blocks), size=(RESAMPLED, len(blocks)))
    with np.errstate(divide='ignore', invalid='ignore'):
        values = statistic(blocks[picks].sum(axis=1))
    values = values[np.isfinite(values)]
    if len(values) < RESAMPLED // 2:
        return None
    low, high = np.quantile(values, [(1.0 - level) / 2.0, (1.0 + level) / 2.0])
    return Interval(float(low), float(high))


def mean_interval(values: Floats) -> Interval | None:
    """Return the interval of the mean of independent values, ``(n,)``."""
    blocks = np.column_stack((values, np.ones(len(values))))
    return bootstrap_interval(blocks, lambda sums: sums[:, 0] / sums[:, 1])
