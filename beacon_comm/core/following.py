"""Following: every event to at most one track, and every few dozen events of a track tell where it is.

    hop    |-- step --|-- step --|-- step --| …  1 ms each: circles along the predicted paths, cells they may touch
    events   · ·· ····|· · ····· |·
    update        ^      ^   ^               every 48 events of a track: residual to its path ─► motion filter ─► new path

An event is of the nearest track whose circle holds it, both at the event's own time.  A quiet track, of which only a
prediction is left, gives way to one with events, and one that nobody can read to one whose bit rate is known: edges that
pass a beacon would push it away.  The circle grows by what is unknown:

    radius = extent × routing_extent_factor + routing_margin_px + 3 σ + 2 |v| (time since the last update), bounded

since something that turns back at a border is twice its speed away from where it was expected.

Where two tracks are so near one another that the events of one may be nearer to the other, an event moves both, each by
how likely it is its own, as the predicted distances say (expectation maximisation, Dempster et al., 1977): where the two
are one spot, both move as it does and their distance goes on as predicted.  Shared out to the nearer one alone, they would push
one another off instead of passing through one another, and leave with each other's label.

A light that moves while it is on gives ON events at its front and OFF events at its back.  So an observation is the middle
between the means of both, and a burst of one polarity waits for some events of the other, if that makes a difference: if ON
events are ahead, by what is learnt of each track as a time, from how far observations of more ON or more OFF events are off
along its way.  What is not waited for is put right by that.  Where two tracks share their events neither is done, and of what
is large, whose bursts are read out row by row, the means themselves tell how far apart they are.

The events of a track that moves by more than a share of its radius in a hop are hidden from the detection windows:
there they would be a trail of it, in which false tracks begin.

What is done depends on the events in their order alone: any batching gives the same.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numba import njit
from numpy.typing import NDArray

from beacon_comm.core import motion
from beacon_comm.core.events import NS_PER_S, EventBatch
from beacon_comm.core.hop_events import ROUTED, HopEvents, NearEvents
from beacon_comm.core.motion import (
    AHEAD,
    DOUBTED_X,
    DOUBTED_Y,
    EXTENT,
    HIDDEN,
    HOP_OFF,
    HOP_ON,
    HOP_RR,
    LAST,
    LEAD2,
    LONG_OFF,
    LONG_ON,
    N_OFF,
    N_ON,
    SINCE,
    SUM_RR,
    TRUST,
    USUAL,
    VX,
    VY,
    T,
    X,
    Y,
    fading_s,
    observe,
    variance_at,
)  # fmt: skip
from beacon_comm.core.motion_tracks import MotionTrack
from beacon_comm.core.nearest import cells_along, cells_with_members, list_cells
from beacon_comm.core.parameters import Parameters
from beacon_comm.core.routing import Router, cell_of, places
from beacon_comm.core.tracks import Track

STEPS = 10  # of a hop
_NO_STEP = np.iinfo(np.int64).min
UPDATE_EVENTS = 48  # so many events of a track are an observation
_FEWEST_EVENTS = 4  # at a hop's end so few are one
_FEWEST_USUAL = 0.5  # less than this share of the usual rate is the background's, or one edge of a light that moves …
_LEAST_SPAN_S = 1e-4  # … be it for so long or longer
# The variance of observations is learnt from their errors, within bounds: a burst's events are of all pixels alike, which
# says more than as many at random, and of one moment, which says less.
_TRUST_GAIN, _MOST_ERROR = 0.03, 5.0
_LEAST_TRUST, _MOST_TRUST = 0.4, 10.0
_SHARED = 2.0  # events that may be another track's tell so much less
_EITHER = 12  # so many of either polarity tell how far they are apart
_LEAD_GAIN = 0.05
_AHEAD_GAIN = 0.01  # how fast it is learnt how far ON events are ahead …
_AHEAD_SPEED = 100.0  # … of a light that moves by more than this (px/s)
_DOUBTED = 9.0  # an observation so much farther off than expected (squared), and than what turns back since the last one, …
_OFF_SHARE = 0.5  # … may be of the first rows of a burst alone: off by so much of the radius (standard deviation)
_BALANCE = 0.2  # where one polarity counts for so much more than the other one, it is a burst of it …
_SMALL_LEAD = 1.0  # … worth waiting for the other one where it is off by more than this, over the variance, …
_MOST_EVENTS = 4000  # … for no more than so many events …
_LONGEST_WAIT_S = 4e-3  # … and no longer than this
_SHORTEST_S = 1e-4  # a burst is read out row by row, its first events are of the upper rows: an observation is of no less …
_SHORTEST_PX = 6.0  # … and of as many times that as its radius is larger than this, for the more rows it has
_GROWTH_PX = 12.0  # a circle grows by no more than this
_SLACK_PX = 3.0  # a path may change by this within a step before the cells are listed again
_LEAST_SPREAD_PX2 = 0.1  # variance of the events of a single pixel, and more
_PRIOR_EVENTS = 16  # that the blob's own extent counts for in the variance of few events
_HIDDEN = np.uint32(0xFFFF_FFFF)  # code of an event that the windows do not get
# Columns of a path: centre (px) at the step's begin, velocity (px/s), radius squared (px²), box that is listed,
# radius.
_PX, _PY, _PVX, _PVY, _RR, _LEFT, _RIGHT, _TOP, _BOTTOM, _RADIUS = range(10)


class FollowingRouter(Router):
    """Routes the events of a hop interval and moves the tracks on with them."""

    def __init__(self, parameters: Parameters, sensor_size: tuple[int, int]) -> None:
        self._tracks: Sequence[MotionTrack] = ()
        self._state = np.empty((0, motion.WIDTH))
        self._step_ns = max(1, -(-round(parameters.hop_s * NS_PER_S) // STEPS))
        self._hidden = False
        self._settled = True
        self._listed = np.empty((2, 0), np.uint32)
        super().__init__(parameters, sensor_size)

    def aim(self, tracks: Sequence[Track], t_hop_ns: int) -> None:
        """Route by ``tracks`` in the hop interval that begins at ``t_hop_ns`` (ns)."""
        followed: list[MotionTrack] = [track for track in tracks if isinstance(track, MotionTrack)]
        self._tracks = followed
        self._place = places(tracks)
        self._t_hop_ns = t_hop_ns
        self._state = np.array([track.row for track in followed]).reshape(-1, motion.WIDTH)
        later_s = np.array([(t_hop_ns - track.origin_ns) / NS_PER_S for track in followed])
        motion.aim(self._state, later_s, np.array([track.extent_px for track in followed]))
        for track, row in zip(followed, self._state, strict=True):
            track.row, track.origin_ns = row, t_hop_ns
        self._path = np.zeros((len(followed), 10))
        self._rank = np.array([2 * (not track.quiet) + (track.bit_rate_bps is not None) for track in followed], np.int64)
        self._partner = np.full(len(followed), -1)
        self._step = np.full(1, _NO_STEP)
        self._hidden = bool((self._state[:, HIDDEN] > 0).any())
        self._first, self._member = np.empty(0, np.int64), np.empty(0, np.int32)
        self._near_count = np.zeros(1, np.int64)
        self._near_cells = np.full(cells_along(self._grid.width) * cells_along(self._grid.height), bool(followed), np.uint8)

    def _find_owners(self, segment: EventBatch, code: NDArray[np.uint32], count: NDArray[np.int64]) -> int:
        width, height = self._grid.width, self._grid.height
        more = len(self._code) - self._listed.shape[1]
        if more > 0:
            self._listed = np.concatenate((self._listed, np.empty((2, more), np.uint32)), axis=1)
        routed, self._first, self._member = _follow(
            segment.x, segment.y, segment.polarity, segment.t_ns, self._t_hop_ns, self._step_ns, self._step,
            self._state, self._path, self._rank, self._partner, self._first, self._member, width, height,
            self._factor, self._margin, self._index, self._owner, code, count,
            self._listed, self._near_count, self._near_cells,
        )  # fmt: skip
        self._settled = False
        return int(routed)

    def _keep(self, start: int, n: int) -> int:
        if not self._hidden:
            return n
        stop = start + n
        return int(_drop_hidden(self._code[start:stop], self._offset_ns[start:stop]))

    def close(self) -> HopEvents:
        """Return the events gathered in the hop interval, and begin the next one."""
        _close(self._state, self._partner, self._hop_ns / NS_PER_S)
        self._settled = False
        self.settle()
        return super().close()

    @property
    def near(self) -> NearEvents:
        """The events of the hop that lie near tracks; views that stay as they are until the next hop's are routed."""
        return NearEvents(self._listed[:, : self._near_count[0]], self._near_cells)

    def settle(self) -> None:
        """Tell the tracks what the events since the last hop say about them."""
        if self._settled:
            return
        self._settled = True
        for track, events in zip(self._tracks, (self._state[:, HOP_OFF] + self._state[:, HOP_ON]).tolist(), strict=True):
            if events:
                track.settle()


@njit(cache=True, nogil=True)
def _follow(  # type: ignore[no-untyped-def]
    x, y, polarity, t_ns, t_hop_ns, step_ns, step, state, path, rank, partner, first, member, width, height, factor, margin,
    index, owner, code, count, listed, near_count, near_cells,
):  # fmt: skip
    """List the events that are of a track, with their tracks; move the tracks on; return how many, and the cells' lists.

    ``listed``, ``near_count``, ``near_cells``: for :class:`NearEvents`.
    """
    across, down = cells_along(width), cells_along(height)
    step_s = step_ns * 1e-9
    has_path = cells_with_members(first)
    at = np.uint64(near_count[0])
    routed = np.int64(0)
    i = np.int64(0)
    while i < len(x):
        now = (t_ns[i] - t_hop_ns) // step_ns
        begin_s = now * step_s
        if now != step[0]:
            fits = step[0] != _NO_STEP
            step[0] = now
            for k in range(len(state)):
                _lay(state[k], path[k], begin_s, step_s, factor, margin)
                fits = fits and _is_in_box(path[k], step_s)
            _find_partners(path, rank, state, partner)
            if not fits:
                first, member = _list_paths(path, step_s, width, height, across, down)
                has_path = cells_with_members(first)
                near_cells &= has_path
        stop = i + np.searchsorted(t_ns[i:], t_hop_ns + (now + 1) * step_ns)
        base = routed
        near = np.uint64(base)  # unsigned, so that no place is taken to count from the end
        for one in range(i, stop):
            index[near] = one
            near += np.uint64(has_path[cell_of(x[one], y[one], across)])
        i = stop
        for j in range(np.uint64(base), near):
            e = np.uint64(index[j])
            listed[0, at], listed[1, at] = code[e], t_ns[e] - t_hop_ns
            at += np.uint64(1)
            cell = cell_of(x[e], y[e], across)
            t_s = (t_ns[e] - t_hop_ns) * 1e-9
            ex, ey, dt = np.float64(x[e]), np.float64(y[e]), t_s - begin_s
            nearest2, best, highest, best_x, best_y = np.inf, np.int64(-1), np.int64(-1), 0.0, 0.0
            for m in range(np.uint64(first[cell]), np.uint64(first[cell + np.uint64(1)])):
                one_of = np.int64(member[m])
                dx = ex - (path[one_of, _PX] + path[one_of, _PVX] * dt)
                dy = ey - (path[one_of, _PY] + path[one_of, _PVY] * dt)
                d2 = dx * dx + dy * dy
                above = rank[one_of] - highest
                if d2 <= path[one_of, _RR] and (above > 0 or (above == 0 and d2 < nearest2)):
                    nearest2, best, highest, best_x, best_y = d2, one_of, rank[one_of], dx, dy
            if best < 0:
                continue
            if state[best, HIDDEN] > 0:
                code[e] = _HIDDEN
                at -= np.uint64(1)
            else:
                code[e] |= np.uint32(ROUTED)
            index[routed] = e
            owner[routed] = best
            count[best] += 1
            routed += 1
            on = np.int64(polarity[e] > 0)
            state[best, HOP_OFF + on] += 1.0
            state[best, HOP_RR] += nearest2
            state[best, LAST] = t_s
            other = partner[best]
            fits = True
            if other >= 0:
                dx = ex - (path[other, _PX] + path[other, _PVX] * dt)
                dy = ey - (path[other, _PY] + path[other, _PVY] * dt)
                scale = 2.0 / min(state[best, EXTENT], state[other, EXTENT]) ** 2  # 1 / 2σ² of a disc, σ = R / 2
                theirs = 1.0 / (1.0 + math.exp(min(scale * (dx * dx + dy * dy - nearest2), 50.0)))
                _add(state, other, on, theirs, dx, dy, t_s)
                _add(state, best, on, 1.0 - theirs, best_x, best_y, t_s)
                if state[other, N_OFF] + state[other, N_ON] >= UPDATE_EVENTS and _update(state[other], _SHARED, False):
                    _lay(state[other], path[other], begin_s, step_s, factor, margin)
                    fits = _is_in_box(path[other], step_s)
            else:
                _add(state, best, on, 1.0, best_x, best_y, t_s)
            many = state[best, N_OFF] + state[best, N_ON] >= UPDATE_EVENTS
            if many and _update(state[best], _SHARED if other >= 0 else 1.0, False):
                _lay(state[best], path[best], begin_s, step_s, factor, margin)
                fits &= _is_in_box(path[best], step_s)
            if not fits:
                first, member = _list_paths(path, step_s, width, height, across, down)
                has_path = cells_with_members(first)
                near_cells &= has_path
                i = np.int64(e) + 1  # what is near is another question now
                break
    near_count[0] = at
    return routed, first, member


@njit(cache=True, nogil=True)
def _list_paths(path, step_s, width, height, across, down):  # type: ignore[no-untyped-def]
    """List anew which paths may touch each cell."""
    for k in range(len(path)):
        _box(path[k], step_s)
    return list_cells(path[:, _LEFT : _BOTTOM + 1], width, height, across, down)


@njit(cache=True, nogil=True)
def _lay(row, path, begin_s, step_s, factor, margin):  # type: ignore[no-untyped-def]
    """Lay a track's path through a step that begins at ``begin_s`` (s)."""
    here, there = fading_s(begin_s - row[T]), fading_s(begin_s + step_s - row[T])
    share = (there - here) / step_s
    path[_PX], path[_PY] = row[X] + row[VX] * here, row[Y] + row[VY] * here
    path[_PVX], path[_PVY] = row[VX] * share, row[VY] * share
    unseen_s = max(0.0, begin_s + 0.5 * step_s - row[T])
    speed = np.hypot(row[VX], row[VY])
    growth = 3.0 * np.sqrt(max(0.0, variance_at(row, unseen_s))) + 2.0 * speed * unseen_s
    radius = row[EXTENT] * factor + margin + min(growth, _GROWTH_PX)
    path[_RADIUS] = radius
    path[_RR] = radius * radius


@njit(cache=True, nogil=True)
def _box(path, step_s):  # type: ignore[no-untyped-def]
    radius = path[_RADIUS] + _SLACK_PX
    dx, dy = 2.0 * path[_PVX] * step_s, 2.0 * path[_PVY] * step_s
    path[_LEFT], path[_RIGHT] = path[_PX] + min(dx, 0.0) - radius, path[_PX] + max(dx, 0.0) + radius
    path[_TOP], path[_BOTTOM] = path[_PY] + min(dy, 0.0) - radius, path[_PY] + max(dy, 0.0) + radius


@njit(cache=True, nogil=True)
def _is_in_box(path, step_s):  # type: ignore[no-untyped-def]
    radius = path[_RADIUS]
    dx, dy = path[_PVX] * step_s, path[_PVY] * step_s
    return (
        path[_PX] + min(dx, 0.0) - radius >= path[_LEFT]
        and path[_PX] + max(dx, 0.0) + radius <= path[_RIGHT]
        and path[_PY] + min(dy, 0.0) - radius >= path[_TOP]
        and path[_PY] + max(dy, 0.0) + radius <= path[_BOTTOM]
    )


@njit(cache=True, nogil=True)
def _find_partners(path, rank, state, partner):  # type: ignore[no-untyped-def]
    """Find for each track the nearest one of its rank whose events may be nearer to it, -1: none."""
    m = len(path)
    nearest2 = np.full(m, np.inf)
    partner[:] = -1
    for a in range(m):
        for b in range(a + 1, m):
            if rank[a] != rank[b]:
                continue
            dx, dy = path[a, _PX] - path[b, _PX], path[a, _PY] - path[b, _PY]
            reach = 2.0 * min(state[a, EXTENT], state[b, EXTENT]) + 1.0
            d2 = dx * dx + dy * dy
            if d2 < reach * reach:
                if d2 < nearest2[a]:
                    partner[a], nearest2[a] = b, d2
                if d2 < nearest2[b]:
                    partner[b], nearest2[b] = a, d2


@njit(cache=True, nogil=True)
def _add(state, k, on, weight, dx, dy, t_s):  # type: ignore[no-untyped-def]
    """Add an event, or a share of one, to the sums of track ``k``."""
    if state[k, N_OFF] + state[k, N_ON] == 0.0:
        state[k, SINCE] = t_s
    own = N_OFF + 4 * on
    state[k, own] += weight
    state[k, own + 1] += weight * dx
    state[k, own + 2] += weight * dy
    state[k, own + 3] += weight * t_s
    state[k, SUM_RR] += weight * (dx * dx + dy * dy)


@njit(cache=True, nogil=True)
def _update(row, doubt, at_once):  # type: ignore[no-untyped-def]
    """Let a track take its sums as an observation; return whether it did.

    ``doubt``: factor of the variance.  ``at_once``: do not wait for the other polarity.
    """
    sums = row[N_OFF : SUM_RR + 1]
    off, on = sums[0], sums[4]
    n = off + on
    age_s = row[LAST] - row[SINCE]
    shortest_s = _SHORTEST_S * max(1.0, row[EXTENT] / _SHORTEST_PX)
    if age_s < shortest_s and n < _MOST_EVENTS and not at_once:
        return False
    if n < _FEWEST_USUAL * row[USUAL] * max(age_s, _LEAST_SPAN_S):  # a few of the background's, while it is dark
        if at_once or n >= 2 * UPDATE_EVENTS or age_s > _LONGEST_WAIT_S:
            row[N_OFF : SINCE + 1] = 0.0
        return False
    usual_on = (row[LONG_ON] + 1.0) / (row[LONG_ON] + row[LONG_OFF] + 2.0)
    b, a = 0.5 / usual_on, 0.5 / (1.0 - usual_on)  # either polarity counts for as much as the other one, in the long run
    weight = a * off + b * on
    dx, dy = (a * sums[1] + b * sums[5]) / weight, (a * sums[2] + b * sums[6]) / weight
    dt = (a * sums[3] + b * sums[7]) / weight
    spread = 0.5 * max(sums[8] - n * (dx * dx + dy * dy), 0.0)
    spread = max((spread + _PRIOR_EVENTS * 0.25 * row[EXTENT] ** 2) / (n + _PRIOR_EVENTS), _LEAST_SPREAD_PX2)
    few = (a * a * off + b * b * on) / (weight * weight)  # 1/n where all count alike
    variance = (row[TRUST] if n >= UPDATE_EVENTS else 1.0) * spread * few
    if min(off, on) >= _EITHER:
        lead_x, lead_y = 0.5 * (sums[5] / on - sums[1] / off), 0.5 * (sums[6] / on - sums[2] / off)
        lead2 = lead_x * lead_x + lead_y * lead_y - 0.5 * spread * (1.0 / off + 1.0 / on)
        row[LEAD2] += _LEAD_GAIN * (max(lead2, 0.0) - row[LEAD2])
    side = (b * on - a * off) / weight  # 1: ON events alone, -1: OFF events
    large = row[EXTENT] > _SHORTEST_PX
    ahead_s = side * row[AHEAD] if doubt == 1.0 and not large else 0.0
    vx, vy = row[VX], row[VY]
    speed2 = vx * vx + vy * vy
    lead2 = row[LEAD2] * side * side if large else ahead_s * ahead_s * speed2
    one_sided = lead2 > _SMALL_LEAD * variance and abs(side) > _BALANCE
    if one_sided and n < _MOST_EVENTS and age_s < _LONGEST_WAIT_S and not at_once:
        return False
    variance += 0.5 * lead2
    row[N_OFF : SINCE + 1] = 0.0
    dx, dy = dx - ahead_s * vx, dy - ahead_s * vy
    variance = _doubted(row, dt, dx, dy, variance)
    error, part = observe(row, dt, dx, dy, variance * doubt)
    if doubt == 1.0:
        learnt_s = row[AHEAD] + _AHEAD_GAIN * side * (dx * vx + dy * vy) / (speed2 + _AHEAD_SPEED * _AHEAD_SPEED)
        row[AHEAD] = min(max(learnt_s, 0.0), row[EXTENT] / (math.sqrt(speed2) + _AHEAD_SPEED))
        trust = row[TRUST] * math.exp(_TRUST_GAIN * part * (min(error, _MOST_ERROR) - 1.0))
        row[TRUST] = min(max(trust, _LEAST_TRUST), _MOST_TRUST)
    return True


@njit(cache=True, nogil=True)
def _doubted(row, t_s, dx, dy, variance):  # type: ignore[no-untyped-def]
    """Return the variance of an observation: greater for the first one that is far off.

    What turns back is off again and again; the rows of a burst that are read out first are off for once, and the velocity
    would jump.
    """
    since_s = max(0.0, t_s - row[T])
    error = 0.5 * (dx * dx + dy * dy) / (variance_at(row, since_s) + variance)
    again = row[DOUBTED_X] * dx + row[DOUBTED_Y] * dy > 0.0
    row[DOUBTED_X] = row[DOUBTED_Y] = 0.0
    if error <= _DOUBTED or np.hypot(dx, dy) <= 2.0 * np.hypot(row[VX], row[VY]) * since_s:
        return variance
    row[DOUBTED_X], row[DOUBTED_Y] = dx, dy
    return variance if again else variance + (_OFF_SHARE * row[EXTENT]) ** 2


@njit(cache=True, nogil=True)
def _close(state, partner, hop_s):  # type: ignore[no-untyped-def]
    """Take what is left of the hop's events of tracks that have few."""
    for k in range(len(state)):
        if state[k, N_OFF] + state[k, N_ON] >= _FEWEST_EVENTS and state[k, USUAL] * hop_s < 2 * UPDATE_EVENTS:
            _update(state[k], _SHARED if partner[k] >= 0 else 1.0, True)


@njit(cache=True, nogil=True)
def _drop_hidden(code, offset_ns):  # type: ignore[no-untyped-def]
    """Close up the events that are not hidden; return how many."""
    kept = 0
    for i in range(len(code)):
        if code[i] != _HIDDEN:
            code[kept], offset_ns[kept] = code[i], offset_ns[i]
            kept += 1
    return kept
