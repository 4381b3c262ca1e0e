"""How much memory a long run holds, and whether it grows: for the scripts beside it."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np

LEAST_SIZES, MOST_GROWTH = 3, 1.05


def resident_mib() -> float:
    """Return the memory that the process holds (MiB)."""
    pages = int(Path('/proc/self/statm').read_text().split()[1])
    return pages * os.sysconf('SC_PAGE_SIZE') / 2**20


def growth(sizes_mib: list[float]) -> list[str]:
    """Return a broken promise if the last third of the sizes (MiB) is above the middle one; too few tell nothing."""
    third = len(sizes_mib) // 3
    if third < LEAST_SIZES:
        return []
    before, after = (float(np.median(part)) for part in (sizes_mib[third:-third], sizes_mib[-third:]))
    return [f'memory grew from {before:.0f} to {after:.0f} MiB'] if after > before * MOST_GROWTH else []
