"""Event batches to EVT 3.0 words; the words are drawn in :mod:`.evt3`.

Every payload begins with TIME_HIGH and TIME_LOW and sets row and column before it uses them, so that it can be read
from its own start, as a reader does that lost the packet before.  Three or more events of one time, row and polarity
in columns that rise within 12 px become VECT_BASE_X and VECT_12.

Times are cut to whole µs, of which 24 bits are sent: a reader's unwrapped time is right but for a multiple of
16.777 s.  A pause is bridged by every TIME_HIGH that a sensor would send, within a payload and from one to the next, so
that a reader follows across pauses of any length.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from beacon_comm.core.events import EventBatch
from beacon_comm.wire.errors import WireError
from beacon_comm.wire.evt3 import ADDR_X, ADDR_Y, TIME_HIGH, TIME_LOW, VECT_12, VECT_BASE_X

MAX_SIDE_PX = 1 << 11
MAX_PAUSE_US = 10_000 * 1_000_000
_NO_TIME = -1


class Evt3Encoder:
    """Encoder of one sensor's stream; keeps the time reached from batch to batch.

    Raises:
        WireError: a sensor that 11 bits of coordinates do not hold.
    """

    def __init__(self, width: int, height: int) -> None:
        if not (0 < width <= MAX_SIDE_PX and 0 < height <= MAX_SIDE_PX):
            raise WireError('size', f'{width} x {height} px: evt3 holds 1 to {MAX_SIDE_PX} a side')
        self._width = width
        self._height = height
        self._reached_us = _NO_TIME

    def encode(self, batch: EventBatch, *, with_end: bool = True) -> bytes:
        """Return the batch as an evt3 payload.

        Args:
            batch: events of the sensor; its times do not step back behind the batch before.
            with_end: end with time words for ``t_end_ns``, so that a batch without events moves time on.

        Raises:
            WireError: events outside the sensor, negative times or times out of order, or a pause above 10,000 s.
        """
        t_us = batch.t_ns // 1000
        start_us = int(t_us[0]) if len(batch) else batch.t_end_ns // 1000
        end_us = max(batch.t_end_ns // 1000, int(t_us[-1]) if len(batch) else 0) if with_end else _NO_TIME
        self._check(batch, t_us, start_us, end_us)
        reached = self._reached_us if self._reached_us != _NO_TIME else start_us
        bridged_us = max(end_us, int(t_us[-1]) if len(batch) else start_us) - reached
        # At worst an event needs TIME_HIGH, TIME_LOW, ADDR_Y, ADDR_X; the start and the end need four words.
        capacity = 4 * len(batch) + 8 + (bridged_us >> 12) + 1
        words = np.empty(capacity, '<u2')
        n = _encode(batch.x, batch.y, batch.polarity, t_us, reached, start_us, end_us, words)
        self._reached_us = max(end_us, int(t_us[-1]) if len(batch) else start_us)
        return words[:n].tobytes()

    def _check(self, batch: EventBatch, t_us: np.ndarray, start_us: int, end_us: int) -> None:
        if len(batch) and (int(batch.x.max()) >= self._width or int(batch.y.max()) >= self._height):
            raise WireError('outside', f'events outside the {self._width} x {self._height} px sensor')
        if start_us < 0 or start_us < self._reached_us or bool((np.diff(t_us) < 0).any()):
            raise WireError('order', f'times must be in order, from {max(self._reached_us, 0)} µs on')
        last_us = max(end_us, int(t_us[-1]) if len(batch) else start_us)
        reached_us = self._reached_us if self._reached_us != _NO_TIME else start_us
        if last_us - reached_us > MAX_PAUSE_US:
            raise WireError('pause', f'{(last_us - reached_us) // 1_000_000} s in one payload')


@njit(cache=True, nogil=True)
def _move_on(from_us, to_us, words, n):  # type: ignore[no-untyped-def]
    """Write the time words that lead from one time to another; return the place reached."""
    for high in range((from_us >> 12) + 1, (to_us >> 12) + 1):
        words[n] = TIME_HIGH << 12 | (high & 0xFFF)
        n += 1
    words[n] = TIME_LOW << 12 | (to_us & 0xFFF)
    return n + 1


@njit(cache=True, nogil=True)
def _encode(x, y, polarity, t_us, reached_us, start_us, end_us, words):  # type: ignore[no-untyped-def]
    """Write the words of a batch; return how many."""
    words[0] = TIME_HIGH << 12 | ((reached_us >> 12) & 0xFFF)
    words[1] = TIME_LOW << 12 | (reached_us & 0xFFF)
    n = 2
    now_us = reached_us
    if start_us != now_us:
        n = _move_on(now_us, start_us, words, n)
        now_us = start_us
    row = np.int64(-1)
    k = 0
    while k < len(x):
        if t_us[k] != now_us:
            n = _move_on(now_us, t_us[k], words, n)
            now_us = t_us[k]
        if y[k] != row:
            row = np.int64(y[k])
            words[n] = ADDR_Y << 12 | row
            n += 1
        on = np.int64(polarity[k] > 0) << 11
        base = np.int64(x[k])
        bits = np.int64(1)
        run = 1
        while (
            k + run < len(x)
            and t_us[k + run] == now_us
            and y[k + run] == row
            and polarity[k + run] == polarity[k]
            and x[k + run] > x[k + run - 1]
            and x[k + run] < base + 12
        ):
            bits |= 1 << (np.int64(x[k + run]) - base)
            run += 1
        if run >= 3:
            words[n] = VECT_BASE_X << 12 | on | base
            words[n + 1] = VECT_12 << 12 | bits
            n += 2
            k += run
        else:
            words[n] = ADDR_X << 12 | on | base
            n += 1
            k += 1
    if end_us > now_us:
        n = _move_on(now_us, end_us, words, n)
    return n
