"""Clutter: the index threshold that keeps the rate of new tracks bounded (a detector of constant false-alarm rate).

    new tracks of a hop ────────────┐ +1 each
                                    ▼
    tracks whose bit rate is known ─► level, which leaks at new_tracks_per_s ─► index_threshold × 2^(what is beyond the
      now: those were no clutter      -1 each                                                        allowance / 4)

A camera that moves over texture, or that sees enough events for every pixel to have some of both polarities, has hundreds of
blobs a hop at a threshold that is right for a quiet view: every one costs, and beacons wait behind them for their turn.  A
beacon among them that is to be read is far above them.  So every new track beyond an allowance raises the threshold, and it
falls again by itself.  A track whose bit rate becomes known was no clutter, and is taken back: a hundred beacons may come at
once.  In the long run there are no more tracks that nobody can read than the level leaks, whatever the view is.  As long as
there are no more than ``new_tracks_burst`` at once, and no more than the leak later, the threshold is ``index_threshold``.
"""

from __future__ import annotations

import math

from beacon_comm.core.events import NS_PER_S
from beacon_comm.core.parameters import Parameters

DOUBLING = 4  # so many new tracks beyond the allowance double the threshold …
MOST_DOUBLINGS = 5  # … and so often at most
CROWD = 16  # where so many more began than have leaked away, what begins is tentative


class Clutter:
    """Sets the index threshold by the tracks that begin.

    Args:
        parameters: ``index_threshold``, ``new_tracks_burst``, ``new_tracks_per_s``.

    Attributes:
        threshold: what the index of a blob must reach now.
    """

    def __init__(self, parameters: Parameters) -> None:
        self._least = parameters.index_threshold
        self._allowed = parameters.new_tracks_burst
        self._leak_per_ns = parameters.new_tracks_per_s / NS_PER_S
        self._level = 0.0
        self._t_ns = 0
        self.threshold = self._least

    @property
    def most_new(self) -> int:
        """How many tracks may begin at the next hop: what is left of the allowance, and as many as double the threshold."""
        return max(0, math.ceil(self._allowed - self._level)) + DOUBLING

    @property
    def crowded(self) -> bool:
        """Whether many tracks began lately."""
        return self._level > CROWD

    def count(self, new_tracks: int, read_tracks: int, t_hop_ns: int) -> None:
        """Hear of the tracks that began, and whose bit rate is known now, at the hop that ends at ``t_hop_ns`` (ns)."""
        leaked = self._leak_per_ns * max(0, t_hop_ns - self._t_ns)
        most = self._allowed + DOUBLING * MOST_DOUBLINGS
        self._level = min(max(0.0, self._level - leaked - read_tracks) + new_tracks, most)
        self._t_ns = t_hop_ns
        beyond = math.floor(max(0.0, self._level - self._allowed))
        self.threshold = self._least * 2.0 ** (beyond / DOUBLING)
