"""Acquisition: is there a beacon of about this bit rate in these events, and if so, where do its bits lie?

For a period T near the expected one, over a window of some characters::

    1. eye       Σ over bits |ON − OFF| at 16 phases; the phase is the middle of the interval where the eye is within
                 95 % of its best: it falls off a cliff on the late side.  Where bursts are far shorter than a bit it is
                 open nearly everywhere: there bits begin so that bursts lie in the middle of a sub-slot
    2. slicer    bit = more ON or more OFF; few events: as the bit before
    3. learning  histograms from the bits, bits from the histograms: free, then under the frame
    4. verdict   how many words of the framed path are also what the free bits say: those could have failed, as the
                 histograms behind the free bits have not seen the frame; and by how much the place in the frame beats any
                 other, by histograms that have

The eye chooses among the periods around the expected one; the edges of the window then fit period and latencies.
The LED may also be on for 0: the frame is looked for in the bits and in their complement.
"""

from __future__ import annotations

from collections.abc import Generator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from beacon_comm.core.bit_clock import EDGE_RUN, OFF, ON, make_clock
from beacon_comm.core.likelihood import COMPRESSION, CONTEXTS, COUNTS, LEVELS, MEMORY_BITS, SUB_SLOTS, learn, logarithms, weigh
from beacon_comm.core.sequence_detection import SILENT_SHARE, make_detection
from beacon_comm.core.trellis import PLACE, framed_path, free_bits, place_margin

PHASES = 16
"""Phases of a bit at which the eye is measured."""

EYE_STEPS = 64
"""Periods are chosen by events that are sorted into so many steps of a bit."""

EYE_SHARE = 0.95
"""The eye is open where it is within this share of its best."""

MOST_CLOSED, LEAST_TOGETHER, BURST_PLACE = 1, 0.5, 1.5 / SUB_SLOTS
"""Where no more phases than the first are closed, the middle of the open ones is anywhere, near the bursts or not: if these are
together, 0 to 1, by more than the second, bits begin so that they lie at the third (bit), far from the borders of bits and
sub-slots.  At the right rate they are by 0.9 and more, at others by some 0.1."""

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
"""… or with so many passing words, where more of them may fail (a weak signal), but none other is nearly as likely …"""

CHEAP_COST, CHEAP_FAILING, CHEAP_MARGIN, CHEAP_SPREAD = 3.0, 1.0, 25.0, 0.17
"""… or where as many may fail, but the frame costs hardly any likelihood (nat a word), and the edges are on the grid: it costs
the 30 m recordings, at 62 bits, less than 14 nat in nine of ten windows, at other rates more than 16 in 99 of 100."""

HOPEFUL = 0.75
"""Where more words fail for each that passes than this, learning from them does not help."""

FULL_WORDS, FULL_SHARE = 4, 0.6
"""So many words that pass over so much of a window, or whose edges are sharp, leave no room for another rate."""

OVERSAMPLED_SHARE = 0.9
"""If so many changes of level lie on every second bit, or on every third, the bits are longer than was thought."""

LEAST_CHANGES = 3.0
"""Words with fewer changes of level than this, in the mean, may be one character of a slower signal."""

FEW_CHANGES = 2.0
"""One change of level within a word is what a glitch looks like, and a character of a faster signal between pauses."""

EDGE_SPREAD, SHARP_SPREAD = 0.22, 0.1
"""Edges spread farther about the bit grid (bit) are those of another rate: the recordings' have 0.07 to 0.16.  Edges no
farther from it than the second leave no room for another rate."""

NEIGHBOURS = 2
"""Periods so near to one that was read are not read: its edges would have led there."""

SAME_BITS = 0.05
"""Periods whose grids differ by less than this at the window's end (bit) are one: most that are tried end at the same edges."""

LEAST_PERIOD_STD = 1e-5
"""No window says more about a period (share)."""

MOST_STRETCH = 0.1
"""The first edges correct a period by no more than this (share)."""

LEAST_EDGES = 6
"""Fewer edges say nothing about the grid."""

NO_EDGES_SPREAD = 0.3
"""Where there are too few edges they count as evenly spread (bit)."""

EDGE_LEAD = 0.3
"""An edge is looked for from so much of a bit before its border on, over one bit."""

SLOPE_DEVIATIONS, LEAST_SLOPE = 3.0, 0.004
"""Edges that within the words go off the grid by so many standard deviations, and by more than this (bit a bit), are those
of another rate, whose characters happen to begin on this grid, too: pauses go so well with it."""


class Verdict(NamedTuple):
    """What a window reads like.

    Attributes:
        passing: words that the free bits confirm.
        failing: other words, and noise and idle bits that are none in units of words.
        covered: bits of passing words.
        changes: of level in a passing word, mean.
        bits: bits of the window.
        likelihood: of the framed path (nat).
        place_margin: see :func:`beacon_comm.core.trellis.place_margin`, of a bit in the middle of the window (nat).
        oversampled: the greatest share of the changes of level that lie on every second or every third bit.
        spread: of the edges about the bit grid, standard deviation (bit).
        slope: by how much the edges within words go off the grid from bit to bit (bit), 0 if that may be chance.
        period_std: standard deviation of the period (share).
        cost: by how much the frame makes the bits less likely (nat), by histograms that have not seen the frame.
    """

    passing: int
    failing: float
    covered: int
    changes: float
    bits: int
    likelihood: float
    place_margin: float
    oversampled: float
    spread: float
    slope: float = 0.0
    period_std: float = 0.0
    cost: float = np.inf

    @property
    def share(self) -> float:
        """Share of the window that passing words cover."""
        return self.covered / self.bits

    @property
    def merit(self) -> float:
        """Share of the window that speaks for the lock, less what speaks against it."""
        return (self.covered - self.failing * self.covered / max(self.passing, 1)) / self.bits

    @property
    def fit(self) -> float:
        """Mean log likelihood of a bit (nat): the right period of several has the greatest."""
        return self.likelihood / self.bits

    @property
    def convinces(self) -> bool:
        """Whether this can hardly be chance, another rate, or another place in the frame."""
        clear = self.failing <= CLEAR_FAILING * self.passing and self.place_margin >= CLEAR_MARGIN
        long = (
            self.passing >= LONG_WORDS
            and self.failing <= LONG_FAILING * self.passing
            and self.place_margin >= LONG_MARGIN
        )
        return (clear or long or self.cheap) and self.oversampled <= OVERSAMPLED_SHARE

    @property
    def cheap(self) -> bool:
        """Whether words fail that nearly pass."""
        return (
            self.cost <= CHEAP_COST * (self.passing + self.failing)
            and self.failing <= CHEAP_FAILING * self.passing
            and self.place_margin >= CHEAP_MARGIN
            and self.spread <= CHEAP_SPREAD
        )

    @property
    def full(self) -> bool:
        """Whether the words leave no room for another rate."""
        sharp = self.spread <= SHARP_SPREAD and self.failing <= CLEAR_FAILING * self.passing
        many = self.passing >= FULL_WORDS and self.changes >= LEAST_CHANGES
        return many and (self.share >= FULL_SHARE or sharp)


class Demands(NamedTuple):
    """What a lock has to show.

    Attributes:
        needed: words that have to pass; where the frame costs hardly any likelihood those that nearly pass count, too.
        tried: so many of the periods are read, those with the widest eye.
        most_spread: standard deviation of the edges about the bit grid (bit); evenly spread ones, of another rate, have 0.29.
        least_changes: of level within passing words, mean.
        most_stray: share by which the period may leave those that were asked for.
        most_period_std: standard deviation of the period (share): the clock must not lose the grid before the edges that
            follow have corrected it.
    """

    needed: int
    tried: int = 4
    most_spread: float = EDGE_SPREAD
    least_changes: float = 0.0
    most_stray: float = 0.005
    most_period_std: float = 0.0017

    def met(self, verdict: Verdict) -> bool:
        """Whether a window's verdict is enough."""
        return (
            verdict.passing + (verdict.failing if verdict.cheap else 0.0) >= self.needed
            and verdict.convinces
            and verdict.spread <= self.most_spread
            and verdict.changes >= self.least_changes
            and verdict.period_std <= self.most_period_std
        )


@dataclass(frozen=True, slots=True)
class Lock:
    """A beacon found: everything the locked receiver starts from.

    Attributes:
        clock: at the window's first bit, ``(1,)`` of ``CLOCK``.
        detection: with what was learnt, ``(1,)`` of ``DETECTION``.
        inverted: the LED is on for 0.
        verdict: see :class:`Verdict`.
        period: of a bit (ns).
        positions: place in the frame of each bit of the window, ``(bits,)``; ``length`` and above: none.
    """

    clock: NDArray[np.void]
    detection: NDArray[np.void]
    inverted: bool
    verdict: Verdict
    period: float
    positions: NDArray[np.int32]


Look = Generator[None, None, Lock | None]
"""A look at a window, piece by piece, each of some 0.2 ms, and of a few ms with very many events; it returns the lock."""


def look_at_once(look: Look) -> Lock | None:
    """Do a look, and return its lock."""
    while True:
        try:
            next(look)
        except StopIteration as end:
            lock: Lock | None = end.value
            return lock


def acquiring(
    t: NDArray[np.float64],
    polarity: NDArray[np.int8],
    periods: NDArray[np.float64],
    layout: NDArray[np.void],
    demands: Demands,
) -> Look:
    """Look for a beacon in a window of events, piece by piece.

    Args:
        t: event times (ns from an origin), ``(n,)`` float64, non-decreasing.
        polarity: ±1, ``(n,)`` int8.
        periods: periods (ns) to look at, ``(k,)``; the spacing finer than a quarter bit over the window.
        layout: of the character frame, ``(1,)`` of ``LAYOUT``.
        demands: what a lock has to show.
    """
    if len(t) < EDGE_RUN * demands.needed:
        return None
    start, stop = t[0], t[-1]
    nearest, farthest = (1.0 - demands.most_stray) * periods.min(), (1.0 + demands.most_stray) * periods.max()
    eyes = _eyes(t, polarity, start, periods, stop)
    yield
    found: Lock | None = None
    read: list[float] = []
    for _ in range(demands.tried):
        k = int(np.argmax(eyes))
        if eyes[k] < 0.0:
            break
        eyes[max(k - NEIGHBOURS, 0) : k + NEIGHBOURS + 1] = -1.0
        period = _settled(t, polarity, start, float(periods[k]))
        if any(abs(period - other) * (stop - start) < SAME_BITS * period * other for other in read):
            continue
        read.append(period)
        lock = yield from _read(t, polarity, start, stop, period, layout, demands.needed)
        if lock is not None and abs(lock.verdict.slope) > LEAST_SLOPE:
            period = _settled(t, polarity, start, lock.period * (1.0 + lock.verdict.slope))
            other = yield from _read(t, polarity, start, stop, period, layout, demands.needed)
            if other is not None and other.verdict.spread < lock.verdict.spread:
                lock = other
        if lock is None or not nearest <= lock.period <= farthest:
            continue
        if found is None or lock.verdict.fit > found.verdict.fit:
            found = lock
    return found if found is not None and demands.met(found.verdict) else None


def _read(
    t: NDArray[np.float64],
    polarity: NDArray[np.int8],
    start: float,
    stop: float,
    period: float,
    layout: NDArray[np.void],
    needed: int,
) -> Look:
    length = int(layout['length'][0])
    border = start + (_phase(_fine(t, polarity, start, period, stop)) - 1.0) * period
    bits = int((stop - border) / period) + 1
    raw = _counts(t, polarity, border, period, bits)
    gain = max(1.0, raw.sum() / bits / REFERENCE_EVENTS)
    counts = COMPRESSION[np.minimum((raw / gain + 0.5).astype(np.int64), len(COMPRESSION) - 1)]
    likelihoods, free = _learn_free(raw, counts)
    yield
    inverted, path, likelihood = False, None, -np.inf
    for turned in (False, True):
        if _may_convince(free ^ turned, layout):
            other, its_likelihood = framed_path(layout, likelihoods[:, ::-1].copy() if turned else likelihoods)
            if its_likelihood > likelihood:
                inverted, path, likelihood = turned, other, its_likelihood
            yield
    if path is None:
        return None
    cost = _log_likelihood(likelihoods, free) - likelihood
    free = free ^ inverted
    passing, failing, _ = _judge(path, free, length)
    hopeful = passing >= needed and failing <= HOPEFUL * passing
    if not hopeful and (passing + failing < needed or cost > CHEAP_COST * (passing + failing)):
        return None  # to learn from the path would cost as much again
    histograms, likelihoods, path = _learn_framed(counts, path, layout, inverted)
    yield
    passing, failing, changes = _judge(path, free, length)
    covered = passing * length
    framed = np.flatnonzero(path // PLACE < length)
    middle = int(framed[len(framed) // 2]) if len(framed) else 0
    margin = place_margin(layout, likelihoods, middle)
    latencies = np.empty(2)
    edges = _locate_edges(t, polarity, border, period, path, length, inverted, latencies)
    verdict = Verdict(
        passing,
        failing,
        covered,
        changes / max(passing, 1),
        bits,
        likelihood,
        margin,
        _oversampled(free),
        edges.spread,
        edges.slope,
        max(edges.stretch_std, LEAST_PERIOD_STD),
        cost,
    )
    if inverted:
        histograms = np.concatenate((histograms[::-1, SUB_SLOTS:], histograms[::-1, :SUB_SLOTS]), axis=1)
    means = _means(raw / gain, path)
    silence = float(np.mean(raw.sum(axis=1)[framed] < SILENT_SHARE * gain * means.mean())) if len(framed) else 1.0
    border -= edges.stretch * edges.middle * period
    period *= 1.0 + edges.stretch
    clock = make_clock(border, period, latencies * period, edges.spread, verdict.period_std)
    detection = make_detection(
        histograms, means, gain, silence, verdict.fit, _empty_share(raw, path), verdict.passing
    )
    return Lock(clock, detection, inverted, verdict, period, path // PLACE)


@njit(cache=True, nogil=True)
def _fine(t, polarity, start, period, stop):  # type: ignore[no-untyped-def]
    """Return the signed events of a window in ``PHASES`` bins a bit."""
    bins = np.zeros((int((stop - start) / period) + 2) * PHASES)
    scale = PHASES / period
    for i in range(len(t)):
        bins[np.uint64((t[i] - start) * scale)] += polarity[i]
    return bins


@njit(cache=True, nogil=True)
def _eye(bins):  # type: ignore[no-untyped-def]
    """Return Σ |ON − OFF| over the bits for each phase at which they may begin, ``(PHASES,)``."""
    eye = np.zeros(PHASES)
    total = np.zeros(len(bins) + 1)
    for i in range(len(bins)):
        total[i + 1] = total[i] + bins[i]
    for first in range(0, len(bins) - PHASES, PHASES):
        early, late = total[first : first + PHASES], total[first + PHASES : first + 2 * PHASES]
        for phase in range(PHASES):
            eye[phase] += abs(late[phase] - early[phase])
    eye[0] += abs(total[-1] - total[len(bins) - PHASES])
    return eye


@njit(cache=True, nogil=True)
def _eyes(t, polarity, start, periods, stop):  # type: ignore[no-untyped-def]
    """Return the best eye at each period, ``(k,)``: from the sums of all signed events up to times that the periods share."""
    scale = EYE_STEPS / periods.min()
    sums = np.zeros(int((stop - start) * scale) + 2, np.int64)  # by the same product as the places
    for i in range(len(t)):
        sums[np.uint64((t[i] - start) * scale) + np.uint64(1)] += polarity[i]
    for k in range(1, len(sums)):
        sums[k] += sums[k - 1]
    best = np.zeros(len(periods))
    for k in range(len(periods)):
        per_bit = periods[k] * scale
        if len(sums) <= per_bit:
            continue
        for phase in range(PHASES):
            eye, early = 0, sums[np.uint64(phase * per_bit / PHASES)]
            for n in range(1, int(len(sums) / per_bit - phase / PHASES)):
                late = sums[np.uint64((n + phase / PHASES) * per_bit)]
                eye += abs(late - early)
                early = late
            best[k] = max(best[k], eye)
    return best


@njit(cache=True, nogil=True)
def _phase(bins):  # type: ignore[no-untyped-def]
    """Return where bits begin (0 to 1 bit) by the signed events of a window; see the module's head."""
    eye = _eye(bins)
    best = np.argmax(eye)
    least = EYE_SHARE * eye[best]
    if (eye < least).sum() <= MOST_CLOSED:
        burst, together = _bursts(bins)
        if together > LEAST_TOGETHER:
            return (burst - BURST_PLACE) % 1.0
    early, late = 0, 0
    while early < PHASES // 2 and eye[(best - early - 1) % PHASES] >= least:
        early += 1
    while late < PHASES // 2 and eye[(best + late + 1) % PHASES] >= least:
        late += 1
    return ((best + 0.5 * (late - early)) % PHASES) / PHASES


@njit(cache=True, nogil=True)
def _bursts(bins):  # type: ignore[no-untyped-def]
    """Return where in the bits the bursts lie (bit), and how much together: 1 in one bin, 0 anywhere.

    Signed events count squared, so that bursts outweigh the background.
    """
    power = np.zeros(PHASES)
    for i in range(len(bins)):
        power[i % PHASES] += bins[i] * bins[i]
    angle = 2.0 * np.pi * (np.arange(PHASES) + 0.5) / PHASES
    c, s = (power * np.cos(angle)).sum(), (power * np.sin(angle)).sum()
    return np.arctan2(s, c) / (2.0 * np.pi), np.hypot(s, c) / max(power.sum(), 1.0)


def _settled(t: NDArray[np.float64], polarity: NDArray[np.int8], start: float, period: float) -> float:
    """Return a period as the window's edges have it."""
    for _ in range(2):
        period *= 1.0 + _stretch(t, polarity, start, period)
    return period


@njit(cache=True, nogil=True)
def _stretch(t, polarity, start, period):  # type: ignore[no-untyped-def]
    """Return by how much (share) a period is too short, from where the edges of a window lie in the bits.

    There are no bits yet to say where edges are: an edge is the first of ``EDGE_RUN`` events of the opposite polarity.
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
    if count < LEAST_EDGES:
        return 0.0
    edges, rising = edges[:count], rising[:count]
    from_middle, off = edges - edges.mean(), np.empty(count)
    for kind in range(2):
        c, s = 0.0, 0.0
        for i in range(count):
            if rising[i] == (kind == 0):
                c += np.cos(2.0 * np.pi * edges[i])
                s += np.sin(2.0 * np.pi * edges[i])
        late = np.arctan2(s, c) / (2.0 * np.pi)
        for i in range(count):
            if rising[i] == (kind == 0):
                off[i] = edges[i] - late - np.floor(edges[i] - late + 0.5)
    xx = (from_middle * from_middle).sum()
    stretch = (from_middle * off).sum() / xx if xx > 0.0 else 0.0
    return min(max(stretch, -MOST_STRETCH), MOST_STRETCH)


class Edges(NamedTuple):
    """What the edges of a window say.

    Attributes:
        spread, slope: see :class:`Verdict`.
        stretch, stretch_std: by how much the period is too short (share), and its standard deviation.
        middle: of the edges (bits from the first border).
    """

    spread: float
    slope: float
    stretch: float
    stretch_std: float
    middle: float


@njit(cache=True, nogil=True)
def _locate_edges(t, polarity, border, period, path, length, inverted, latencies):  # type: ignore[no-untyped-def]
    """Locate the edges where the words of a path have them; return what they say, and write their latencies (bit).

    They are looked for as the bit clock does, see :mod:`beacon_comm.core.bit_clock`, in one bit about the border.
    """
    at, places = np.empty(len(path)), np.empty(len(path))
    words, in_word, kinds = np.empty(len(path), np.int64), np.empty(len(path), np.int64), np.empty(len(path), np.int64)
    count, word, first = 0, 0, 0
    sign = -1 if inverted else 1
    for n in range(1, len(path)):
        place = path[n] // PLACE
        word += place == 0
        if place >= length or (path[n] & 1) == (path[n - 1] & 1):
            continue
        begin = border + (n - EDGE_LEAD) * period
        up = sign if path[n] & 1 else -sign
        while first < len(t) and t[first] < begin:
            first += 1
        total, least, rise, last = 0, 0, 0, first
        while last < len(t) and t[last] < begin + period:
            total += up * polarity[last]
            least = min(least, total)
            rise = max(rise, total - least)
            last += 1
        if rise == 0:
            continue
        total, lowest, edge = 0, np.inf, first
        for i in range(first, last):
            level = total - rise * (t[i] - begin) / period
            if level <= lowest:
                lowest, edge = level, i
            total += up * polarity[i]
        at[count], places[count] = n, (t[edge] - border) / period - n
        words[count], in_word[count], kinds[count] = word, place, ON if path[n] & 1 else OFF
        count += 1
    latencies[:] = 0.0
    if count < LEAST_EDGES:
        return Edges(NO_EDGES_SPREAD, 0.0, 0.0, 0.01, 0.0)
    at, places, words, in_word, kinds = at[:count], places[:count], words[:count], in_word[:count], kinds[:count]
    for kind in (OFF, ON):
        of_kind = kinds == kind
        if of_kind.any():
            latencies[kind] = places[of_kind].mean()
        places -= np.where(of_kind, latencies[kind], 0.0)
    xx, xy, start = 0.0, 0.0, 0
    for end in range(1, count + 1):
        if end == count or words[end] != words[start]:
            inside = in_word[start:end] - in_word[start:end].mean()
            xx += (inside * inside).sum()
            xy += (inside * places[start:end]).sum()
            start = end
    slope = xy / xx if abs(xy) > SLOPE_DEVIATIONS * places.std() * np.sqrt(xx) else 0.0
    from_middle = at - at.mean()
    xx = (from_middle * from_middle).sum()
    stretch = (from_middle * places).sum() / xx
    places -= stretch * from_middle
    return Edges(places.std(), slope, stretch, places.std() / np.sqrt(xx), at.mean())


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
def _log_likelihood(likelihoods, bits):  # type: ignore[no-untyped-def]
    """Return the log likelihood of bits (nat); the best ones before them."""
    total, context = 0.0, 0
    for n in range(len(bits)):
        context = (context << 1 | bits[n]) & (CONTEXTS - 1)
        total += likelihoods[n].max() if n < MEMORY_BITS - 1 else likelihoods[n, context]
    return total


@njit(cache=True, nogil=True)
def _learn_framed(counts, path, layouts, inverted):  # type: ignore[no-untyped-def]
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
        path, _ = framed_path(layouts, likelihoods)
    return histograms, likelihoods, path


@njit(cache=True, nogil=True)
def _may_convince(free, layouts):  # type: ignore[no-untyped-def]
    """Return whether any path could have few enough failing words: reading a path costs far more than this.

    The best path takes words that the free bits confirm, and pays for the zeros beside them; the window may begin and end
    within a word.
    """
    length, words = layouts[0].length, layouts[0].words
    mask = (1 << length) - 1
    most_failing = LONG_FAILING if len(free) >= LONG_WORDS * length else CHEAP_FAILING
    merit = np.zeros(len(free) + 1)
    word = 0
    for n in range(len(free)):
        word = (word << 1 | free[n]) & mask
        if n >= length - 1:
            merit[n + 1] = merit[n] if free[n] else merit[n] - 1.0 / length
            if words[word]:
                merit[n + 1] = max(merit[n + 1], merit[n + 1 - length] + most_failing)
    return len(free) >= length and merit[len(free) - length + 1 :].max() >= 0.0


@njit(cache=True, nogil=True)
def _judge(path, free, length):  # type: ignore[no-untyped-def]
    """Return passing words, failing ones, and changes of level in passing words.

    Noise, and idle line where the free bits are zeros, are failing in units of words.
    """
    passing, failing, noise, changes = 0, 0, 0, 0
    for n in range(len(path)):
        position = path[n] // PLACE
        if position == length:
            noise += free[n] == 0
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
    return passing, failing + noise / length, changes


@njit(cache=True, nogil=True)
def _empty_share(raw, path):  # type: ignore[no-untyped-def]
    """Return the share of held bits without any event; with none seen, one half."""
    held, empty = 1.0, 0.5
    for n in range(len(path)):
        context = path[n] & (CONTEXTS - 1)
        if context == 0 or context == CONTEXTS - 1:
            held += 1.0
            empty += raw[n].sum() == 0
    return empty / held


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
