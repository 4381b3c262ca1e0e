"""How a track moves: Kalman filters of constant velocity side by side, an interacting multiple model (IMM).

    mode          0       1        2        3         4
    white         10    5·10³    4·10⁵    2·10⁷     2·10¹⁰    acceleration (px²/s³): from uniform motion over turns and
                                                              a shaken camera to a bounce within a millisecond

Each update mixes the modes by their transition probabilities in the time since the last one, predicts and corrects every
mode, and weighs them by how well each foresaw the observation (Blom and Bar-Shalom, 1988).  Both axes share one
variance; an observation is the mean residual of a few dozen events to the predicted path, each at its own time, so that
it lags behind nothing.  A prediction goes on at constant velocity for a moment and then fades:

    distance(dt) = v s(dt),   s = dt for dt <= 0.1 s,   0.1 s + 1 s (1 - exp(-(dt - 0.1 s) / 1 s)) after

A state is one row of float64, so that compiled loops work on the rows of all tracks:

    row   [ T | modes 5 × (x y vx vy pp pv vv) | weights 5 | combined x y vx vy pp pv vv q | sums, see SUMS … | extent, … ]
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from beacon_comm.core.tracks import fading_s as _fading_s

fading_s = njit(cache=True, nogil=True)(_fading_s)

MODES = 5
ACCELERATION = np.array([10.0, 5e3, 4e5, 2e7, 2e10])  # white acceleration (px²/s³)
LASTS_S = np.array([1e9, 0.5, 0.2, 0.1, 2e-3])  # a mode's acceleration goes on for so long
# Rate of going over from a mode (row) to another (column) (1/s).
RATE = np.array(
    [
        [0.0, 0.5, 0.1, 0.02, 0.1],
        [1.0, 0.0, 1.0, 0.1, 0.1],
        [0.5, 1.0, 0.0, 1.0, 0.1],
        [0.5, 0.5, 1.0, 0.0, 1.0],
        [100.0, 100.0, 200.0, 200.0, 0.0],
    ]
)
_AGAIN_GAIN = 0.01
_LIKELY = 0.02  # less likely modes are no part of a prediction's variance
FIRST_WEIGHT = np.array([0.4, 0.2, 0.2, 0.1, 0.1])

# Columns of a row.
T = 0  # time of the state since the hop (s)
_MODE = 1  # x, y, vx, vy, pp, pv, vv of each mode
_SIZE = 7
WEIGHT = _MODE + MODES * _SIZE
X, Y, VX, VY, PP, PV, VV, NOISE = range(WEIGHT + MODES, WEIGHT + MODES + 8)
# SUMS since the last update, first of the OFF, then of the ON events: number, residuals to the path (px), time (s); …
N_OFF, OFF_X, OFF_Y, OFF_T, N_ON, ON_X, ON_Y, ON_T = range(NOISE + 1, NOISE + 9)
# … and of all: squared residual (px²), and the time of the first one (s).
SUM_RR, SINCE = range(ON_T + 1, ON_T + 3)
# SUMS of the hop: OFF and ON events, squared residual, and the time of the last event (s).
HOP_OFF, HOP_ON, HOP_RR, LAST = range(SINCE + 1, SINCE + 5)
# ON and OFF events in windows that forget like the short and the long one.
SHORT_ON, SHORT_OFF, LONG_ON, LONG_OFF = range(LAST + 1, LAST + 5)
# Radius (px); whether the windows do not get its events; how many events a second are usual; how far ON and OFF events are from
# the middle of both, squared (px²), and how long ON events are ahead of it along the way (s); the variance of observations over
# what independent events have.
EXTENT, HIDDEN, USUAL, LEAD2, AHEAD, TRUST = range(LONG_OFF + 1, LONG_OFF + 7)
# The last observation's error over its standard deviation, and how much of it comes again in the next one.
ERROR_X, ERROR_Y, AGAIN = range(TRUST + 1, TRUST + 4)
# The last observation's residual (px) if it was doubted, else 0.
DOUBTED_X, DOUBTED_Y = range(AGAIN + 1, AGAIN + 3)
WIDTH = DOUBTED_Y + 1


@njit(cache=True, nogil=True)
def begin(row, t_s, x, y, vx, vy, variance, speed_variance):  # type: ignore[no-untyped-def]
    """Begin a state: time (s), centre (px), velocity (px/s), variances of an axis (px², px²/s²); the sums stay."""
    row[T] = t_s
    for j in range(MODES):
        at = _MODE + j * _SIZE
        row[at], row[at + 1], row[at + 2], row[at + 3] = x, y, vx, vy
        row[at + 4], row[at + 5], row[at + 6] = variance, 0.0, speed_variance
        row[WEIGHT + j] = FIRST_WEIGHT[j]
    row[N_OFF : SINCE + 1] = 0.0
    _combine(row)


@njit(cache=True, nogil=True)
def brake(row, kept):  # type: ignore[no-untyped-def]
    """Keep a share of the velocity."""
    for j in range(MODES):
        at = _MODE + j * _SIZE
        row[at + 2] *= kept
        row[at + 3] *= kept
    _combine(row)


@njit(cache=True, nogil=True)
def rebase(row, later_s):  # type: ignore[no-untyped-def]
    """Count times from a hop that is later (s)."""
    row[T] -= later_s
    row[LAST] -= later_s
    row[SINCE] -= later_s
    row[OFF_T] -= row[N_OFF] * later_s
    row[ON_T] -= row[N_ON] * later_s


@njit(cache=True, nogil=True)
def aim(rows, later_s, extent_px):  # type: ignore[no-untyped-def]
    """Begin a hop that is later (s) than what each row counts times from, ``(n,)``: sums at zero, and the radii (px)."""
    for k in range(len(rows)):
        rebase(rows[k], later_s[k])
        rows[k, HOP_OFF : HOP_RR + 1] = 0.0
        rows[k, EXTENT] = extent_px[k]


@njit(cache=True, nogil=True)
def variance_at(row, dt_s):  # type: ignore[no-untyped-def]
    """Return the variance of position (px²), one axis, ``dt_s`` after the state's time."""
    return row[PP] + dt_s * (2.0 * row[PV] + dt_s * (row[VV] + row[NOISE] * dt_s / 3.0))


@njit(cache=True, nogil=True)
def _mixture(row, least, total):  # type: ignore[no-untyped-def]
    """Return the mean, the variance of an axis with the spread of the means, and the white acceleration of the likely modes.

    ``least``: modes of no more weight are left out.  ``total``: weight of the others.
    """
    x = y = vx = vy = pp = pv = vv = noise = 0.0
    for j in range(MODES):
        w, at = row[WEIGHT + j], _MODE + j * _SIZE
        if w > least:
            x += w * row[at]
            y += w * row[at + 1]
            vx += w * row[at + 2]
            vy += w * row[at + 3]
    x, y, vx, vy = x / total, y / total, vx / total, vy / total
    for j in range(MODES):
        share, at = row[WEIGHT + j] / total, _MODE + j * _SIZE
        if row[WEIGHT + j] > _LIKELY:
            noise += share * ACCELERATION[j]
        if row[WEIGHT + j] > least:
            ex, ey, evx, evy = row[at] - x, row[at + 1] - y, row[at + 2] - vx, row[at + 3] - vy
            pp += share * (row[at + 4] + 0.5 * (ex * ex + ey * ey))
            pv += share * (row[at + 5] + 0.5 * (ex * evx + ey * evy))
            vv += share * (row[at + 6] + 0.5 * (evx * evx + evy * evy))
    return x, y, vx, vy, pp, pv, vv, noise


@njit(cache=True, nogil=True)
def likely_variance(row, dt_s):  # type: ignore[no-untyped-def]
    """Return the variance of position (px²), one axis, and what it grows by within ``dt_s``; of the likely modes alone.

    The rarer the mode, the wider: all of them together are a safe gate, but no fair statement of the error.
    """
    total = 0.0
    for j in range(MODES):
        if row[WEIGHT + j] > _LIKELY:
            total += row[WEIGHT + j]
    _, _, _, _, pp, pv, vv, noise = _mixture(row, _LIKELY, total)
    return pp, dt_s * (2.0 * pv + dt_s * (vv + noise * dt_s / 3.0))


@njit(cache=True, nogil=True)
def observe(row, t_s, dx, dy, variance):  # type: ignore[no-untyped-def]
    """Take an observation at ``t_s`` (s); return its squared error over the expected one, and the observation's part of that.

    ``dx``, ``dy``: its residual to the combined path (px).  ``variance``: of an axis (px²).
    """
    dt = max(0.0, t_s - row[T])
    s = fading_s(dt)
    zx, zy = row[X] + row[VX] * s + dx, row[Y] + row[VY] * s + dy
    old = row[_MODE : WEIGHT + MODES].copy()
    stay = np.empty(MODES)
    for i in range(MODES):
        out = 0.0
        for j in range(MODES):
            out += RATE[i, j]
        stay[i] = math.exp(-out * dt)
    weight, fit = np.empty(MODES), np.empty(MODES)
    best, error, part_of, heaviest, error_x, error_y = -np.inf, 1.0, 0.0, 0.0, 0.0, 0.0
    for j in range(MODES):
        total = 0.0
        part = np.empty(MODES)
        for i in range(MODES):
            out = 0.0
            for k in range(MODES):
                out += RATE[i, k]
            p = stay[i] if i == j else (1.0 - stay[i]) * RATE[i, j] / out
            part[i] = p * row[WEIGHT + i]
            total += part[i]
        weight[j] = total
        at = _MODE + j * _SIZE
        x = y = vx = vy = 0.0
        for i in range(MODES):
            w, o = part[i] / total, i * _SIZE
            x += w * old[o]
            y += w * old[o + 1]
            vx += w * old[o + 2]
            vy += w * old[o + 3]
        pp = pv = vv = 0.0
        for i in range(MODES):
            w, o = part[i] / total, i * _SIZE
            ex, ey, evx, evy = old[o] - x, old[o + 1] - y, old[o + 2] - vx, old[o + 3] - vy
            pp += w * (old[o + 4] + 0.5 * (ex * ex + ey * ey))
            pv += w * (old[o + 5] + 0.5 * (ex * evx + ey * evy))
            vv += w * (old[o + 6] + 0.5 * (evx * evx + evy * evy))
        q = ACCELERATION[j] * min(1.0, LASTS_S[j] / dt) if dt > 0.0 else 0.0
        x += vx * s
        y += vy * s
        pp += dt * (2.0 * pv + dt * (vv + q * dt / 3.0))
        pv += dt * (vv + q * dt / 2.0)
        vv += q * dt
        expected = pp + variance
        ex, ey = zx - x, zy - y
        fit[j] = -0.5 * (ex * ex + ey * ey) / expected - math.log(expected)
        best = max(best, fit[j])
        if old[WEIGHT - _MODE + j] >= heaviest:
            heaviest = old[WEIGHT - _MODE + j]
            error, part_of = 0.5 * (ex * ex + ey * ey) / expected, variance / expected
            scale = 1.0 / math.sqrt(expected * max(error, 1.0))
            error_x, error_y = ex * scale, ey * scale
        kp, kv = pp / expected, pv / expected
        row[at], row[at + 1] = x + kp * ex, y + kp * ey
        row[at + 2], row[at + 3] = vx + kv * ex, vy + kv * ey
        row[at + 4] = pp - kp * pp
        row[at + 5] = pv - kp * pv
        row[at + 6] = vv - kv * pv
    total = 0.0
    for j in range(MODES):
        weight[j] = max(weight[j] * math.exp(fit[j] - best), 1e-12)
        total += weight[j]
    for j in range(MODES):
        row[WEIGHT + j] = weight[j] / total
    row[AGAIN] += _AGAIN_GAIN * (0.5 * (error_x * row[ERROR_X] + error_y * row[ERROR_Y]) - row[AGAIN])
    row[ERROR_X], row[ERROR_Y] = error_x, error_y
    row[T] += dt
    _combine(row)
    return error, part_of


@njit(cache=True, nogil=True)
def _combine(row):  # type: ignore[no-untyped-def]
    """Sum the modes up."""
    row[X], row[Y], row[VX], row[VY], row[PP], row[PV], row[VV], row[NOISE] = _mixture(row, -1.0, 1.0)
