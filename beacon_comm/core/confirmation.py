"""Confirmation by parity: whether what a demodulator reads is a beacon (section III, "Detection algorithm").

Every character that a demodulator gives out is *counted* (a silence gives none).  Three rules look at them::

    counted characters    1 ................... 15 ................ 30 ......
    reject (the paper)               last 5 |#####|        last 5 |#####|      at the 15th and at every 15th after
    confirm (ours)         |###################|  last 15                      at every character from the 15th on
    demote (the paper)     a confirmed beacon: the last 5, at every character; demoted at 15 failures in a row

A lamp is a valid sender, too: at each of its falls the same waveform lies ahead, so every character is synchronised
and reads alike, with right parity if chance has it; an edge near the middle of a bit makes several codes of one.
A line that changes at random gets one character in five ok.  So a character *vouches* for a beacon only if it is ok, or
repaired though its bits say the same without the frame, and did not slip in (see :meth:`ParityRecord.push`); the edges
of those that vouch have to lie nearer to the borders of the bits than to their middles (their confidence); and their
codes have to vary as a text's do (:func:`repeats`, :func:`regular_share`, :func:`comb_share`).
``docs/confirmation.md`` works out what is left to chance.
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum
from functools import lru_cache
from statistics import median

import numpy as np
from numpy.typing import NDArray

from beacon_comm.core.character import Character, Status
from beacon_comm.core.events import NS_PER_S
from beacon_comm.core.framing import CharacterFrame
from beacon_comm.core.parameters import Parameters

SLIPPED_BITS = 0.5
"""A character that starts so many bits too early has slipped: the line was not synchronised before it."""

VOUCHED_WINDOWS = 4
"""A record remembers what vouched for as long as so many windows."""


class Verdict(Enum):
    """What a character, or the passing of time, changed."""

    NONE = 'nothing changed'
    CONFIRMED = 'parity has vouched for the candidate'
    REJECTED = 'parity has failed the candidate'
    STARVED = 'too few characters to judge'
    DEMOTED = 'parity has failed the confirmed beacon'


@dataclass(frozen=True, slots=True)
class _Counted:
    """What the window keeps of a character."""

    code: int
    frame: int
    confidence: float
    edge_spread: float
    vouches: bool


class ParityRecord:
    """Judges one track by its characters since its slot was given.

    ========== ============================================================================== =========
    state      when                                                                           becomes
    ========== ============================================================================== =========
    candidate  every ``judged_characters`` counted: < ``judged_right`` of the last            demoted
               ``judged_last`` parities right (REJECTED)
    candidate  fewer than ``judged_characters`` counted since the last judgement within       demoted
               ``starved_after_ns`` of time with events (STARVED)
    candidate  ``confirm_ok`` of the last ``confirm_window`` vouch, with a median             confirmed
               confidence of ``confirm_confidence`` and ``confirm_distinct_codes`` codes that
               vary as a text's (CONFIRMED), unless the same character rejects it
    confirmed  ``judged_characters`` in a row, at each of which < ``judged_right`` of the     demoted
               last ``judged_last`` parities were right (DEMOTED)
    demoted    never: a track that is tried again gets a new record                           --
    ========== ============================================================================== =========

    With parity 'none' the status OK stands in for a right parity.  A REPAIRED character is not ok; its parity is right if
    its bits say so without the frame: the structure that rescues a character would rescue noise as well.

    Attributes:
        characters, ok, repaired, parity_errors, framing_errors: counted characters since the slot was given.
        confirmed, demoted: the state; a candidate is neither.
        confirmed_at_ns: end of the character that confirmed it (ns, sensor clock), None before.
        starved_after_ns: see the table (ns); long enough for a steady sender at the slowest listed rate.
    """

    def __init__(self, parameters: Parameters) -> None:
        self._p = parameters
        self._layout = CharacterFrame.from_parameters(parameters)
        judged_s = parameters.judged_characters * self._layout.length * parameters.slowest_bit_s
        self.starved_after_ns = round(max(parameters.starved_after_s, parameters.starved_margin * judged_s) * NS_PER_S)
        self.characters = 0
        self.ok = 0
        self.repaired = 0
        self.parity_errors = 0
        self.framing_errors = 0
        self.confirmed = False
        self.demoted = False
        self.confirmed_at_ns: int | None = None
        self._rights: deque[bool] = deque(maxlen=parameters.judged_last)
        self._window: deque[_Counted] = deque(maxlen=parameters.confirm_window)
        self._vouched: deque[_Counted] = deque(maxlen=VOUCHED_WINDOWS * parameters.confirm_window)
        self._last_start_ns: int | None = None
        self._failures = 0  # characters in a row at which the last parities failed a confirmed beacon
        self._doubtful_at: int | None = None  # number of the character at which a window first passed in doubt
        self._hungry_ns = 0
        self._known_ns: int | None = None

    def push(self, character: Character) -> Verdict:
        """Count a character, in order of time; a demoted record counts on, but gives no further verdict.

        A character that may vouch does so unless it started more than half a bit early: a synchronised line brings characters a
        whole frame apart, or further when it idles.
        """
        self._count(character)
        if self.demoted:
            return Verdict.NONE
        if self.confirmed:
            return self._judge_beacon()
        if self.characters % self._p.judged_characters == 0:
            self._hungry_ns = 0
            if self._failing:
                self.demoted = True
                return Verdict.REJECTED
        if self._vouched_for():
            self.confirmed = True
            self.confirmed_at_ns = self.end_of(character)
            return Verdict.CONFIRMED
        return Verdict.NONE

    def advance(self, t_ns: int, quiet: bool) -> Verdict:
        """Move the record's time on; what passed since the last call counts towards starving, but not if it was quiet.

        Args:
            t_ns: stream time (ns); the first call only starts the clock.
            quiet: the track has no events now: silence keeps slot and record.
        """
        if self._known_ns is not None and not quiet:
            self._hungry_ns += max(0, t_ns - self._known_ns)
        self._known_ns = t_ns
        if self.confirmed or self.demoted or self._hungry_ns < self.starved_after_ns:
            return Verdict.NONE  # a confirmed beacon may hold its LED on for as long as it likes
        self.demoted = True
        return Verdict.STARVED

    def end_of(self, character: Character) -> int:
        """Return the nominal end of a character (ns, sensor clock)."""
        return character.t_ns + round(self._layout.duration_ns(character.bit_rate_bps))

    def checked_end_of(self, character: Character) -> int:
        """Return the nominal end of a character's data and parity, where its stop bits begin (ns, sensor clock)."""
        return self.end_of(character) - round(self._layout.stop_bits * NS_PER_S / character.bit_rate_bps)

    def _count(self, character: Character) -> None:
        status = character.status
        self.characters += 1
        self.ok += status is Status.OK
        self.repaired += status is Status.REPAIRED
        self.parity_errors += status is Status.PARITY_ERROR
        self.framing_errors += status is Status.FRAMING_ERROR
        free = status is Status.REPAIRED and character.read_freely
        right = status is Status.OK or free or (status is Status.FRAMING_ERROR and self._layout.parity_bits > 0)
        self._rights.append(right)
        sure = status is Status.OK or (free and character.confidence >= self._p.confirm_free_confidence)
        vouches = sure and not self._slipped(character)
        counted = _Counted(character.code, character.frame, character.confidence, character.edge_spread, vouches)
        self._window.append(counted)
        if vouches:
            self._vouched.append(counted)
        self._last_start_ns = character.t_ns

    def _slipped(self, character: Character) -> bool:
        if self._last_start_ns is None:
            return False
        bits = (character.t_ns - self._last_start_ns) * character.bit_rate_bps / NS_PER_S
        return bits < self._layout.length - SLIPPED_BITS

    @property
    def _failing(self) -> bool:
        return sum(self._rights) < self._p.judged_right

    def _judge_beacon(self) -> Verdict:
        self._failures = self._failures + 1 if self._failing else 0
        if self._failures < self._p.judged_characters:
            return Verdict.NONE
        self.confirmed = False
        self.demoted = True
        return Verdict.DEMOTED

    def _vouched_for(self) -> bool:
        p = self._p
        vouching = [counted for counted in self._window if counted.vouches]
        if len(self._window) < p.confirm_window or len(vouching) < p.confirm_ok:
            return False
        if len({counted.code for counted in vouching}) < p.confirm_distinct_codes:
            return False
        confidence = median(counted.confidence for counted in vouching)
        if confidence < p.confirm_confidence:
            return False
        return p.allow_periodic or not self._could_be_a_lamp(vouching, confidence)

    def _could_be_a_lamp(self, vouching: Sequence[_Counted], confidence: float) -> bool:
        """Tell whether a window that passes otherwise may be light that only repeats.

        One that lies on a comb is a lamp's where it is blurred; where it is not quite sharp, one such window may be a
        lamp's by chance, and another one is asked for that has no character in common with it.  The same is asked where
        the edges stray from the borders of the bits; and what such a line has said so far must not be a few codes again
        and again, on a comb least of all.
        """
        p = self._p
        codes = [counted.code if counted.vouches else None for counted in self._window]
        if any(repeats(codes, period, p.confirm_repeats) for period in range(1, p.confirm_period + 1)):
            return True
        frames = [counted.frame for counted in vouching]
        if regular_share(frames, self._layout.length) > p.confirm_regular:
            return True
        spread = median(counted.edge_spread for counted in vouching)
        if spread > p.confirm_edge_most:
            return True
        if spread > p.confirm_edge_spread:
            equal = equal_share([counted.code for counted in self._vouched])
            frames = [counted.frame for counted in self._vouched]
            if equal > p.confirm_equal:
                return True
            if equal > p.confirm_equal_on_comb and comb_share(frames, self._layout.length) > p.confirm_comb:
                return True
        elif confidence >= p.confirm_sure or comb_share(frames, self._layout.length) <= p.confirm_comb:
            return False
        elif confidence < p.confirm_sharp:
            return True
        if self._doubtful_at is None:
            self._doubtful_at = self.characters
        return self.characters < self._doubtful_at + p.confirm_window


def repeats(codes: Sequence[int | None], period: int, share: float) -> bool:
    """Return whether more than ``share`` of the pairs of codes ``period`` apart are equal.

    Args:
        codes: codes in order, None for a character that does not vouch: a pair needs both.
        period: distance in characters.
        share: 0 to 1.  Pairs and not positions, because a slip of the stream spoils few pairs but shifts all positions.
    """
    pairs = [
        early == late
        for early, late in zip(codes, codes[period:], strict=False)
        if early is not None and late is not None
    ]
    return sum(pairs) > share * len(pairs)


def equal_share(codes: Sequence[int]) -> float:
    """Return the share of all pairs of codes that are equal (Friedman's index of coincidence): a text's is about 0.07."""
    pairs = len(codes) * (len(codes) - 1)
    return sum(count * (count - 1) for count in Counter(codes).values()) / pairs if pairs else 1.0


def regular_share(frames: Sequence[int], length: int) -> float:
    """Return the share of frames that one lamp could have sent: all falls at one spacing.

    A lamp falls once a period, so the falls in its frames, and the fall that ends a frame, are a period apart, read
    as m or m + 1 bits; the m is looked for that explains most frames.  A text's falls have all spacings.

    Args:
        frames: frames as read (first sent bit most significant).
        length: bits of a frame.
    """
    if not frames:
        return 0.0
    spacings = [_fall_spacings(frame, length) for frame in frames]
    return max(
        sum(shortest >= m and longest <= m + 1 for shortest, longest in spacings) for m in range(2, length + 1)
    ) / len(frames)


def comb_share(frames: Sequence[int], length: int) -> float:
    """Return the share of frames that one lamp could have sent of which edges were missed: all falls on one comb.

    Every frame starts at a fall of the lamp, so its other falls are whole periods later, within half a bit; the period
    is looked for that explains most frames.  Such a lamp stays in step with the frames only if some whole number of
    its periods is a frame, and the falls between then lie off the borders of bits: a sharp signal is none.

    Args:
        frames: frames as read (first sent bit most significant).
        length: bits of a frame.
    """
    if not frames:
        return 0.0
    explained = np.stack([_periods_of(frame, length) for frame in frames])
    return float(explained.mean(axis=0).max())


def _falls(frame: int, length: int) -> list[int]:
    """Return the places (bit) in a frame where a 0 follows a 1."""
    bits = [frame >> shift & 1 for shift in range(length - 1, -1, -1)]
    return [k for k in range(1, length) if bits[k - 1] and not bits[k]]


@lru_cache(maxsize=4096)
def _fall_spacings(frame: int, length: int) -> tuple[int, int]:
    """Return the shortest and the longest spacing (bit) of a frame's falls: its start, those within, its end."""
    falls = [0, *_falls(frame, length), length]
    spacings = [late - early for early, late in zip(falls, falls[1:], strict=False)]
    return min(spacings), max(spacings)


@lru_cache(maxsize=4096)
def _periods_of(frame: int, length: int) -> NDArray[np.bool_]:
    """Return which periods of 2 bits to a frame explain all falls within a frame, ``(n,)`` bool."""
    periods = np.arange(2.0, length + 0.01, 0.05)
    off = np.array([np.abs(fall - periods * np.rint(fall / periods)) for fall in _falls(frame, length)])
    return np.all(off.reshape(-1, len(periods)) <= 0.5 + 1e-9, axis=0)
