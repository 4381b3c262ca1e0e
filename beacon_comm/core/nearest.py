"""Which circles may hold a pixel: for every cell of 16 x 16 pixels a list of them, in their own order.

    cell      row by row          member[first[cell] : first[cell + 1]]

An event looks at its cell's list alone, so its cost does not grow with the number of circles on the sensor; and as most cells
have none, first of all at a byte that tells so.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from beacon_comm.core.hop_events import CODE_BITS

CELL_SHIFT = 4


@njit(cache=True, nogil=True)
def cells_along(length_px):  # type: ignore[no-untyped-def]
    """Return how many cells a side of the sensor (px) needs."""
    return ((length_px - 1) >> CELL_SHIFT) + 1


def cell_lists(
    box: NDArray[np.float64], width: int, height: int
) -> tuple[NDArray[np.int64], NDArray[np.int32]]:
    """List the boxes that touch each cell.

    Args:
        box: left, right, top, bottom (px), ``(m, 4)`` float64.
        width, height: of the sensor (px).

    Returns:
        ``first``, ``(cells + 1,)`` int64, and ``member``, int32; see the module's head.
    """
    first, member = list_cells(box, width, height, cells_along(width), cells_along(height))
    return first, member


@njit(cache=True, nogil=True)
def list_cells(box, width, height, across, down):  # type: ignore[no-untyped-def]
    """Compile :func:`cell_lists`, with how many cells are side by side and one below the other."""
    m = len(box)
    span = np.zeros((m, 4), np.int64)
    first = np.zeros(across * down + 1, np.int64)
    for k in range(m):
        span[k, 0] = np.int64(min(max(np.floor(box[k, 0]), 0.0), width)) >> CELL_SHIFT
        span[k, 1] = np.int64(min(max(np.ceil(box[k, 1]), -1.0), width - 1.0)) >> CELL_SHIFT
        span[k, 2] = np.int64(min(max(np.floor(box[k, 2]), 0.0), height)) >> CELL_SHIFT
        span[k, 3] = np.int64(min(max(np.ceil(box[k, 3]), -1.0), height - 1.0)) >> CELL_SHIFT
        for row in range(span[k, 2], span[k, 3] + 1):
            for column in range(span[k, 0], span[k, 1] + 1):
                first[row * across + column + 1] += 1
    for cell in range(across * down):
        first[cell + 1] += first[cell]
    member = np.empty(first[-1], np.int32)
    end = first.copy()
    for k in range(m):
        for row in range(span[k, 2], span[k, 3] + 1):
            for column in range(span[k, 0], span[k, 1] + 1):
                cell = row * across + column
                member[end[cell]] = k
                end[cell] += 1
    return first, member


@njit(cache=True, nogil=True)
def cells_with_members(first):  # type: ignore[no-untyped-def]
    """Return of each cell whether its list has members, uint8: one look for the many events that are near nothing."""
    some = np.empty(max(0, len(first) - 1), np.uint8)
    for cell in range(len(some)):
        some[cell] = first[cell] != first[cell + 1]
    return some


@njit(cache=True, nogil=True)
def events_in(some, across, code, shift):  # type: ignore[no-untyped-def]
    """Return which events of a hop lie in cells that are set in ``some``, ``(n,)`` uint32; ``shift``: the pixel grid's."""
    index = np.empty(len(code), np.uint32)
    row_shift, column_shift = np.uint32(CODE_BITS + shift + CELL_SHIFT), np.uint32(CODE_BITS + CELL_SHIFT)
    columns = np.uint32((1 << (shift - CELL_SHIFT)) - 1)
    n = np.uint64(0)  # unsigned, so that no place is taken to count from the end
    for i in range(len(code)):
        cell = np.uint64(code[i] >> row_shift) * np.uint64(across) + np.uint64((code[i] >> column_shift) & columns)
        index[n] = i
        n += np.uint64(some[cell])
    return index[:n]
