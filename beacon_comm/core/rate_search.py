"""Where and when to look for a bit rate: attempts on a grid of event time, over windows of a few characters.

::

    first event ─►│ 5 characters │ 5.3 │ 5.6 │ 6 │ … 10 │ 12 │ … attempts; rarer when nothing is found
                  ├── window ────┤
                  ├──── window ──────┤

A *listed* rate is looked for within 2.5 % of its nominal value: cheap oscillators are off by 2 %.

*Blind*, 100 bps to 10 kbps are looked for octave by octave, the fast ones first because their windows are short.  Two
statements about the signed events s(t) of a window name periods, and :func:`beacon_comm.core.acquisition.acquiring`
decides:

- characters follow one another, and all have a start bit and stop bits: the autocorrelation of s peaks at multiples of
  the character's duration, and the sum over 8 of them at it and its multiples alone;
- edges lie on the bit grid: the spectra of the ON and of the OFF events have a line at the bit rate, also where
  characters stand alone.
"""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from beacon_comm.core.acquisition import FEW_CHANGES, Demands
from beacon_comm.core.events import NS_PER_S
from beacon_comm.core.framing import CharacterFrame
from beacon_comm.core.parameters import Parameters

LISTED_SPREAD = 0.025
"""A clock's rate is looked for within so much of its nominal value."""

PERIOD_STEP = 0.15
"""Periods are tried so close that the window's ends move by so much (bit)."""

LISTED_ATTEMPTS = (5.0, 5.3, 5.6, 6.0, 6.5, 7.0, 8.0, 10.0, 12.0, 15.0, 18.0, 22.0, 26.0, 30.0)
BLIND_ATTEMPTS = (12.0, 16.0, 20.0, 25.0)
"""Attempts are made so many characters after the first event …"""

LATER_STEP, LISTED_LATER_SHARE, BLIND_LATER_SHARE = 6, 0.2, 0.4
"""… and then after so many more, or after this share of all so far if that is more."""

MOST_LISTED_STEP, MOST_BLIND_STEP, MOST_BLIND_STEP_NS = 20.0, 50.0, 0.5 * NS_PER_S
"""Attempts are at most so many characters apart, so that nothing is out of reach; blind ones, that cost more, or so long."""

BLIND_OCTAVES = (5000.0, 2500.0, 1250.0, 625.0, 312.5, 156.25, 100.0)
"""Slowest rate of each octave (bit/s), the fast ones first."""

OCTAVE_OVERLAP = 0.025
"""An octave is looked at so much beyond its ends."""

BINS_PER_BIT = 4
"""Bins in a bit of an octave's fastest rate."""

COMB = 8
"""Multiples of a character's duration that are summed."""

NAMED = 2
"""Periods that each statement names."""

NAMED_SPREAD = 0.004
"""They are right to within this share."""

SHORT_WINDOW, LONG_WINDOW, LONGEST_WINDOW = 8, 25, 90
"""Characters of a window: later attempts take turns with them.  Pauses between the characters need long ones."""

EXHAUSTED_AT, LEAST_LOOKS = 60, 4
"""Nothing found in so many characters, and so many attempts: there is no such beacon."""

KEPT_CHARACTERS = 130
"""Events so many characters of the slowest rate back are kept while it is sought."""

LISTED_DEMANDS = Demands(needed=4)
BLIND_DEMANDS = Demands(needed=8, tried=1, least_changes=FEW_CHANGES, most_stray=0.1)


class RateSearch:
    """When and where to look for one rate; see :class:`ListedSearch` and :class:`OctaveSearch`.

    Args:
        bit_rate_bps: nominal rate, or the slowest of several (bit/s).
        frame: character frame.
        demands: what a lock has to show.
        attempts: number of characters after the first event at which attempts are made, the first ones.
        later_share: the later ones are so much of all so far apart (share) …
        most_step: … and at most so many characters.

    Attributes:
        period: nominal period of a bit, or the longest of several (ns).
        demands: what a lock has to show.
        made: attempts so far.
        longest: events so far back may still be needed (ns).
        wanted: when the next attempt was to be made, had it not been postponed (ns).
    """

    def __init__(
        self,
        bit_rate_bps: float,
        frame: CharacterFrame,
        demands: Demands,
        attempts: tuple[float, ...],
        later_share: float,
        most_step: float,
    ) -> None:
        self.period = NS_PER_S / bit_rate_bps
        self.demands = demands
        self._character = frame.duration_ns(bit_rate_bps)
        self._length = frame.length
        self._attempts = attempts
        self._later_share = later_share
        self._most_step = most_step
        self.longest = KEPT_CHARACTERS * self._character
        self.restart(0.0)

    def restart(self, t: float) -> None:
        """Begin anew with a first event at ``t``."""
        self.made = 0
        self._since = t
        self._at = self._attempts[0]
        self.wanted = self.due

    @property
    def due(self) -> float:
        """Time of the next attempt (ns from the demodulator's origin)."""
        return self._since + self._at * self._character

    @property
    def exhausted(self) -> bool:
        """Whether it has looked long enough."""
        return self._at > EXHAUSTED_AT and self.made >= LEAST_LOOKS

    def had_a_chance(self, now: float) -> bool:
        """Whether it has seen enough by ``now`` (ns) to find a beacon."""
        return now >= self._since + (self._attempts[0] + 1) * self._character

    def window(self, t: NDArray[np.float64], now: float, first: int, stop: int) -> slice | None:
        """Return the events to look at, None if there are none of late.

        Args:
            t: event times (ns).
            now: time of the attempt (ns).
            first, stop: those that may be used.
        """
        short = max(SHORT_WINDOW, self._attempts[0])
        characters = self._at
        if characters > short:
            longest = LONGEST_WINDOW if self.made >= len(self._attempts) and self.made % 4 == 0 else LONG_WINDOW
            characters = short if self.made % 2 else min(characters, longest)
        begin = max(first, int(np.searchsorted(t, now - characters * self._character)))
        if begin >= stop or t[stop - 1] < now - SHORT_WINDOW * self._character:
            return None
        return slice(begin, stop)

    def periods(self, t: NDArray[np.float64], polarity: NDArray[np.int8]) -> Iterator[NDArray[np.float64]]:
        """Yield groups of periods (ns) to try on a window of events, the likeliest first."""
        raise NotImplementedError

    def postpone(self, t: float) -> None:
        """Make the next attempt at ``t`` (ns), if it was to be earlier."""
        self._at = max(self._at, (t - self._since) / self._character)

    def miss(self, start: float, stop: float) -> None:
        """Hear of missing events (ns): behind a gap longer than a character there must be enough again to look at."""
        if stop - start > self._character:
            self.postpone(stop + self._attempts[0] * self._character)

    def failed(self) -> None:
        """Go on to the next attempt."""
        self.made += 1
        if self.made < len(self._attempts):
            apart = self._attempts[self.made] - self._attempts[self.made - 1]
            self._at = max(self._attempts[self.made], self._at + min(1.0, apart))
        else:
            self._at += min(max(LATER_STEP, self._at * self._later_share), self._most_step)
        self.wanted = self.due


class ListedSearch(RateSearch):
    """Looks for a listed rate (bit/s)."""

    def __init__(self, bit_rate_bps: float, frame: CharacterFrame) -> None:
        super().__init__(bit_rate_bps, frame, LISTED_DEMANDS, LISTED_ATTEMPTS, LISTED_LATER_SHARE, MOST_LISTED_STEP)

    def periods(self, t: NDArray[np.float64], polarity: NDArray[np.int8]) -> Iterator[NDArray[np.float64]]:
        """Yield the periods around the nominal one."""
        bits = max(t[-1] - t[0], self._character) / self.period
        yield periods_around(self.period, LISTED_SPREAD, bits)


class OctaveSearch(RateSearch):
    """Looks for any rate from the slowest one to twice that (bit/s)."""

    def __init__(self, slowest_bps: float, frame: CharacterFrame) -> None:
        most_step = max(MOST_BLIND_STEP, MOST_BLIND_STEP_NS / frame.duration_ns(slowest_bps))
        super().__init__(slowest_bps, frame, BLIND_DEMANDS, BLIND_ATTEMPTS, BLIND_LATER_SHARE, most_step)

    def periods(self, t: NDArray[np.float64], polarity: NDArray[np.int8]) -> Iterator[NDArray[np.float64]]:
        """Yield the surroundings of the periods that autocorrelation and spectra name."""
        bin_ns = self.period / (2 * BINS_PER_BIT)
        bins = np.minimum(((t - t[0]) / bin_ns).astype(np.int64), int((t[-1] - t[0]) / bin_ns))
        on = np.bincount(bins[polarity > 0], minlength=int(bins[-1]) + 1).astype(np.float64)
        off = np.bincount(bins[polarity < 0], minlength=int(bins[-1]) + 1).astype(np.float64)
        named = np.concatenate((self._repeated(on - off), self._gridded(on, off))) * bin_ns
        tried: list[float] = []
        for period in named:
            if all(abs(period / other - 1.0) > NAMED_SPREAD for other in tried):
                tried.append(float(period))
                yield periods_around(float(period), NAMED_SPREAD, (t[-1] - t[0]) / float(period))

    def _repeated(self, signed: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return bit periods (bins) from the autocorrelation, the best first."""
        size = 1 << (2 * len(signed) - 1).bit_length()
        spectrum = np.fft.rfft(signed - signed.mean(), size)
        correlation = np.fft.irfft(np.abs(spectrum) ** 2, size)[: len(signed)]
        shortest = self._length * BINS_PER_BIT
        lags = np.arange(shortest, 2 * shortest * (1.0 + OCTAVE_OVERLAP), 0.1)
        multiples = np.arange(1, COMB + 1)[:, None] * lags
        values = np.interp(multiples.ravel(), np.arange(len(correlation)), correlation, right=0.0)
        return _peaks(values.reshape(multiples.shape).sum(axis=0), lags, NAMED) / self._length

    def _gridded(self, on: NDArray[np.float64], off: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return bit periods (bins) from the lines in the spectra of the ON and the OFF events, the best first."""
        size = 1 << (4 * len(on)).bit_length()
        power = np.abs(np.fft.rfft(on - on.mean(), size)) ** 2 + np.abs(np.fft.rfft(off - off.mean(), size)) ** 2
        frequency = np.arange(len(power)) / size
        kept = slice(
            int(size / (2 * BINS_PER_BIT * (1.0 + OCTAVE_OVERLAP))), int(size * (1.0 + OCTAVE_OVERLAP) / BINS_PER_BIT) + 1
        )
        return 1.0 / _peaks(power[kept], frequency[kept], NAMED)


def periods_around(period: float, spread: float, bits: float) -> NDArray[np.float64]:
    """Return periods within a share of one, so close that the ends of so many bits move by :data:`PERIOD_STEP`."""
    steps = math.ceil(spread * bits / PERIOD_STEP)
    return period * (1.0 + spread * np.arange(-steps, steps + 1) / steps)


def _peaks(values: NDArray[np.float64], places: NDArray[np.float64], count: int) -> NDArray[np.float64]:
    """Return the places of the highest local maxima, the highest first; fewer than ``count`` if there are not so many."""
    inner = values[1:-1]
    found = 1 + np.flatnonzero((inner > values[:-2]) & (inner >= values[2:]))
    return places[found[np.argsort(-values[found], kind='stable')[:count]]]


def make_searches(parameters: Parameters, frame: CharacterFrame) -> list[RateSearch]:
    """Return the searches that the parameters ask for."""
    searches: list[RateSearch] = []
    if parameters.rate_search != 'blind':
        searches += [ListedSearch(bit_rate_bps, frame) for bit_rate_bps in dict.fromkeys(parameters.bit_rates)]
    if parameters.rate_search != 'listed':
        searches += [OctaveSearch(slowest_bps, frame) for slowest_bps in BLIND_OCTAVES]
    return searches
