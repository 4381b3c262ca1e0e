"""Sendings that nothing vouches for, between ones that do: a beacon that repeats its text at a steady distance.

::

    found       ├─────┤ ├─────┤         ├─────┤ ├─────┤        distance P of neighbours
    inferred                    ├─────┤                        a hole of a whole multiple of P

Without them a text that was decoded so badly that its start is not found would not count at all.  Nothing is inferred
before the first or after the last found sending, where the beacon may not have been sending.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

from beacon_comm.evaluation.alignment import Sending

# A hole is a multiple of the distance if it is so within this much for each step (characters).
STEP_TOLERANCE = 0.25


def with_repeats(sendings: Sequence[Sending], length: int) -> tuple[Sending, ...]:
    """Return the sendings with the inferred ones between them.

    Args:
        sendings: found ones, in order of time.
        length: characters of the truth.
    """
    period_ns = _distance(sendings, length)
    if period_ns is None:
        return tuple(sendings)
    filled = list(sendings[:1])
    for sending, following in pairwise(sendings):
        hole_ns = following.start_ns - sending.start_ns
        steps = round(hole_ns / period_ns)
        if abs(hole_ns - steps * period_ns) <= steps * STEP_TOLERANCE * sending.period_ns:
            filled += [
                Sending(sending.start_ns + step * hole_ns / steps, sending.period_ns, 0, length - 1, 0.0)
                for step in range(1, steps)
            ]
        filled.append(following)
    return tuple(filled)


def _distance(sendings: Sequence[Sending], length: int) -> float | None:
    """Return the distance P of neighbouring sendings (ns); None where no two are neighbours for sure.

    It is the smallest that occurs, if not another whole sending fits into it.
    """
    distances = [
        following.start_ns - sending.start_ns
        for sending, following in pairwise(sendings)
        if following.start_ns - sending.start_ns >= (length - 0.5) * sending.period_ns
    ]
    if not distances:
        return None
    smallest = min(distances)
    return smallest if smallest < (2 * length - 0.5) * sendings[0].period_ns else None
