"""Scores of decoded characters against the truth, as the paper's section IV counts them.

A *transmission* is one sending of the truth, or the part of one that the recording holds (see
:mod:`beacon_comm.evaluation.held`).  Truth character k is due at ``start + k · T``, T = 11 / f, both fitted
(see :mod:`beacon_comm.evaluation.alignment`)::

    due         │k─1      │k        │k+1      │k+2          spaced by T
    match     ├─┼─┤     ├─┼─┤     ├─┼─┤     ├─┼─┤           a quarter of T to each side
    decoded     x          x   x              x   x
                right    right │  missing   wrong │         the nearest in a window is its match
                            inserted           inserted     what matches nothing

    message accuracy = 1 - wrong / characters    wrong: another code, missing, or inserted; not below 0
    bit accuracy     = 1 - wrong bits / (11 · characters)     a missing character is 11 wrong bits; inserted have none

A character is right if all of its data bits are (the published script's count; the parity bit does not matter).
Where no sending is found, message accuracy is 0 and bit accuracy 0.5 (section IV-C).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from beacon_comm.core.character import Character, Status
from beacon_comm.core.framing import CharacterFrame
from beacon_comm.evaluation.alignment import MATCH_DISTANCE, Sending, find_sendings
from beacon_comm.evaluation.held import Signal, held_characters
from beacon_comm.evaluation.repeats import with_repeats

NOT_FOUND_MESSAGE_ACCURACY = 0.0
NOT_FOUND_BIT_ACCURACY = 0.5


@dataclass(frozen=True, slots=True)
class Interval:
    """Confidence interval of a share."""

    low: float
    high: float


@dataclass(frozen=True, slots=True)
class CharacterError:
    """One wrong truth character.

    Attributes:
        k: its position in the truth.
        due_ns: when it was due (ns, sensor clock).
        sent: its code.
        received: what was decoded in its place, None if nothing was.
    """

    k: int
    due_ns: int
    sent: int
    received: Character | None


@dataclass(frozen=True, slots=True)
class Transmission:
    """Score of one sending of the truth, or of the part of one that the recording holds.

    Attributes:
        start_ns: when truth character 0 was, or would have been, due (ns, sensor clock); None: no start found.
        bit_rate_bps: fitted bit rate f (bit/s); None: no start found.
        first: position in the truth of the first character that is held.
        characters: truth characters that are held.
        wrong: of these, decoded as another code, or missing; and what was inserted.
        missing: of the characters that are held, not decoded at all.
        wrong_ok: wrong (not missing) ones with the status ok.
        repaired: matched characters with the status repaired, right or wrong.
        inserted: decoded characters inside the sending without a match.
        bits: bits of the characters that are held.
        wrong_bits: of these, wrong.
        errors: the wrong characters.
    """

    start_ns: int | None
    bit_rate_bps: float | None
    first: int
    characters: int
    wrong: int
    missing: int
    wrong_ok: int
    repaired: int
    inserted: int
    bits: int
    wrong_bits: int
    errors: tuple[CharacterError, ...]

    @property
    def found(self) -> bool:
        """Whether a start was found."""
        return self.start_ns is not None

    @property
    def open_ended(self) -> bool:
        """Whether its first or its last character is missing: the sending may have begun later, or ended earlier."""
        outermost = {self.first, self.first + self.characters - 1}
        return any(error.received is None and error.k in outermost for error in self.errors)

    @property
    def message_accuracy(self) -> float:
        """1 - wrong / characters, 0 at least."""
        if not self.found:
            return NOT_FOUND_MESSAGE_ACCURACY
        return max(0.0, 1.0 - self.wrong / self.characters)

    @property
    def bit_accuracy(self) -> float:
        """1 - wrong bits / bits."""
        return 1.0 - self.wrong_bits / self.bits if self.found else NOT_FOUND_BIT_ACCURACY

    @property
    def message_interval(self) -> Interval:
        """95 % confidence interval of the message accuracy (Wilson), as if characters erred independently."""
        return wilson_interval(self.message_accuracy, self.characters)

    @property
    def bit_interval(self) -> Interval:
        """95 % confidence interval of the bit accuracy (Wilson), as if bits erred independently."""
        return wilson_interval(self.bit_accuracy, self.bits)


def wilson_interval(share: float, trials: int, z: float = 1.959964) -> Interval:
    """Return the confidence interval of a share of ``trials`` (E. B. Wilson, 1927); z = 1.96 for 95 %."""
    if trials <= 0:
        return Interval(0.0, 1.0)
    scale = 1.0 + z * z / trials
    centre = (share + z * z / (2.0 * trials)) / scale
    half = z / scale * math.sqrt(share * (1.0 - share) / trials + z * z / (4.0 * trials * trials))
    return Interval(max(0.0, centre - half), min(1.0, centre + half))


def score(
    characters: Sequence[Character],
    truth: str,
    span_ns: tuple[int, int],
    signal: Signal | None = None,
    frame: CharacterFrame | None = None,
) -> tuple[Transmission, ...]:
    """Score one beacon's decoded characters.

    Args:
        characters: what was decoded.
        truth: text that was sent, any number of times.
        span_ns: first event and end of the recording (ns, sensor clock).
        signal: the beacon's own events, to tell where it stopped sending; None: it sent as long as the recording is.
        frame: layout of a character on the line; the default layout if None.

    Returns:
        Transmissions in order of time; empty if no start was found (see :func:`not_found`).

    Raises:
        FramingError: a character of the truth does not fit into the data bits.
    """
    frame = CharacterFrame() if frame is None else frame
    bits = frame.encode_bits(truth).reshape(len(truth), frame.length)
    if not characters or not truth:
        return ()
    ordered = sorted(characters, key=lambda character: character.t_ns)
    t_ns = np.array([character.t_ns for character in ordered], np.int64)
    codes = np.array([character.code for character in ordered], np.int64)
    sent = np.array([ord(symbol) for symbol in truth], np.int64)
    bit_rate_bps = float(np.median([character.bit_rate_bps for character in ordered]))
    sendings = with_repeats(find_sendings(t_ns, codes, sent, bit_rate_bps, frame.length), len(truth))
    if not sendings:
        return ()
    transmissions = []
    for sending, limits_ns in zip(sendings, _limits(sendings, span_ns), strict=True):
        first, stop = held_characters(sending, bits, limits_ns, signal)
        if stop > first:
            a, b = np.searchsorted(t_ns, np.rint([sending.due_ns(first - 0.25), sending.due_ns(stop - 0.25)]))
            transmissions.append(_transmission(sending, first, stop, ordered[a:b], truth, frame))
    return tuple(transmissions)


def score_at(
    characters: Sequence[Character],
    truth: str,
    sent: Sequence[Transmission],
    frame: CharacterFrame | None = None,
) -> tuple[Transmission, ...]:
    """Score one beacon's decoded characters where it is known when what was sent.

    Nothing is searched for, so that a stream of which hardly anything can be read counts in full.

    Args:
        characters: what was decoded.
        truth: text that was sent.
        sent: sendings that were found before, in the same recording; only their time, rate and extent are used.
        frame: layout of a character on the line; the default layout if None.

    Returns:
        One score for each of ``sent``, of exactly its characters; a sending without a start has none.

    Raises:
        FramingError: a character of the truth does not fit into the data bits.
    """
    frame = CharacterFrame() if frame is None else frame
    ordered = sorted(characters, key=lambda character: character.t_ns)
    t_ns = np.array([character.t_ns for character in ordered], np.int64)
    transmissions = []
    for known in sent:
        if known.start_ns is None or known.bit_rate_bps is None:
            continue
        first, stop = known.first, known.first + known.characters
        sending = Sending(known.start_ns, frame.length * 1e9 / known.bit_rate_bps, first, stop - 1, 0.0)
        a, b = np.searchsorted(t_ns, np.rint([sending.due_ns(first - 0.25), sending.due_ns(stop - 0.25)]))
        transmissions.append(_transmission(sending, first, stop, ordered[a:b], truth, frame))
    return tuple(transmissions)


def not_found(truth: str, frame: CharacterFrame | None = None) -> Transmission:
    """Return the score of a beacon in which no start was found: message accuracy 0, bit accuracy 0.5."""
    n = len(truth)
    frame = CharacterFrame() if frame is None else frame
    return Transmission(None, None, 0, n, n, n, 0, 0, 0, n * frame.length, n * frame.length // 2, ())


def _limits(sendings: Sequence[Sending], span_ns: tuple[int, int]) -> list[tuple[float, float]]:
    """Return what each sending can lie in: the recording, up to the next sending's start.

    Where the next one's start, computed back, lies among characters of this one (the transmitter paused inside a
    text), the border is half-way between the characters that vouch for either.
    """
    borders = [float(span_ns[0])]
    for sending, following in pairwise(sendings):
        end = sending.due_ns(sending.last + 1)
        if following.start_ns >= end - 0.25 * sending.period_ns:
            borders.append(following.start_ns)
        else:
            borders.append((end + following.due_ns(following.first)) / 2.0)
    borders.append(float(span_ns[1]))
    return list(pairwise(borders))


def _transmission(
    sending: Sending, first: int, stop: int, inside: Sequence[Character], truth: str, frame: CharacterFrame
) -> Transmission:
    """Match the decoded characters inside a sending with the truth characters ``first`` to ``stop``."""
    matches: dict[int, tuple[float, Character]] = {}
    for character in inside:
        position = (character.t_ns - sending.start_ns) / sending.period_ns
        k = round(position)
        distance = abs(position - k)
        if distance < MATCH_DISTANCE and first <= k < stop and (k not in matches or distance < matches[k][0]):
            matches[k] = (distance, character)
    errors = []
    wrong_bits = 0
    for k in range(first, stop):
        sent = ord(truth[k])
        received = matches[k][1] if k in matches else None
        if received is None:
            wrong_bits += frame.length
        else:
            wrong_bits += (received.frame ^ frame.frame_of(sent)).bit_count()
        if received is None or received.code != sent:
            errors.append(CharacterError(k, round(sending.due_ns(k)), sent, received))
    inserted = len(inside) - len(matches)
    return Transmission(
        start_ns=round(sending.start_ns),
        bit_rate_bps=frame.length * 1e9 / sending.period_ns,
        first=first,
        characters=stop - first,
        wrong=len(errors) + inserted,
        missing=sum(error.received is None for error in errors),
        wrong_ok=sum(error.received is not None and error.received.status is Status.OK for error in errors),
        repaired=sum(character.status is Status.REPAIRED for _, character in matches.values()),
        inserted=inserted,
        bits=(stop - first) * frame.length,
        wrong_bits=wrong_bits,
        errors=tuple(errors),
    )
