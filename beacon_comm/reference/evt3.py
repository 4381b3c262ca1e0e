"""EVT 3.0 words to events, all words at once; the words are drawn in :mod:`beacon_comm.wire.evt3`.

What a word sets holds until the next one of its kind: "the last before" is a running maximum over places.  It reads
what a sound driver sends, from the first word on; missing packets and restarts are the compiled decoder's business.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from beacon_comm.core.events import EventBatch
from beacon_comm.wire.evt3 import ADDR_X, ADDR_Y, PERIOD_US, STEP_BACK_US, TIME_HIGH, TIME_LOW, VECT_8, VECT_12, VECT_BASE_X

_UNKNOWN = -1
_NO_BASE = -(1 << 40)

Words = NDArray[np.int64]


class ReferenceEvt3Decoder:
    """Decoder of one stream's payloads.

    Args:
        width, height: of the sensor (px).
    """

    def __init__(self, width: int, height: int) -> None:
        self._size = width, height
        self._row = self._high_us = self._latest_us = _UNKNOWN
        self._base = _NO_BASE
        self._sign = self._low_us = self._wraps_us = 0
        self._timed = False

    def decode(self, payload: NDArray[np.uint8]) -> EventBatch | None:
        """Return the payload's events, None while the time is not known."""
        words = payload[: len(payload) // 2 * 2].view('<u2').astype(np.int64)
        if len(words):
            code = words >> 12
            time_us, timed = self._times(words, code)
            row = _held(words & 0x7FF, code == ADDR_Y, self._row)
            place, column, sign = self._pixels(words, code)
            kept = timed[place] & (row[place] != _UNKNOWN) & (row[place] < self._size[1])
            kept &= (column >= 0) & (column < self._size[0])
            place, self._row = place[kept], int(row[-1])
        if self._latest_us == _UNKNOWN:
            return None
        if not len(words):
            return EventBatch.empty(self._latest_us * 1000)
        return EventBatch(
            column[kept].astype(np.uint16),
            row[place].astype(np.uint16),
            (2 * sign[kept] - 1).astype(np.int8),
            time_us[place] * 1000,
            self._latest_us * 1000,
        )

    def _times(self, words: Words, code: Words) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
        """Return the unwrapped time (µs) that holds at each word, as a running maximum, and whether it is known."""
        is_high, is_low = code == TIME_HIGH, code == TIME_LOW
        bits_us = words & 0xFFF
        highs_us = bits_us[is_high] << 12
        if len(highs_us):
            # A fall is a wrap unless it is a small step back, which may lead back across a wrap.
            step_us = np.diff(highs_us, prepend=highs_us[0] if self._high_us == _UNKNOWN else self._high_us % PERIOD_US)
            wraps = (step_us < -STEP_BACK_US).astype(np.int64) - (step_us >= PERIOD_US - STEP_BACK_US)
            unwrapped_us = highs_us + self._wraps_us + PERIOD_US * np.cumsum(wraps)
            self._wraps_us = int(unwrapped_us[-1] - highs_us[-1])
        else:
            unwrapped_us = highs_us
        at_high = np.zeros(len(words), np.int64)
        at_high[is_high] = unwrapped_us
        high_us = _held(at_high, is_high, self._high_us)
        # The lower bits hold until a TIME_HIGH that differs.
        differs = is_high & (high_us != np.concatenate(([self._high_us], high_us[:-1])))
        low_us = _held(np.where(is_low, bits_us, 0), is_low | differs, self._low_us)
        timed = self._timed | np.logical_or.accumulate(is_low & (high_us != _UNKNOWN))
        now_us = np.where(high_us == _UNKNOWN, _UNKNOWN, high_us + low_us)
        latest_us = np.maximum.accumulate(np.maximum(now_us, self._latest_us))
        self._high_us, self._low_us, self._latest_us = int(high_us[-1]), int(low_us[-1]), int(latest_us[-1])
        self._timed = bool(timed[-1])
        return latest_us, timed

    def _pixels(self, words: Words, code: Words) -> tuple[Words, Words, Words]:
        """Return for every event the place of its word, in order, its column, and 1 for a rise."""
        columns = np.where(code == VECT_12, 12, np.where(code == VECT_8, 8, 0))
        moved = np.cumsum(columns)
        is_base = code == VECT_BASE_X
        from_base = _held((words & 0x7FF) - moved, is_base, self._base)
        base_sign = _held(words >> 11 & 1, is_base, self._sign)
        self._base, self._sign = int(from_base[-1] + moved[-1]), int(base_sign[-1])
        single, vector = np.flatnonzero(code == ADDR_X), np.flatnonzero(columns)
        bit = np.arange(12)
        which, shift = np.nonzero((words[vector, None] >> bit & 1) * (bit < columns[vector, None]))
        of = vector[which]
        place = np.concatenate((single, of))
        column = np.concatenate((words[single] & 0x7FF, (from_base + moved - columns)[of] + shift))
        sign = np.concatenate((words[single] >> 11 & 1, base_sign[of]))
        order = np.argsort(place, kind='stable')
        return place[order], column[order], sign[order]


def _held(values: Words, where: NDArray[np.bool_], before: int) -> Words:
    """Return the last of the values marked so far at each place; ``before`` where there was none."""
    place = np.maximum.accumulate(np.where(where, np.arange(len(where)), -1))
    held: Words = np.where(place < 0, before, values[place])
    return held
