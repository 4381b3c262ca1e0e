"""Acquisition: is there a beacon of about this bit rate in these events, and if so, where do its bits lie?

For a period T near the expected one, over a window of some characters::

    1. eye       Σ over bits |ON − OFF| at 16 phases; the phase is the middle of the interval where the eye is within
                 95 % of its best: it falls off a cliff on the late side
    2. slicer    bit = more ON or more OFF; few events: as the bit before
    3. learning  histograms from the bits, bits from the histograms: free, then under the frame
    4. verdict   how many words of the framed path are also what the free bits say: those could have failed, as the
                 histograms behind the free bits have not seen the frame

The eye chooses among the periods around the expected one; the edges of the window then fit period and latencies.
The LED may also be on for 0: the frame is looked for in the bits and in their complement.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from beacon_comm.core.bit_clock import EDGE_RUN, BitClock, make_clock
from beacon_comm.core.likelihood import CONTEXTS, COUNTS, LEVELS, SUB_SLOTS, learn, logarithms, weigh
from beacon_comm.core.sequence_detection import SILENT_SHARE, Detection, make_detection
from beacon_comm.core.trellis import Transitions, framed_path, free_bits, place_margin

PHASES = 16
"""Phases of a bit at which the eye is measured."""

EYE_SHARE = 0.95
"""The eye is open where it is within this share of its best."""

REFERENCE_EVENTS = 100.0
"""Counts of signals with more events a bit are divided down to so many."""

FREE_ROUNDS, FRAMED_ROUNDS = 2, 2
"""Rounds of learning without the frame, then with it."""

SLICER_SHARE = 0.1
"""A bit whose ON and OFF events differ by less than this share of a mean bit's events is held."""

CLEAR_FAILING, CLEAR_MARGIN = 0.15, 18.0
"""A lock is clear with at most so many failing words for each that passes, and a place in the frame so much more likely
(nat) than any other: a few letters may fit two places, and other rates fit by chance …"""

LONG_WORDS, LONG_FAILING, LONG_MARGIN = 12, 0.5, 35.0
"""… or with so many passing words, where more of them may fail (a weak signal), but none other is nearly as likely."""

FULL_WORDS, FULL_SHARE = 8, 0.6
"""So many words that pass over so much of a window leave no room for another rate."""

PLACE_MARGIN = 6.0
"""The frame's place among the bits must be so much more likely (nat) than any other: a few letters may fit two places."""

OVERSAMPLED_SHARE = 0.9
"""If so many changes of level lie on every second bit, or on every third, the bits are longer than was thought."""

LEAST_CHANGES = 3.0
"""Words with fewer changes of level than this, in the mean, may be one character of a slower signal."""


class Verdict(NamedTuple):
    """What a window reads like.

    Attributes:
        passing: words that the free bits confirm.
        failing: other words, and noise in units of words.
        idle: bits of idle line.
        covered: bits of passing words.
        changes: of level in a passing word, mean.
        bits: bits of the window.
        likelihood: of the framed path (nat).
        place_margin: see :func:`beacon_comm.core.trellis.place_margin`, of a bit in the middle of the window (nat).
        oversampled: the greatest share of the changes of level that lie on every second or every third bit.
        spread: of the edges about the bit grid, standard deviation (bit).
    """

    passing: int
    failing: float
    idle: int
    covered: int
    changes: float
    bits: int
    likelihood: float
    place_margin: float
    oversampled: float
    spread: float

    @property
    def share(self) -> float:
        """Share of the window that passing words cover."""
        return self.covered / self.bits

    @property
    def merit(self) -> float:
        """Share of the window that speaks for the lock, less what speaks against it."""
        return (self.covered - self.failing * self.covered / max(self.passing, 1)) / self.bits

    @property
    def convinces(self) -> bool:
        """Whether this can hardly be chance, another rate, or another place in the frame."""
        clear = self.failing <= CLEAR_FAILING * self.passing and self.place_margin >= CLEAR_MARGIN
        long = (
            self.passing >= LONG_WORDS
            and self.failing <= LONG_FAILING * self.passing
            and self.place_margin >= LONG_MARGIN
        )
        return (clear or long) and self.oversampled <= OVERSAMPLED_SHARE

    @property
    def full(self) -> bool:
        """Whether the words leave no room for another rate."""
        return self.passing >= FULL_WORDS and self.share >= FULL_SHARE and self.changes >= LEAST_CHANGES


@dataclass(frozen=True, slots=True)
class Lock:
    """A beacon found: everything the locked receiver starts from.

    Attributes:
        clock: at the window's first bit.
        detection: with what was learnt.
        inverted: the LED is on for 0.
        verdict: see :class:`Verdict`.
        period: of a bit (ns).
        positions: place in the frame of each bit of the window, ``(bits,)``; ``length`` and above: none.
    """

    clock: BitClock
    detection: Detection
    inverted: bool
    verdict: Verdict
    period: float
    positions: NDArray[np.int32]


def acquire(
    t: NDArray[np.float64],
    polarity: NDArray[np.int8],
    periods: NDArray[np.float64],
    transitions: Transitions,
    compression: NDArray[np.uint8],
    needed: int,
    tried: int,
    most_spread: float = 1.0,
    trusted_share: float = 2.0,
) -> Lock | None:
    """Look for a beacon in a window of events.

    Args:
        t: event times (ns from an origin), ``(n,)`` float64, non-decreasing.
        polarity: ±1, ``(n,)`` int8.
        periods: periods (ns) to look at, ``(k,)``; the spacing finer than a quarter bit over the window.
        transitions: framed trellis.
        compression: table of compressed counts.
        needed: words that have to pass.
        tried: so many of the periods are read, those with the widest eye.
        most_spread: standard deviation of the edges about the bit grid (bit) up to which a lock is believed; evenly
            spread edges, of another rate, have 0.29.
        trusted_share: share of the window covered by passing words, no fewer than 8, from which on the edges do not matter:
            background events hide them.
    """
    if len(t) < EDGE_RUN * needed:
        return None
    start, stop = t[0], t[-1]
    eyes = _eyes(t, polarity, start, periods, stop)
    found: Lock | None = None
    for k in np.argsort(-eyes, kind='stable')[:tried]:
        lock = _read(t, polarity, start, stop, float(periods[k]), transitions, compression, needed)
        if lock is None or lock.verdict.passing < needed or not lock.verdict.convinces:
            continue
        trusted = lock.verdict.share >= trusted_share and lock.verdict.passing >= FULL_WORDS
        if lock.verdict.spread > most_spread and not trusted:
            continue
        if found is None or _merit(lock.verdict) > _merit(found.verdict):
            found = lock
    return found


def _merit(verdict: Verdict) -> tuple[float, float]:
    return verdict.passing - 2.0 * verdict.failing, verdict.likelihood / verdict.bits


def _read(
    t: NDArray[np.float64],
    polarity: NDArray[np.int8],
    start: float,
    stop: float,
    period: float,
    transitions: Transitions,
    compression: NDArray[np.uint8],
    needed: int,
) -> Lock | None:
    fit = np.zeros(5)
    for _ in range(2):
        _fit_edges(t, polarity, start, period, fit)
        period *= 1.0 + fit[0]
    border = start + (_phase(_eye(_fine(t, polarity, start, period, stop))) - 1.0) * period
    bits = int((stop - border) / period) + 1
    raw = _counts(t, polarity, border, period, bits)
    gain = max(1.0, raw.sum() / bits / REFERENCE_EVENTS)
    counts = compression[np.minimum((raw / gain + 0.5).astype(np.int64), len(compression) - 1)]
    likelihoods, free = _learn_free(raw, counts)
    path, likelihood = framed_path(transitions, likelihoods)
    other_path, other_likelihood = framed_path(transitions, likelihoods[:, ::-1].copy())
    inverted = other_likelihood > likelihood
    if inverted:
        path, likelihood, free = other_path, other_likelihood, free ^ 1
    if _judge(path, free, transitions.length)[0] < needed:
        return None
    histograms, likelihoods, path = _learn_framed(counts, path, transitions, inverted)
    passing, failing, idle, changes = _judge(path, free, transitions.length)
    covered = passing * transitions.length
    framed = np.flatnonzero(path // (2 * CONTEXTS) < transitions.length)
    middle = int(framed[len(framed) // 2]) if len(framed) else 0
    margin = place_margin(transitions, likelihoods, middle)
    verdict = Verdict(
        passing, failing, idle, covered, changes / max(passing, 1), bits, likelihood, margin, _oversampled(free), float(fit[3])
    )
    if inverted:
        histograms = np.concatenate((histograms[::-1, SUB_SLOTS:], histograms[::-1, :SUB_SLOTS]), axis=1)
    means = _means(raw / gain, path)
    silence = float(np.mean(raw.sum(axis=1)[framed] < SILENT_SHARE * gain * means.mean())) if len(framed) else 1.0
    # Latencies of the edges behind the borders, of which the fold knows only the fraction of a bit.
    latency = [((fit[k] - (border - start) / period + 0.3) % 1.0 - 0.3) * period for k in (1, 2)]
    if inverted:
        latency.reverse()
    clock = make_clock(border, period, (latency[0], latency[1]), fit[3], max(fit[4], 1e-5))
    usual = likelihood / bits
    detection = make_detection(
        histograms, means, gain, silence, usual, verdict.passing, compression, transitions.states
    )
    return Lock(clock, detection, inverted, verdict, period, path // (2 * CONTEXTS))


@njit(cache=True, nogil=True)
def _fine(t, polarity, start, period, stop):  # type: ignore[no-untyped-def]
    """Return the signed events of a window in ``PHASES`` bins a bit."""
    bins = np.zeros((int((stop - start) / period) + 2) * PHASES)
    for i in range(len(t)):
        bins[int((t[i] - start) * PHASES / period)] += polarity[i]
    return bins


@njit(cache=True, nogil=True)
def _eye(bins):  # type: ignore[no-untyped-def]
    """Return Σ |ON − OFF| over the bits for each phase at which they may begin, ``(PHASES,)``."""
    eye = np.zeros(PHASES)
    total = np.zeros(len(bins) + 1)
    for i in range(len(bins)):
        total[i + 1] = total[i] + bins[i]
    for phase in range(PHASES):
        for first in range(phase, len(bins) - PHASES + 1, PHASES):
            eye[phase] += abs(total[first + PHASES] - total[first])
    return eye


@njit(cache=True, nogil=True)
def _eyes(t, polarity, start, periods, stop):  # type: ignore[no-untyped-def]
    """Return the best eye at each period, ``(k,)``."""
    best = np.empty(len(periods))
    for k in range(len(periods)):
        best[k] = _eye(_fine(t, polarity, start, periods[k], stop)).max()
    return best


@njit(cache=True, nogil=True)
def _phase(eye):  # type: ignore[no-untyped-def]
    """Return the middle of the open interval around the best phase, in bits, 0 to 1."""
    best = np.argmax(eye)
    least = EYE_SHARE * eye[best]
    early, late = 0, 0
    while early < PHASES // 2 and eye[(best - early - 1) % PHASES] >= least:
        early += 1
    while late < PHASES // 2 and eye[(best + late + 1) % PHASES] >= least:
        late += 1
    return ((best + 0.5 * (late - early)) % PHASES) / PHASES


@njit(cache=True, nogil=True)
def _fit_edges(t, polarity, start, period, fit):  # type: ignore[no-untyped-def]
    """Fit the edges of a window to the bit grid.

    Writes to ``fit``: correction of the period (share), mean fraction of a bit of the ON and of the OFF edges, standard
    deviation of the residuals (bit), standard deviation of the corrected period (share).
    """
    edges, rising = np.empty(len(t) // EDGE_RUN + 1), np.empty(len(t) // EDGE_RUN + 1, np.bool_)
    count, run, run_polarity, level, since = 0, 0, 0, 0, 0.0
    for i in range(len(t)):
        if polarity[i] != run_polarity:
            run_polarity, run, since = polarity[i], 0, t[i]
        run += 1
        if run == EDGE_RUN and level != run_polarity:
            if level != 0:
                edges[count], rising[count] = (since - start) / period, run_polarity > 0
                count += 1
            level = run_polarity
    fit[:] = 0.0
    fit[3], fit[4] = 0.3, 0.01
    if count < 6:
        return
    for kind in range(2):
        c, s = 0.0, 0.0
        for i in range(count):
            if rising[i] == (kind == 0):
                c += np.cos(2.0 * np.pi * edges[i])
                s += np.sin(2.0 * np.pi * edges[i])
        fit[1 + kind] = np.arctan2(s, c) / (2.0 * np.pi)
    mean_x = edges[:count].mean()
    xy, xx, squares = 0.0, 0.0, 0.0
    for i in range(count):
        off = edges[i] - fit[1 if rising[i] else 2]
        residual = off - np.floor(off + 0.5)
        xy += (edges[i] - mean_x) * residual
        xx += (edges[i] - mean_x) ** 2
        squares += residual * residual
    slope = xy / xx if xx > 0.0 else 0.0
    spread = np.sqrt(max(squares / count, 1e-6))
    fit[0] = slope
    fit[3] = spread
    fit[4] = spread / np.sqrt(xx) if xx > 0.0 else 0.01


@njit(cache=True, nogil=True)
def _counts(t, polarity, border, period, bits):  # type: ignore[no-untyped-def]
    """Return the events of each bit in its sub-slots, ``(bits, COUNTS)`` int64."""
    counts = np.zeros((bits, COUNTS), np.int64)
    for i in range(len(t)):
        slot = int(np.floor((t[i] - border) * SUB_SLOTS / period))
        if 0 <= slot < bits * SUB_SLOTS:
            counts[slot // SUB_SLOTS, slot % SUB_SLOTS + (0 if polarity[i] > 0 else SUB_SLOTS)] += 1
    return counts


@njit(cache=True, nogil=True)
def _slice(raw):  # type: ignore[no-untyped-def]
    """Return the bits that a slicer with hold reads, ``(bits,)`` uint8."""
    bits = np.empty(len(raw), np.uint8)
    least = SLICER_SHARE * raw.sum() / len(raw)
    held = 1
    for n in range(len(raw)):
        signed = raw[n, :SUB_SLOTS].sum() - raw[n, SUB_SLOTS:].sum()
        if abs(signed) > least:
            held = 1 if signed > 0 else 0
        bits[n] = held
    return bits


@njit(cache=True, nogil=True)
def _learn_from(counts, bits, tables):  # type: ignore[no-untyped-def]
    """Return histograms of the counts under these bits, and write their logarithms to ``tables``."""
    histograms = np.zeros((CONTEXTS, COUNTS, LEVELS))
    context = 0
    for n in range(len(counts)):
        context = (context << 1 | bits[n]) & (CONTEXTS - 1)
        if n >= 2:
            learn(histograms, counts[n], context, 1.0)
    logarithms(histograms, tables)
    return histograms


@njit(cache=True, nogil=True)
def _weigh_all(tables, counts):  # type: ignore[no-untyped-def]
    likelihoods = np.empty((len(counts), CONTEXTS))
    for n in range(len(counts)):
        weigh(tables, counts[n], likelihoods[n])
    return likelihoods


@njit(cache=True, nogil=True)
def _learn_free(raw, counts):  # type: ignore[no-untyped-def]
    """Learn from the counts alone, without the frame; return log p ``(bits, CONTEXTS)``, and bits."""
    tables = np.empty((CONTEXTS, COUNTS, LEVELS))
    likelihoods = np.empty((len(counts), CONTEXTS))
    bits = _slice(raw)
    for _ in range(FREE_ROUNDS + 1):  # first from the slicer's bits
        _learn_from(counts, bits, tables)
        likelihoods = _weigh_all(tables, counts)
        bits = free_bits(likelihoods)
    return likelihoods, bits


@njit(cache=True, nogil=True)
def _learn_framed(counts, path, transitions, inverted):  # type: ignore[no-untyped-def]
    """Learn on, from a framed path; return histograms (of the bits, not of their complement), log p and path."""
    tables = np.empty((CONTEXTS, COUNTS, LEVELS))
    histograms = np.empty((CONTEXTS, COUNTS, LEVELS))
    likelihoods = np.empty((len(counts), CONTEXTS))
    flip = 1 if inverted else 0
    for _ in range(FRAMED_ROUNDS):
        histograms = _learn_from(counts, ((path & 1) ^ flip).astype(np.uint8), tables)
        likelihoods = _weigh_all(tables, counts)
        if inverted:
            likelihoods = likelihoods[:, ::-1].copy()
        path, _ = framed_path(transitions, likelihoods)
    return histograms, likelihoods, path


@njit(cache=True, nogil=True)
def _judge(path, free, length):  # type: ignore[no-untyped-def]
    """Return passing words, failing ones (noise in units of words), idle bits, and changes of level in passing words."""
    passing, failing, noise, idle, changes = 0, 0, 0, 0, 0
    for n in range(len(path)):
        position = path[n] // (2 * CONTEXTS)
        if position == length:
            idle += 1
        elif position == length + 1:
            noise += 1
        elif position == length - 1 and n >= length - 1:
            same = True
            for k in range(length):
                same &= (path[n - k] & 1) == free[n - k]
            if same:
                passing += 1
                for k in range(length - 1):
                    changes += free[n - k] != free[n - k - 1]
            else:
                failing += 1
    return passing, failing + noise / length, idle, changes


def _oversampled(bits: NDArray[np.uint8]) -> float:
    """Return the greatest share of the changes that lie on every second, or on every third bit."""
    changes = np.flatnonzero(np.diff(bits))
    if not len(changes):
        return 1.0
    return max(float(np.bincount(changes % step).max()) / len(changes) for step in (2, 3))


@njit(cache=True, nogil=True)
def _means(scaled, path):  # type: ignore[no-untyped-def]
    """Return the mean events of a bit in each context; a context that was not seen has the mean of all."""
    sums, counts = np.zeros(CONTEXTS), np.zeros(CONTEXTS)
    for n in range(len(path)):
        context = path[n] & (CONTEXTS - 1)
        sums[context] += scaled[n].sum()
        counts[context] += 1.0
    overall = sums.sum() / max(counts.sum(), 1.0)
    return (sums + overall) / (counts + 1.0)
