"""Confirmation by parity: whether what a demodulator reads is a beacon (the paper's section III, "Detection algorithm").

A candidate's *counted* characters are those its demodulator gives out (a silence gives none).  Three rules look at
them, each at the end of the record, so that a late verdict costs no more memory than an early one::

    counted characters   1 ...................15 .................30 ......
    reject (the paper)              last 5 |#####|         last 5 |#####|     at the 15th and every 15 after
    confirm (ours)       |###############|  last 15, at every character from the 15th on
    demote (the paper)   a confirmed beacon's last 5, at every character; 15 failures in a row
"""

from __future__ import annotations

from collections import deque
from enum import Enum

from beacon_comm.core.character import Character, Status
from beacon_comm.core.events import NS_PER_S
from beacon_comm.core.parameters import Parameters


class Verdict(Enum):
    """What a character, or the passing of time, changed."""

    NONE = 'nothing changed'
    CONFIRMED = 'parity has vouched for the candidate'
    REJECTED = 'parity has failed the candidate'
    STARVED = 'too few characters to judge'
    DEMOTED = 'parity has failed the confirmed beacon'


class ParityRecord:
    """Judges one track by its characters since its slot was given.

    ========== ============================================================================== =========
    state      when                                                                           becomes
    ========== ============================================================================== =========
    candidate  every ``judged_characters`` counted: < ``judged_right`` of ``judged_last``     demoted
               parities right (REJECTED)
    candidate  fewer than ``judged_characters`` counted since the last judgement within       demoted
               ``starved_after_ns`` of time with events (STARVED)
    candidate  ``confirm_ok`` of the last ``confirm_window`` are ok, and they vary as text    confirmed
               does (CONFIRMED), unless it is rejected by the same character
    confirmed  ``judged_characters`` in a row, at each of which < ``judged_right`` of the     demoted
               last ``judged_last`` parities were right (DEMOTED)
    confirmed  not one counted character within ``starved_after_ns`` of time with events      demoted
               (STARVED)
    demoted    never: a track that is tried again gets a new record                           --
    ========== ============================================================================== =========

    With parity 'none' the status OK stands in for a right parity.  A REPAIRED character is neither ok nor right: the
    frame's structure that rescued it would have rescued noise as well.

    Attributes:
        characters, ok, repaired, parity_errors, framing_errors: counted characters since the slot was given.
        confirmed, demoted: the state; neither is a candidate.
        confirmed_at_ns: end of the character that confirmed it (ns, sensor clock), None before.
        starved_after_ns: see the table (ns); at the slowest listed rate a steady sender never starves.
    """

    def __init__(self, parameters: Parameters) -> None:
        self._p = parameters
        self._frame_bits = 1 + parameters.data_bits + (parameters.parity != 'none') + parameters.stop_bits
        judged_s = parameters.judged_characters * self._frame_bits * parameters.slowest_bit_s
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
        self._window: deque[Character] = deque(maxlen=parameters.confirm_window)
        self._failures = 0  # characters in a row at which the last parities failed a confirmed beacon
        self._hungry_ns = 0
        self._known_ns: int | None = None

    def push(self, character: Character) -> Verdict:
        """Count a character, in order of time; a demoted record counts on, but gives no further verdict."""
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
            self._hungry_ns = 0
            self.confirmed_at_ns = character.t_ns + round(self._frame_bits * NS_PER_S / character.bit_rate_bps)
            return Verdict.CONFIRMED
        return Verdict.NONE

    def advance(self, t_ns: int, quiet: bool) -> Verdict:
        """Move the record's time on; the time since the last call counts towards starving unless the track is quiet.

        Args:
            t_ns: stream time (ns); the first call only starts the clock.
            quiet: the track has no events now: silence keeps slot and record.
        """
        if self._known_ns is not None and not quiet:
            self._hungry_ns += max(0, t_ns - self._known_ns)
        self._known_ns = t_ns
        if self.demoted or self._hungry_ns < self.starved_after_ns:
            return Verdict.NONE
        self.confirmed = False
        self.demoted = True
        return Verdict.STARVED

    def _count(self, character: Character) -> None:
        status = character.status
        self.characters += 1
        self.ok += status is Status.OK
        self.repaired += status is Status.REPAIRED
        self.parity_errors += status is Status.PARITY_ERROR
        self.framing_errors += status is Status.FRAMING_ERROR
        right = status is Status.OK or (status is Status.FRAMING_ERROR and self._p.parity != 'none')
        self._rights.append(right)
        self._window.append(character)

    @property
    def _failing(self) -> bool:
        return sum(self._rights) < self._p.judged_right

    def _judge_beacon(self) -> Verdict:
        self._hungry_ns = 0
        self._failures = self._failures + 1 if self._failing else 0
        if self._failures < self._p.judged_characters:
            return Verdict.NONE
        self.confirmed = False
        self.demoted = True
        return Verdict.DEMOTED

    def _vouched_for(self) -> bool:
        p = self._p
        if len(self._window) < p.confirm_window:
            return False
        codes = [character.code for character in self._window if character.status is Status.OK]
        if len(codes) < p.confirm_ok or len(set(codes)) < p.confirm_distinct_codes:
            return False
        return p.allow_periodic or not any(
            repeats(tuple(self._window), period, p.confirm_repeats) for period in range(1, p.confirm_period + 1)
        )


def repeats(characters: tuple[Character, ...], period: int, share: float) -> bool:
    """Return whether the ok characters repeat: more than ``share`` of the ok pairs ``period`` apart are equal."""
    pairs = [
        early.code == late.code
        for early, late in zip(characters, characters[period:], strict=False)
        if early.status is Status.OK and late.status is Status.OK
    ]
    return bool(pairs) and sum(pairs) > share * len(pairs)
