"""Meetings: two beacons that came near one another are known by their signals when they are apart again.

::

    distance     ╲          ╱
    of two        ╲        ╱                near: both signatures are kept
    tracks         ╲______╱                 apart: log p(1's events | 1) + log p(2's | 2)   they have their own labels
                     near   │ some characters    or log p(1's events | 2) + log p(2's | 1)   they have one another's

Paths alone cannot tell what passes through one another from what turns back.  Where one of the two tracks was thrown off, a
track that began meanwhile may have its beacon.  A signature is good for as long as its clock is sure, about a second: beacons
that stay near one another for longer keep the labels that their paths give them.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from beacon_comm.core.signature import Signature
from beacon_comm.core.tracks import Track

Events = tuple[NDArray[np.int64], NDArray[np.int8]]
Backlog = Callable[[int], Events]

NEAR_PX = 2.0
"""Two tracks are near where no more than this lies between their circles (px)."""

SETTLING_CHARACTERS, DECIDING_CHARACTERS, PATIENT_CHARACTERS = 2, 5, 20
"""Tracks that are apart settle for so many characters; it is decided after so many, or later, up to so many."""

MARGIN, MARGIN_SHARE = 12.0, 0.1
"""By so much likelier (nat) one way has to be than the other, and by this share of the log p of both: bits that lie elsewhere
cost 15 % and more, and beacons whose bits lie alike cannot be told by how well they fit."""


@dataclass(slots=True)
class _Meeting:
    began_ns: int
    signatures: tuple[Signature, Signature]
    apart_ns: int | None = None  # since when they are apart, less the time to settle
    decide_ns: int = 0


class Meetings:
    """Finds the labels that are to be exchanged after meetings.

    Args:
        hop_s: from one point of the hop grid to the next (s).
    """

    def __init__(self, hop_s: float) -> None:
        self._hop_s = hop_s
        self._meetings: dict[tuple[int, int], _Meeting | None] = {}  # None: nothing can be said of this one

    def clear(self) -> None:
        """Forget all."""
        self._meetings.clear()

    def exchanged(
        self, tracks: Mapping[int, Track], signature: Callable[[int], Signature | None], backlog: Backlog, t_hop_ns: int
    ) -> list[tuple[int, int]]:
        """Return pairs of labels that are to be exchanged, one after the other; to be called at each point of the hop grid.

        Args:
            tracks: the tracks now, by label.
            signature: returns that of a label's beacon now, None: it is not read.
            backlog: returns a label's buffered events: times (ns, ``(n,)`` int64) and polarities (``(n,)`` int8).
            t_hop_ns: the hop's time (ns).
        """
        near = _near_pairs([track for track in tracks.values() if track.bit_rate_bps is not None], t_hop_ns, self._hop_s)
        for pair in near:
            meeting = self._meetings.get(pair)
            if meeting is not None:
                meeting.apart_ns = None
            elif pair not in self._meetings:
                first, second = (signature(track_id) for track_id in pair)
                self._meetings[pair] = None if first is None or second is None else _Meeting(t_hop_ns, (first, second))
        found: list[tuple[int, int]] = []
        for pair, meeting in [entry for entry in self._meetings.items() if entry[0] not in near]:
            if any(label in pair for labels in found for label in labels):
                continue  # of three that meet: the next hop has one exchange less to think of
            exchanges: list[tuple[int, int]] | None = []
            if meeting is not None and tracks.keys() >= set(pair):
                exchanges = _decide(pair, meeting, tracks, backlog, t_hop_ns)
            if exchanges is not None:
                del self._meetings[pair]
                found += exchanges
        return found


def _near_pairs(tracks: list[Track], t_hop_ns: int, hop_s: float) -> list[tuple[int, int]]:
    """Return the labels of those that are near one another, or were within the hop."""
    if len(tracks) < 2:
        return []
    state = np.array([(*t.position_at(t_hop_ns), t.vx_px_per_s, t.vy_px_per_s, t.extent_px) for t in tracks])
    pairs = zip(*(one.tolist() for one in _pairs(state, hop_s)), strict=True)
    return [(tracks[i].track_id, tracks[j].track_id) for i, j in pairs]


@njit(cache=True, nogil=True)
def _pairs(state, hop_s):  # type: ignore[no-untyped-def]
    """Return those that are near one another, ``(n,)`` int64 twice; ``state``: x, y at the hop, velocity, extent."""
    first, second = [], []
    for i in range(len(state)):
        for j in range(i + 1, len(state)):
            x, y = state[i, 0] - state[j, 0], state[i, 1] - state[j, 1]
            dx, dy = (state[i, 2] - state[j, 2]) * hop_s, (state[i, 3] - state[j, 3]) * hop_s  # within the hop
            share = min(max((x * dx + y * dy) / max(dx * dx + dy * dy, 1e-9), 0.0), 1.0)  # of it ago they were nearest
            if np.hypot(x - share * dx, y - share * dy) <= state[i, 4] + state[j, 4] + NEAR_PX:
                first.append(i)
                second.append(j)
    return np.array(first, np.int64), np.array(second, np.int64)


def _decide(
    pair: tuple[int, int], meeting: _Meeting, tracks: Mapping[int, Track], backlog: Backlog, t_hop_ns: int
) -> list[tuple[int, int]] | None:
    """Return which labels are to be exchanged now that two tracks are apart, None: it is too early to say."""
    character_ns = max(signature.character_ns for signature in meeting.signatures)
    if meeting.apart_ns is None:
        meeting.apart_ns = t_hop_ns + round(SETTLING_CHARACTERS * character_ns)
        meeting.decide_ns = t_hop_ns + round(DECIDING_CHARACTERS * character_ns)
    if t_hop_ns < meeting.decide_ns:
        return None
    meeting.decide_ns += round(character_ns)
    late = t_hop_ns - meeting.apart_ns >= PATIENT_CHARACTERS * character_ns
    seen = [track_id for track_id in pair if not tracks[track_id].quiet]
    if len(seen) == 2:
        events = [backlog(track_id) for track_id in pair]
        verdict = _have_exchanged(meeting.signatures, events, meeting.apart_ns, t_hop_ns)
        return [pair] if verdict else None if verdict is None and not late else []
    if len(seen) == 1:
        (gone,) = (track_id for track_id in pair if track_id not in seen)
        signatures = meeting.signatures if gone == pair[1] else meeting.signatures[::-1]
        for track in tracks.values():
            if not track.quiet and track.first_seen_ns >= meeting.began_ns:
                events = [backlog(seen[0]), backlog(track.track_id)]
                since_ns = max(meeting.apart_ns, track.first_seen_ns)
                verdict = _have_exchanged(signatures, events, since_ns, t_hop_ns, each=True)
                if verdict is not None:  # it is one of the two
                    return ([(seen[0], track.track_id)] if verdict else []) + [(gone, track.track_id)]
    return [] if late else None


def _have_exchanged(
    signatures: tuple[Signature, Signature], events: Sequence[Events], since_ns: int, t_ns: int, each: bool = False
) -> bool | None:
    """Return whether two tracks have one another's beacons, None: nobody can tell.

    Args:
        signatures, events: of both tracks.
        since_ns, t_ns: the time that counts (ns).
        each: either signature has to explain one of them better than the other does: another light fits both alike.
    """
    fits = [signature.explain(*some, since_ns, t_ns) for signature in signatures for some in events]
    own_1, other_1, other_2, own_2 = (math.nan if fit is None else fit for fit in fits)
    gains = [(other_2 - own_1, own_1 + other_2), (other_1 - own_2, other_1 + own_2)]  # of each track's events
    if not each:
        gains = [(gains[0][0] + gains[1][0], gains[0][1] + gains[1][1])]
    clear = [abs(gain) >= max(MARGIN, -MARGIN_SHARE * both) for gain, both in gains]
    exchanged = {gain > 0.0 for gain, _ in gains}
    return exchanged.pop() if all(clear) and len(exchanged) == 1 else None
