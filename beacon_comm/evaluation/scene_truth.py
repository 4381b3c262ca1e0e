"""The truth of a scene on the recording's clock: where each beacon was, and what it sent when.

    scene time      0 ──── start ─── first event ────────────── end        paths, sendings (ns, the simulator's clock)
    recording time             ┆          0 ───────────────── end          = scene time - shift: results (ns)

Characters of a sending that was cut, that were hidden, or lie outside the recording, were not to be read: a sending falls
into *runs* of whole characters in sight.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from beacon_comm.core.framing import CharacterFrame
from beacon_comm.evaluation.reliability import Due
from beacon_comm.evaluation.scoring import Transmission, not_found

# Whether a beacon is in sight is asked this often at least (ns).
SIGHT_STEP_NS = 500_000
MOST_SIGHT_STEPS = 400_000
# What a track on one of these stands for is neither asked for nor false.
IGNORED_KINDS = ('reflection',)

Ints = NDArray[np.int64]
Floats = NDArray[np.float64]


class TrueBeacon(Protocol):
    """What is known of one beacon; times are scene times (ns)."""

    @property
    def name(self) -> str: ...
    @property
    def kind(self) -> str: ...
    @property
    def text(self) -> str | None: ...
    @property
    def bit_rate_bps(self) -> float | None: ...
    @property
    def sendings_ns(self) -> Ints: ...
    @property
    def characters_ns(self) -> Ints: ...
    def centre(self, t_ns: ArrayLike, /) -> tuple[Floats, Floats]: ...
    def visible(self, t_ns: ArrayLike, /) -> NDArray[np.bool_]: ...
    def radius_px(self, t_ns: ArrayLike, /) -> Floats: ...
    def bearing(self, t_ns: ArrayLike, /) -> tuple[Floats, Floats] | None: ...


@dataclass(frozen=True, slots=True)
class Sight:
    """When a beacon was in sight, in recording time.

    Attributes:
        t_ns: instants, evenly spaced, ``(n,)`` int64.
        visible: whether it was in sight, ``(n,)`` bool.
    """

    t_ns: Ints
    visible: NDArray[np.bool_]

    @classmethod
    def of(cls, beacon: TrueBeacon, span_ns: tuple[int, int], shift_ns: int) -> Sight:
        """Ask a beacon; ``span_ns``: begin and end of the recording, ``shift_ns``: scene time less recording time (ns)."""
        begin_ns, end_ns = span_ns
        step_ns = max(SIGHT_STEP_NS, -(-(end_ns - begin_ns) // MOST_SIGHT_STEPS))
        t_ns = np.arange(begin_ns, end_ns + step_ns, step_ns, dtype=np.int64)
        return cls(t_ns, np.asarray(beacon.visible(t_ns + shift_ns), np.bool_))

    def intervals_ns(self) -> list[tuple[int, int]]:
        """Return begin and end of each stretch in sight (ns)."""
        change = np.diff(np.concatenate(([0], self.visible.astype(np.int8), [0])))
        begins, ends = np.flatnonzero(change == 1), np.flatnonzero(change == -1)
        return [(int(self.t_ns[a]), int(self.t_ns[b - 1])) for a, b in zip(begins, ends, strict=True)]

    def throughout(self, begin_ns: Floats, end_ns: Floats) -> NDArray[np.bool_]:
        """Return whether it was in sight from each begin to each end, inside the recording all the while."""
        hidden = np.concatenate(([0], np.cumsum(~self.visible)))
        first = np.maximum(np.searchsorted(self.t_ns, begin_ns, side='right') - 1, 0)
        stop = np.searchsorted(self.t_ns, end_ns)
        inside = (begin_ns >= self.t_ns[0]) & (end_ns <= self.t_ns[-1])
        return inside & (hidden[np.minimum(stop, len(self.visible))] == hidden[first])


def runs_in_sight(beacon: TrueBeacon, sight: Sight, shift_ns: int, frame: CharacterFrame) -> tuple[Transmission, ...]:
    """Return what was sent in sight, as sendings for :func:`~.scoring.score_at`; none where it is not known when.

    Args:
        beacon: what it sent, and when.
        sight: when it was in sight.
        shift_ns: scene time less recording time (ns).
        frame: layout of a character.
    """
    if not beacon.text or beacon.bit_rate_bps is None:
        return ()
    character_ns = frame.duration_ns(beacon.bit_rate_bps)
    blank = not_found(beacon.text, frame)
    runs = []
    # How many characters of each sending were sent at all; all of them where that is not told.
    ends_ns = np.append(beacon.sendings_ns[1:], np.iinfo(np.int64).max)[: len(beacon.sendings_ns)]
    counts = np.diff(np.searchsorted(beacon.characters_ns, (beacon.sendings_ns, ends_ns)), axis=0)[0]
    for start_ns, count in zip((int(t) - shift_ns for t in beacon.sendings_ns), counts, strict=True):
        due_ns: Floats = start_ns + np.arange(len(beacon.text)) * np.float64(character_ns)
        whole = sight.throughout(due_ns, due_ns + character_ns)
        if len(beacon.characters_ns):
            whole[count:] = False
        change = np.diff(np.concatenate(([0], whole.astype(np.int8), [0])))
        for first, stop in zip(np.flatnonzero(change == 1), np.flatnonzero(change == -1), strict=True):
            runs.append(
                replace(
                    blank, start_ns=start_ns, bit_rate_bps=beacon.bit_rate_bps, first=int(first), characters=int(stop - first)
                )
            )
    return tuple(runs)


def dues(runs: Sequence[Transmission], text: str, frame: CharacterFrame) -> list[Due]:
    """Return when each character of runs of two at least was due, in order of time."""
    found = []
    for run in runs:
        if run.start_ns is None or run.bit_rate_bps is None or run.characters < 2:
            continue
        k = np.arange(run.first, run.first + run.characters)
        t_ns = np.rint(run.start_ns + k * frame.duration_ns(run.bit_rate_bps)).astype(np.int64)
        found.append(Due(t_ns, np.array([ord(text[n]) for n in k], np.int64)))
    return sorted(found, key=lambda due: int(due.t_ns[0]))
