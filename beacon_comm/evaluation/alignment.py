"""Where a known text was sent: sendings of the truth found in a stream of decoded characters.

A *sending* is a line in the plane of time and truth position:

    t(k) = start + k · T        truth character k is due at t(k), T = 11 / f

    t ▲          /        /     two sendings, a gap between them;
      │  tail   /        /      the recording began in the middle
      │        /        /       of the first
      └───────/────────/────► k  0 … n-1, 0 … n-1

1. Every pair of a decoded and a truth character of the same code votes for a start, for each of a grid of rates so
   close that no rate lies between two of them (a Hough transform over start and rate).  Rates within 1000 ppm of
   the decoded one are tried first, and all within 2 % if those show nothing.
2. The best votes are refined: a line is fitted through the right characters, outliers dropped, from the middle out.
3. *Evidence*: the log likelihood ratio of "these characters follow the line, a share of them right" against "these
   characters are drawn at random, as often as each occurs in the stream".  It is reduced by the logarithm of the
   number of lines that were tried.  By Markov's inequality evidence y happens by chance with probability e^-y at most.
4. A sending claims its characters, and the rest is searched again.  The sendings together must carry evidence that
   occurs by chance in one of 1000 streams, or none counts.  (Short texts sent many times vouch for one another.)

Position decides, not order: dropped, inserted and wrong characters do not move the line.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

NARROW_RATES = 1e-3
WIDE_RATES = 0.02
# A decoded character belongs to a due time if it is nearer than this (characters).
MATCH_DISTANCE = 0.25
# Shares of right characters that the evidence is averaged over.
RIGHT_SHARES = (0.2, 0.6, 0.95)
# Log odds before any evidence that a stretch of the stream holds a sending.
PRIOR_NATS = -3.0
SENDING_NATS = 4.0
STREAM_NATS = math.log(1000.0)
# Decoded characters that vote together; more would only cost time.
LONGEST_WINDOW = 1500
SHORTEST_WINDOW = 256
# Best votes that are looked into, and how many of them in vain before a window is given up.
CANDIDATES = 24
IN_VAIN = 8
REFINING_TURNS = 18
_NOWHERE = np.empty(0, np.int64)

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class Sending:
    """One sending of the truth, or a part of one.

    Attributes:
        start_ns: when truth character 0 is, or would have been, due (ns, sensor clock).
        period_ns: character period T (ns).
        first, last: truth characters of the outermost decoded characters that vouch for it.
        evidence: nats against chance; see the module's head.
    """

    start_ns: float
    period_ns: float
    first: int
    last: int
    evidence: float

    def due_ns(self, k: float) -> float:
        """Return when truth character ``k`` is due (ns)."""
        return self.start_ns + k * self.period_ns


@dataclass(frozen=True, slots=True)
class _Line:
    start: float
    period: float


class _Stream:
    """Decoded characters, times in nominal character periods from the first one, and what is known of chance."""

    def __init__(self, t: Floats, codes: Ints, truth: Ints) -> None:
        self.t = t
        self.codes = codes
        self.truth = truth
        self.free = np.ones(len(t), bool)
        size = max(128, int(max(codes.max(initial=0), truth.max())) + 1)
        counts = np.bincount(codes, minlength=size) + 0.5
        self.chance = counts / counts.sum()  # of each code
        self.truth_chance = self.chance[truth]
        self.by_code = {int(code): np.flatnonzero(truth == code) for code in np.unique(truth)}

    def near(self, line: _Line, distance: float = MATCH_DISTANCE) -> tuple[Ints, Ints]:
        """Return the free characters near a due time of the line, and the truth characters due there."""
        last = line.start + (len(self.truth) - 0.5) * line.period
        a, b = np.searchsorted(self.t, (line.start - 0.5 * line.period, last))
        rows = a + np.flatnonzero(self.free[a:b])
        position = (self.t[rows] - line.start) / line.period
        k = np.rint(position).astype(np.int64)
        fits = (np.abs(position - k) < distance) & (k >= 0) & (k < len(self.truth))
        return rows[fits], k[fits]


def find_sendings(
    t_ns: Ints, codes: Ints, truth: Ints, bit_rate_bps: float, frame_bits: int = 11
) -> tuple[Sending, ...]:
    """Find the sendings of ``truth`` in decoded characters.

    Args:
        t_ns: times of the start bits' leading edges (ns), in order, ``(m,)`` int64.
        codes: decoded codes, ``(m,)`` int64.
        truth: codes that were sent, ``(n,)`` int64.
        bit_rate_bps: rate at which they were decoded (bit/s); the sent one is taken to lie within 2 %.
        frame_bits: bits of a character frame.

    Returns:
        Sendings in order of time; none if chance explains what looks like one.
    """
    if not len(t_ns) or not len(truth):
        return ()
    period_ns = frame_bits * 1e9 / bit_rate_bps
    t0 = int(t_ns[0])
    order = np.argsort(t_ns, kind='stable')
    for tolerance in (NARROW_RATES, WIDE_RATES):
        stream = _Stream((t_ns[order] - t0) / period_ns, codes[order], truth)
        found = _search(stream, tolerance)
        nats = sum(float(np.logaddexp(math.log1p(-math.exp(PRIOR_NATS)), PRIOR_NATS + y)) for _, _, _, y in found)
        if nats >= STREAM_NATS:
            sendings = [
                Sending(t0 + line.start * period_ns, line.period * period_ns, first, last, y)
                for line, first, last, y in found
            ]
            return tuple(sorted(sendings, key=lambda sending: sending.due_ns(sending.first)))
    return ()


def _search(stream: _Stream, tolerance: float) -> list[tuple[_Line, int, int, float]]:
    """Claim sending after sending, window by window; each window's overlap holds a whole sending."""
    n = len(stream.truth)
    window = float(min(max(2.2 * n, SHORTEST_WINDOW), LONGEST_WINDOW))
    step = max(window - 1.1 * n, window / 2.0)
    found: list[tuple[_Line, int, int, float]] = []
    begin = 0.0
    while begin <= stream.t[-1]:
        while True:
            claimed = _claim(stream, begin, begin + window, tolerance)
            if not claimed:
                break
            found += claimed
        begin += step
    return found


def _claim(stream: _Stream, begin: float, end: float, tolerance: float) -> list[tuple[_Line, int, int, float]]:
    """Take the window's best lines that carry enough evidence; their characters are free no more."""
    lines, tried = _votes(stream, begin, end, tolerance)
    claimed: list[tuple[_Line, int, int, float]] = []
    for tries, line in enumerate(lines):
        line = _refine(stream, line)
        first, last, nats = _evidence(stream, line)
        nats -= math.log(tried)
        if nats < SENDING_NATS:
            if claimed or tries >= IN_VAIN:
                break  # where some were claimed, they have overtaken the rest: vote again
            continue
        claimed.append((line, first, last, nats))
        a, b = np.searchsorted(stream.t, line.start + line.period * np.array((first - 0.5, last + 0.5)))
        stream.free[a:b] = False
    return claimed


def _votes(stream: _Stream, begin: float, end: float, tolerance: float) -> tuple[list[_Line], int]:
    """Return the lines that most pairs of equal codes vote for, and how many lines were tried."""
    a, b = np.searchsorted(stream.t, (begin, end))
    rows = a + np.flatnonzero(stream.free[a:b])
    positions = [stream.by_code.get(int(code), _NOWHERE) for code in stream.codes[rows]]
    if not any(len(ks) for ks in positions):
        return [], 1
    k = np.concatenate(positions).astype(np.float64)
    t = np.repeat(stream.t[rows], [len(ks) for ks in positions])
    n = len(stream.truth)
    weight = np.log(0.6 / stream.chance[stream.truth[k.astype(np.int64)]]) + 0.9
    span = min(n, max(end - begin, 1.0))
    steps = math.ceil(tolerance * span / MATCH_DISTANCE)
    lowest = float(t.min()) - n * (1.0 + WIDE_RATES)
    bins = int((float(t.max()) - lowest) * 4) + 3
    free_t = stream.t[rows]
    scored: list[tuple[float, _Line]] = []
    for period in 1.0 + tolerance * np.linspace(-1.0, 1.0, 2 * steps + 1):
        votes = np.bincount(((t - k * period - lowest) * 4).astype(np.int64), weight, bins)
        votes = votes[:-1] + votes[1:]  # half a character wide, every quarter
        starts = lowest + 0.25 * (np.arange(bins - 1) + 1)
        best = np.argpartition(votes, -min(CANDIDATES, len(votes)))[-CANDIDATES:]
        held = np.searchsorted(free_t, starts[best] + (n - 0.5) * period) - np.searchsorted(free_t, starts[best] - 0.5)
        scored += [
            (float(vote), _Line(float(start), float(period)))
            for vote, start in zip(votes[best] - 0.9 * held, starts[best], strict=True)
        ]
    scored.sort(key=lambda entry: -entry[0])
    kept: list[_Line] = []
    for _, line in scored:
        if all(abs(line.start - other.start) > 1.0 + n * abs(line.period - other.period) for other in kept):
            kept.append(line)
            if len(kept) == CANDIDATES:
                break
    return kept, max(1, 4 * n * (2 * steps + 1))


def _refine(stream: _Stream, line: _Line) -> _Line:
    """Fit the line to the right characters near it, from the stretch that fits best outwards."""
    n = len(stream.truth)
    middle = reach = -1.0
    for turn in range(REFINING_TURNS):
        rows, k = stream.near(line, 0.375 if turn < 3 else MATCH_DISTANCE)
        right = stream.codes[rows] == stream.truth[k]
        if not right.any():
            return line
        if reach < 0.0:
            a, b, _ = _best_stretch(np.where(right, 2.0, -1.0))
            middle = (k[a] + k[b - 1]) / 2.0
            reach = max(float(k[b - 1] - k[a]), 8.0) / 2.0
        inside = right & (np.abs(k - middle) <= reach)
        if inside.sum() < 2:
            inside = right
        before, line = line, _fit(stream.t[rows[inside]], k[inside].astype(np.float64), line)
        moved = abs(line.start - before.start) + n * abs(line.period - before.period)
        if turn >= 3 and reach > n and moved < 1e-3:
            break
        reach *= 1.5
    return line


def _fit(t: Floats, k: Floats, line: _Line) -> _Line:
    """Return the least-squares line without outliers; the rate stays where there is too little to tell it."""
    keep = np.ones(len(t), bool)
    for _ in range(3):
        period = line.period
        if keep.sum() >= 4 and np.ptp(k[keep]) >= 4:
            arm = k[keep] - k[keep].mean()
            period = min(max(float(arm @ t[keep] / (arm @ arm)), 1.0 - WIDE_RATES), 1.0 + WIDE_RATES)
        line = _Line(float(np.median(t[keep] - k[keep] * period)), period)
        residual = np.abs(t - line.start - k * period)
        keep = residual <= max(3.0 * float(np.median(residual[keep])), 0.02)
    return line


def _evidence(stream: _Stream, line: _Line) -> tuple[int, int, float]:
    """Return the first and last truth character that vouch for the line, and the evidence (nats)."""
    rows, k = stream.near(line)
    if not len(rows):
        return 0, 0, -math.inf
    right = stream.codes[rows] == stream.truth[k]
    chance = stream.truth_chance[k]
    best = (0, 0, -math.inf)
    ratios = []
    for share in RIGHT_SHARES:
        gain = np.where(right, np.log(share / chance), np.log((1.0 - share) / (1.0 - chance)))
        a, b, nats = _best_stretch(gain)
        # Any stretch of the line may be the sending: one of n beginnings more to choose from.
        ratios.append(max(float(gain.sum()), nats - math.log(len(gain))))
        if nats > best[2]:
            best = (a, b, nats)
    mixed = float(np.logaddexp.reduce(ratios)) - math.log(len(ratios))
    a, b = best[0], best[1]
    vouching = np.flatnonzero(right[a:b])
    if not len(vouching):
        return 0, 0, -math.inf
    return int(k[a + vouching[0]]), int(k[a + vouching[-1]]), mixed


def _best_stretch(gain: Floats) -> tuple[int, int, float]:
    """Return ``(a, b, sum)`` of the stretch ``a:b`` with the largest sum."""
    total = np.concatenate(([0.0], np.cumsum(gain)))
    rise = total - np.minimum.accumulate(total)
    b = int(np.argmax(rise))
    a = int(np.argmin(total[: b + 1]))
    return a, b, float(rise[b])
