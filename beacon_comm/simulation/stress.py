"""What makes a beacon hard to read, done to the events of one that is easy to read, recorded or simulated.

::

    thinned      ·· ·   ·  ·  · ·        fewer events: distance, contrast, a smaller blob
    clock        ├──┼──┼──┼──┤           bits of another length; drifting: of a changing one
    jitter       ├─┼────┼─┼──┤           every edge at its own wrong time
    background   :.:.:.:.:.:.:.:         events at random: noise, a scene that moves
    gaps         ·····      ·····        events that never arrived, while the sender went on
    fading       ‾‾\\__/‾‾\\__/‾‾          the strength swings: a beacon that sways, smoke, leaves
    leak         ··x··xx··x···           events of another beacon in the same blob

All take and return ``(t_ns, polarity)``: times (ns), non-decreasing, ``(n,)`` int64, and +1 / -1, ``(n,)`` int8; what
is returned has whole microseconds, as sensors stamp, and the input is left as it is.  Seeds are explicit: the same
seed gives the same events.

What changes the *time* of events is a :class:`Warp`, which also leads back: what was sent when can be looked up.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from beacon_comm.core.errors import ParameterError
from beacon_comm.core.events import NS_PER_S

Events = tuple[NDArray[np.int64], NDArray[np.int8]]
Times = NDArray[np.int64]
Polarities = NDArray[np.int8]
TIME_STEP_NS = 1000  # sensors stamp in whole microseconds
# A drifting clock and a fading amplitude are followed in so many steps a swing.
STEPS_A_SWING = 200
# An edge's events begin with it and are shifted together for so long; in the rest of the bit the shift changes (bits).
EDGE_LEAD_BITS = 0.1
EDGE_HELD_BITS = 0.5


@dataclass(frozen=True, slots=True)
class Warp:
    """A monotone map of time, linear between knots and of slope 1 outside of them.

    Attributes:
        before_ns: knots in the original time (ns), increasing, ``(k,)`` float64, ``k`` at least 1.
        after_ns: the same in the warped time (ns), non-decreasing.
    """

    before_ns: NDArray[np.float64]
    after_ns: NDArray[np.float64]

    def apply(self, t_ns: Times) -> Times:
        """Return the warped times, in whole microseconds."""
        return _whole(_mapped(t_ns, self.before_ns, self.after_ns))

    def undo(self, t_ns: Times) -> Times:
        """Return the original times of warped ones (ns); where a stretch was squeezed to one instant, one of them."""
        return np.rint(_mapped(t_ns, self.after_ns, self.before_ns)).astype(np.int64)


def thinned(t_ns: Times, polarity: Polarities, share: float, seed: int = 0) -> Events:
    """Return a share of the events: each is kept with this probability, whatever becomes of the others.

    It is what a blob of fewer pixels gives, or a camera that drops events at random.

    Raises:
        ParameterError: a share outside 0 to 1.
    """
    _check('share', share, 0.0, 1.0)
    kept = np.random.default_rng(seed).random(len(t_ns)) < share
    return _stamped(t_ns[kept], polarity[kept])


def clock_warp(t_ns: Times, ratio: float) -> Warp:
    """Return the warp of :func:`with_clock`.

    Raises:
        ParameterError: a ratio that is not positive.
    """
    _check('ratio', ratio, 1e-3, 1e3)
    begin, end = _span(t_ns)
    knots = np.array([begin, max(end, begin + 1.0)], np.float64)
    return Warp(knots, begin + (knots - begin) / ratio)


def with_clock(t_ns: Times, polarity: Polarities, ratio: float) -> Events:
    """Return the events of a beacon whose clock runs ``ratio`` times as fast: its bit rate is multiplied by it.

    The first event stays where it is, and all others come ``ratio`` times sooner after it.  (The sensor's latency is
    scaled with them, by microseconds.)
    """
    return _stamped(clock_warp(t_ns, ratio).apply(t_ns), polarity)


def drift_warp(t_ns: Times, swing: float, within_s: float = 1.0) -> Warp:
    """Return the warp of :func:`with_drifting_clock`.

    Raises:
        ParameterError: a swing outside 0 to 0.5, or a time that is not positive.
    """
    _check('swing', swing, 0.0, 0.5)
    _check('within_s', within_s, 1e-6, 1e9)
    begin, end = _span(t_ns)
    step_ns = within_s * NS_PER_S / STEPS_A_SWING
    steps = math.ceil((end - begin) / step_ns) + 1
    middle_s = (np.arange(steps) + 0.5) * step_ns / NS_PER_S
    lengths_ns = step_ns / (1.0 + swing * np.sin(math.pi * middle_s / within_s))
    before_ns = begin + step_ns * np.arange(steps + 1, dtype=np.float64)
    since_ns = np.zeros(steps + 1)
    np.cumsum(lengths_ns, out=since_ns[1:])
    return Warp(before_ns, begin + since_ns)


def with_drifting_clock(t_ns: Times, polarity: Polarities, swing: float, within_s: float = 1.0) -> Events:
    """Return the events of a beacon whose bit rate swings like a sine, by ``swing`` (a share) to either side.

    The way from the slowest to the fastest takes ``within_s``; it begins at the right rate.
    """
    return _stamped(drift_warp(t_ns, swing, within_s).apply(t_ns), polarity)


def jitter_warp(
    t_ns: Times, bit_rate_bps: float, share: float, start_ns: ArrayLike | None = None, seed: int = 0
) -> Warp:
    """Return the warp of :func:`with_jitter`.

    Raises:
        ParameterError: a bit rate that is not positive, or a share outside 0 to 1.
    """
    _check('bit_rate_bps', bit_rate_bps, 1e-3, 1e9)
    _check('share', share, 0.0, 1.0)
    begin, end = _span(t_ns)
    bit_ns = NS_PER_S / bit_rate_bps
    starts = np.sort(np.atleast_1d(np.asarray(begin if start_ns is None else start_ns, np.float64)))
    borders = [min(begin, starts[0]) - bit_ns, *starts[1:], max(end, starts[-1]) + bit_ns]
    edges = []
    for start, low, high in zip(starts, borders[:-1], borders[1:], strict=True):
        first, last = math.ceil((low - start) / bit_ns), math.ceil((high - start) / bit_ns)
        edges.append(start + bit_ns * np.arange(first, last))
    edges_ns = np.concatenate(edges) - EDGE_LEAD_BITS * bit_ns
    # Where another start's bits begin, the last one before it may be short.
    held_ns = np.minimum(EDGE_HELD_BITS * bit_ns, np.append(np.diff(edges_ns), bit_ns) / 2.0)
    shifts_ns = np.random.default_rng(seed).normal(0.0, share * bit_ns, len(edges_ns))
    before_ns = np.stack((edges_ns, edges_ns + held_ns), axis=1).ravel()
    return Warp(before_ns, np.maximum.accumulate(before_ns + np.repeat(shifts_ns, 2)))


def with_jitter(
    t_ns: Times,
    polarity: Polarities,
    bit_rate_bps: float,
    share: float,
    start_ns: ArrayLike | None = None,
    seed: int = 0,
) -> Events:
    """Return the events of a beacon whose edges come early or late, each by its own N(0, (share · bit)²).

    ::

        edges      k        k+1       k+2
                   ├────┐    ├────┐    ├──
        shift      │ d_k└────┘d_k+1└───┘          the first half of a bit moves as one, with its edge;
                                                  in the second half the shift goes over to the next one

    The order of events is kept: an edge cannot overtake the first half of the bit before it, it comes with its end.

    Args:
        t_ns, polarity: the events.
        bit_rate_bps: of the beacon (bit/s).
        share: standard deviation of the shifts (bits).
        start_ns: when a bit begins (ns), by the events of its edge; several where the sender paused, and from each on
            the bits are counted anew.  None: with the first event.
        seed: of the random numbers.
    """
    warp = jitter_warp(t_ns, bit_rate_bps, share, start_ns, seed)
    return _stamped(warp.apply(t_ns), polarity)


def with_background(
    t_ns: Times, polarity: Polarities, ratio: float, seed: int = 0, on_share: float | None = None
) -> Events:
    """Return the events and, among them, a Poisson process of ``ratio`` times their mean rate over the whole time.

    Args:
        t_ns, polarity: the events.
        ratio: background events for each event of the signal, on the average.
        seed: of the random numbers.
        on_share: share of the background that is ON; None: the signal's own, which no receiver can tell it by.

    Raises:
        ParameterError: a negative ratio, or a share outside 0 to 1.
    """
    _check('ratio', ratio, 0.0, 1e6)
    if on_share is None:
        on_share = float(np.mean(polarity > 0)) if len(polarity) else 0.5
    _check('on_share', on_share, 0.0, 1.0)
    random = np.random.default_rng(seed)
    count = int(random.poisson(ratio * len(t_ns)))
    begin, end = _span(t_ns)
    more_ns = _whole(begin + random.random(count) * (end - begin))
    more = np.where(random.random(count) < on_share, 1, -1).astype(np.int8)
    return _mixed((t_ns, polarity), (more_ns, more))


def gaps_at(
    t_ns: Times, bit_rate_bps: float, gap_bits: float, every_bits: float, seed: int = 0
) -> NDArray[np.int64]:
    """Return the gaps of :func:`with_gaps`: beginnings and ends (ns), ``(k, 2)`` int64, in order.

    Raises:
        ParameterError: a bit rate that is not positive, or gaps longer than their distance.
    """
    _check('bit_rate_bps', bit_rate_bps, 1e-3, 1e9)
    _check('every_bits', every_bits, 1e-3, 1e9)
    _check('gap_bits', gap_bits, 0.0, every_bits)
    begin, end = _span(t_ns)
    bit_ns = NS_PER_S / bit_rate_bps
    count = int((end - begin) // (every_bits * bit_ns)) if gap_bits > 0.0 else 0
    inside = np.random.default_rng(seed).random(count) * (every_bits - gap_bits)
    begins_ns = begin + (np.arange(count) * every_bits + inside) * bit_ns
    return np.rint(np.stack((begins_ns, begins_ns + gap_bits * bit_ns), axis=1)).astype(np.int64)


def with_gaps(
    t_ns: Times, polarity: Polarities, bit_rate_bps: float, gap_bits: float, every_bits: float, seed: int = 0
) -> tuple[Times, Polarities, NDArray[np.int64]]:
    """Return the events without those in gaps, as lost packets leave them: the sender goes on meanwhile.

    One gap begins at a random place in every ``every_bits`` bits, and lies within them.

    Returns:
        Times, polarities, and the gaps: beginnings and ends (ns), ``(k, 2)`` int64; the beginning is in the gap.  A
        character that a gap touched cannot be expected to be read.
    """
    gaps_ns = gaps_at(t_ns, bit_rate_bps, gap_bits, every_bits, seed)
    begun = np.searchsorted(gaps_ns[:, 0], t_ns, side='right')
    ended = np.searchsorted(gaps_ns[:, 1], t_ns, side='right')
    kept = begun == ended
    return *_stamped(t_ns[kept], polarity[kept]), gaps_ns


def with_fading(
    t_ns: Times, polarity: Polarities, ratio: float = 10.0, within_s: float = 1.0, seed: int = 0
) -> Events:
    """Return the events of a beacon whose strength swings between 1 and ``1 / ratio``.

    The share of events that are kept goes from 1 (at the first event) to ``1 / ratio`` within ``within_s``, and back in
    the same time: its logarithm is a cosine.

    Raises:
        ParameterError: a ratio below 1, or a time that is not positive.
    """
    _check('ratio', ratio, 1.0, 1e6)
    _check('within_s', within_s, 1e-6, 1e9)
    begin, _ = _span(t_ns)
    phase = math.pi * (t_ns - begin) / (within_s * NS_PER_S)
    share = ratio ** (-0.5 * (1.0 - np.cos(phase)))
    kept = np.random.default_rng(seed).random(len(t_ns)) < share
    return _stamped(t_ns[kept], polarity[kept])


def with_leak(
    t_ns: Times,
    polarity: Polarities,
    other_t_ns: Times,
    other_polarity: Polarities,
    share: float,
    seed: int = 0,
) -> Events:
    """Return the events and, among them, a share of those of another beacon, each with this probability.

    The other beacon's first event comes at the same time as the first here; its recording is repeated or cut to the
    same length.

    Raises:
        ParameterError: a share outside 0 to 1.
    """
    _check('share', share, 0.0, 1.0)
    if not len(other_t_ns) or not len(t_ns):
        return _stamped(t_ns, polarity)
    other = looped(other_t_ns, other_polarity, int(t_ns[0]), int(t_ns[-1]))
    return _mixed((t_ns, polarity), thinned(*other, share, seed))


def looped(t_ns: Times, polarity: Polarities, begin_ns: int, end_ns: int) -> Events:
    """Return the events from ``begin_ns`` to ``end_ns`` (ns, inclusive), their recording repeated as often as needed."""
    length_ns = int(t_ns[-1] - t_ns[0]) + TIME_STEP_NS
    rounds = max(0, end_ns - begin_ns) // length_ns + 1
    moved_ns = (begin_ns + np.arange(rounds)[:, None] * length_ns + (t_ns - t_ns[0])).ravel()
    kept = moved_ns <= end_ns
    return moved_ns[kept], np.tile(polarity, rounds)[kept]


def from_another_time(t_ns: Times, polarity: Polarities, share: float = 0.5) -> Events:
    """Return the same recording begun elsewhere: its last part from a share of its time on, then its first part."""
    _check('share', share, 0.0, 1.0)
    if not len(t_ns):
        return t_ns, polarity
    begin, end = int(t_ns[0]), int(t_ns[-1])
    cut = int(np.searchsorted(t_ns, begin + share * (end - begin)))
    if cut in (0, len(t_ns)):
        return t_ns, polarity
    later_ns = t_ns[cut:] - t_ns[cut] + begin
    earlier_ns = t_ns[:cut] - begin + int(later_ns[-1]) + TIME_STEP_NS
    return np.concatenate((later_ns, earlier_ns)), np.concatenate((polarity[cut:], polarity[:cut]))


def _span(t_ns: Times) -> tuple[float, float]:
    return (float(t_ns[0]), float(t_ns[-1])) if len(t_ns) else (0.0, 0.0)


def _mapped(t_ns: Times, source: NDArray[np.float64], target: NDArray[np.float64]) -> NDArray[np.float64]:
    t = np.asarray(t_ns, np.float64)
    outside = np.minimum(t - source[0], 0.0) + np.maximum(t - source[-1], 0.0)
    return np.interp(t, source, target) + outside


def _whole(t_ns: NDArray[np.float64]) -> Times:
    return np.rint(t_ns).astype(np.int64) // TIME_STEP_NS * TIME_STEP_NS


def _stamped(t_ns: Times, polarity: Polarities) -> Events:
    return t_ns // TIME_STEP_NS * TIME_STEP_NS, polarity.astype(np.int8)


def _mixed(*parts: Events) -> Events:
    t_ns = np.concatenate([part[0] for part in parts])
    polarity = np.concatenate([part[1] for part in parts])
    order = np.argsort(t_ns, kind='stable')
    return _stamped(t_ns[order], polarity[order])


def _check(name: str, value: float, low: float, high: float) -> None:
    if not low <= value <= high:
        raise ParameterError(f'{name} = {value:g}: must lie in [{low:g}, {high:g}]')
