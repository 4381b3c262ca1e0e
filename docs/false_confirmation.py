#!/usr/bin/env python3
"""Work out how often noise and lamps are confirmed by chance; print the tables of confirmation.md.

    python docs/false_confirmation.py            # about six minutes
    python docs/false_confirmation.py --full     # all of the lamp sweep, about twenty-five minutes
"""

from __future__ import annotations

import argparse
import itertools
import math
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from beacon_comm.core.character import Character, Status
from beacon_comm.core.confirmation import SLIPPED_BITS, ParityRecord, Verdict
from beacon_comm.core.demodulator import ThresholdDemodulator, make_demodulator
from beacon_comm.core.events import NS_PER_S
from beacon_comm.core.framing import CharacterFrame
from beacon_comm.core.parameters import Parameters
from beacon_comm.evaluation.scoring import wilson_interval
from beacon_comm.simulation.led import Burst, LedModel, noise, square_wave

RATES_BPS = (20.0, 100.0, 504.0, 1000.0, 3125.0, 10_000.0)
T0_NS = 2**40
FRAME = CharacterFrame()
SONNET = """Shall I compare thee to a summer's day?
Thou art more lovely and more temperate:
Rough winds do shake the darling buds of May,
And summer's lease hath all too short a date;
Sometime too hot the eye of heaven shines,
And often is his gold complexion dimm'd;
And every fair from fair sometime declines,
By chance or nature's changing course untrimm'd;
But thy eternal summer shall not fade,
Nor lose possession of that fair thou ow'st;
Nor shall death brag thou wander'st in his shade,
When in eternal lines to time thou grow'st:
So long as men can breathe or eyes can see,
So long lives this, and this gives life to thee.
"""


# Lines that change at random, read by the real demodulator


@dataclass(frozen=True, slots=True)
class RandomLine:
    """A line that changes at random: its bits are ones with some probability, or its edges come with some density (1/bit)."""

    ones: float = 0.0
    density: float = 0.0

    @property
    def name(self) -> str:
        """What the tables call it."""
        return f'random edges, {self.density:g} a bit' if self.density else f'random bits, {self.ones:.0%} ones'

    def edges(self, bits: int, random: np.random.Generator) -> NDArray[np.float64]:
        """Return when the line changes (bit periods), the first time to 0, ``(n,)``."""
        if self.density:
            return np.cumsum(random.exponential(1 / self.density, round(bits * self.density)))
        line = np.concatenate(([True], random.random(bits) < self.ones))
        return np.flatnonzero(np.diff(line)).astype(float)


KINDS = (
    *(RandomLine(ones) for ones in (0.3, 0.5, 0.7)),
    *(RandomLine(density=density) for density in (0.1, 0.2, 0.3, 0.5, 1.0)),
)


def read(bit_rate_bps: float, events: tuple[NDArray[np.int64], NDArray[np.int8]]) -> list[Character]:
    """Return the characters that the paper's demodulator reads at one rate."""
    demodulator = ThresholdDemodulator(bit_rate_bps, Parameters(bit_rates=(bit_rate_bps,)))
    return demodulator.push(*events, int(events[0][-1]) + 1) + demodulator.flush()


def events_of_edges(t_bits: NDArray[np.float64], bit_rate_bps: float) -> tuple[NDArray[np.int64], NDArray[np.int8]]:
    """Return six events for each edge, the first one falling; ``t_bits`` (bit periods), ``(n,)``."""
    t_ns = T0_NS + np.rint(t_bits * NS_PER_S / bit_rate_bps).astype(np.int64)
    polarity = np.where(np.arange(len(t_ns)) % 2, 1, -1).astype(np.int8)
    return np.repeat(t_ns, 6), np.repeat(polarity, 6)


def random_lines(bits: int, bit_rate_bps: float) -> Iterator[tuple[str, list[Character]]]:
    """Yield what lines are, and what is read from ``bits`` bit periods of them."""
    random = np.random.default_rng(1)
    for kind in KINDS:
        yield kind.name, read(bit_rate_bps, events_of_edges(kind.edges(bits, random), bit_rate_bps))
    for density in (1, 10, 100):
        events = noise(density * bit_rate_bps, bits / bit_rate_bps, t0_ns=T0_NS, seed=2)
        yield f'noise events, {density} a bit', read(bit_rate_bps, events)


def vouching(characters: list[Character]) -> NDArray[np.bool_]:
    """Return which characters vouch, as the parity record has it, ``(n,)``."""
    p = Parameters()
    sure = [
        one.status == Status.OK
        or (one.status == Status.REPAIRED and one.read_freely and one.confidence >= p.confirm_free_confidence)
        for one in characters
    ]
    t_ns = np.array([one.t_ns for one in characters])
    bits = np.diff(t_ns, prepend=t_ns[:1] - NS_PER_S) * np.array([one.bit_rate_bps for one in characters]) / NS_PER_S
    return np.array(sure, np.bool_) & (bits >= FRAME.length - SLIPPED_BITS)


def chances(characters: list[Character]) -> tuple[float, float, float, float]:
    """Return the shares of characters that vouch, are ok, have the right parity, and of windows that vary as text.

    The last is the share of 12 random ones of those that vouch, as if they came in a row and all others were wrong.
    """
    statuses = np.array([character.status for character in characters])
    ok = statuses == Status.OK
    vouches = vouching(characters)
    right = statuses != Status.PARITY_ERROR
    varies = varied([characters[k] for k in np.flatnonzero(vouches)])
    return float(vouches.mean()), float(ok.mean()), float(right.mean()), varies


def varied(vouchers: list[Character], trials: int = 2000) -> float:
    """Return the share of windows drawn from characters that the rules on variety let pass."""
    p = Parameters(confirm_window=12, judged_last=1, judged_right=0)
    random, passed = np.random.default_rng(5), 0
    for drawn in random.integers(len(vouchers), size=(trials, p.confirm_window)):
        record = ParityRecord(p)
        for k, index in enumerate(drawn):
            record.push(replace(vouchers[index], t_ns=k * NS_PER_S))
        passed += record.confirmed
    return passed / trials


# The chance that such a line is confirmed, exactly, if its characters are independent


def confirmations_per_character(vouches: float, right: float, p: Parameters, judgements: int = 8) -> float:
    """Return the expected number of confirmations for each counted character.

    The state is the window of who vouched and which of the last parities were right; a turn ends with its rejection
    or confirmation, and the next one starts afresh.  That codes must vary is left out.

    Args:
        vouches: chance of a character to vouch.
        right: chance of its parity to be right; who vouches is right.
        p: the rules' numbers.
        judgements: turns are followed for so many; each is survived by one candidate in five or so.
    """
    window, last = 1 << p.confirm_window, 1 << p.judged_last
    counts = np.bitwise_count(np.arange(max(window, last)))
    enough = counts[:window] >= p.confirm_ok
    failing = counts[:last] < p.judged_right
    shares = np.zeros((window, last))
    shares[0, 0] = 1.0
    confirmed = characters = 0.0
    for count in range(1, judgements * p.judged_characters + 1):
        characters += shares.sum()
        after = np.zeros_like(shares)
        for voucher, parity, chance in ((1, 1, vouches), (0, 1, right - vouches), (0, 0, 1.0 - right)):
            moved = np.zeros((window, last))
            halves = shares.reshape(2, window // 2, 2, last // 2).sum(axis=(0, 2))
            moved[voucher::2, parity::2] = halves
            after += chance * moved
        shares = after
        if count % p.judged_characters == 0:
            shares[:, failing] = 0.0
        if count >= p.confirm_window:
            confirmed += shares[enough].sum()
            shares[enough] = 0.0
    return confirmed / characters


def print_random_lines(bits: int) -> None:
    """Print the table of random lines."""
    p = Parameters()
    print('\n## Lines that change at random, read at 504 bps\n')
    print('| line | counted characters a frame | parity right | ok | vouches | varied', end='')
    print(' | a candidate | a slot and hour, 504 bps | 10 kbps | 504 bps, slips vouching |')
    print('|---|---|---|---|---|---|---|---|---|---|')
    for name, characters in random_lines(bits, 504.0):
        vouches, ok, right, varies = chances(characters)
        per_character = confirmations_per_character(vouches, right, p) * varies
        counted = len(characters) / (bits / FRAME.length)
        hours = [counted * rate / FRAME.length * 3600 for rate in (504.0, 10_000.0)]
        slipping = confirmations_per_character(ok, right, p) * varies
        print(
            f'| {name} | {counted:.2f} | {right:.3f} | {ok:.3f} | {vouches:.3f} | {varies:.3f} |'
            f' {per_character * p.turn_characters:.1e} | {per_character * hours[0]:.1e} |'
            f' {per_character * hours[1]:.1e} | {slipping * hours[0]:.1e} |'
        )


def characters_after(kind: RandomLine, runs: int, bit_rate_bps: float = 504.0) -> list[list[Character]]:
    """Return what the sequence receiver reads, run by run, after a beacon that it has locked on turns into a random line."""
    random = np.random.default_rng(7)
    text = np.concatenate(([1], FRAME.encode_bits(SONNET[:60]), [1])).astype(np.int64)
    from_text, behind_ns = np.flatnonzero(np.diff(text)).astype(float), len(text) * NS_PER_S / bit_rate_bps
    found = []
    for _ in range(runs):
        edges = np.concatenate((from_text, len(text) + kind.edges(40 * FRAME.length, random)))
        demodulator = make_demodulator(Parameters(bit_rates=(bit_rate_bps,), rate_search='listed'))
        events = events_of_edges(edges, bit_rate_bps)
        characters = demodulator.push(*events, int(events[0][-1]) + 1) + demodulator.flush()
        found.append([character for character in characters if character.t_ns >= T0_NS + behind_ns])
    return found


def print_sequence(bits: int, runs: int) -> None:
    """Print what is left to chance with the sequence receiver: whether it locks, and what vouches behind a lock that it had."""
    p = Parameters()
    print('\n## The sequence receiver on them\n')
    print('| line | frames without a lock | characters behind a lock | vouch | after one that does | a lock (97.5 %) |')
    print('|---|---|---|---|---|---|')
    for kind in KINDS:
        edges = events_of_edges(kind.edges(bits, np.random.default_rng(3)), 504.0)
        demodulator = make_demodulator(Parameters(bit_rates=(504.0,), rate_search='listed'))
        locked = len(demodulator.push(*edges, int(edges[0][-1]) + 1) + demodulator.flush())
        lines = [vouching(characters) for characters in characters_after(kind, runs)]
        count, some = sum(map(len, lines)), sum(int(line.sum()) for line in lines)
        before = sum(int(line[:-1].sum()) for line in lines)
        again = sum(int((line[:-1] & line[1:]).sum()) for line in lines)
        most = max(wilson_interval(some / count, count).high, again / max(before, 1))
        chance = confirmations_per_character(most, 0.5, p) * p.turn_characters
        print(
            f'| {kind.name} | {bits / FRAME.length:.0f}{f", but {locked} characters" if locked else ""} | {count / runs:.1f} |'
            f' {some / count:.3f} | {again} of {before} | {chance:.1e} |'
        )


def print_paper_rule() -> None:
    """Print the chances of the paper's rule alone."""
    p = Parameters()
    passes = sum(math.comb(p.judged_last, k) for k in range(p.judged_right, p.judged_last + 1)) / 2**p.judged_last
    print(f"\nRandom parity passes one judgement of the paper's with probability {passes:.4f}.")


def print_check() -> None:
    """Print the calculation against counting, with a rule weak enough to be met by chance."""
    weak = Parameters(confirm_ok=7, allow_periodic=True, confirm_distinct_codes=1)
    ((_, characters),) = itertools.islice(random_lines(3_000_000, 504.0), 2, 3)
    vouches, _, right, _ = chances(characters)
    record, counted = ParityRecord(weak), 0
    for character in characters:
        counted += record.push(character) is Verdict.CONFIRMED
        if record.confirmed or record.demoted:
            record = ParityRecord(weak)
    expected = confirmations_per_character(vouches, right, weak) * len(characters)
    print(f'Check, with 7 of 15 instead of 12: {counted} confirmed, {expected:.0f} expected.')


# Lamps


def lamp_models() -> dict[str, LedModel]:
    """Return lamps near and far: events a transition, and how far they spread in time."""
    def model(events: float, variation: float, spread_s: float, stray_per_s: float) -> LedModel:
        burst = Burst(events, variation, 20e-6, spread_s, 1e-6, 0.0)
        return LedModel(burst, replace(burst, spread_s=spread_s / 2), stray_per_s)

    return {
        'sharp, 30 events': model(30, 0.2, 30e-6, 0),
        'blurred, 10 events': model(10, 0.3, 200e-6, 0),
        'faint, 4 events': model(4, 0.5, 150e-6, 50),
        'blurred and noisy': model(10, 0.5, 400e-6, 500),
    }


def confirmations(characters: list[Character], p: Parameters) -> int:
    """Return how often a stream is confirmed when it is tried again after each verdict."""
    record, confirmed = ParityRecord(p), 0
    for character in characters:
        confirmed += record.push(character) is Verdict.CONFIRMED
        if record.confirmed or record.demoted:
            record = ParityRecord(p)
    return confirmed


def print_lamps(full: bool) -> None:
    """Print the sweep of square waves."""
    grid = [*np.linspace(50, 1000, 54 if full else 7), 100.0, 120.0, 200.0, 240.0, 360.0, 480.0]
    duties = np.linspace(0.1, 0.9, 9 if full else 5)
    frames = 150 if full else 60
    rules = {
        'all rules': Parameters(),
        'no confidence': Parameters(confirm_confidence=0.0),
        'no regularity': Parameters(allow_periodic=True),
        'neither': Parameters(allow_periodic=True, confirm_confidence=0.0),
    }
    print(f'\n## Square waves: {len(grid)} frequencies and those in step with frames × {len(duties)} duties × 6 rates\n')
    print('| lamp | characters | confirmed | ' + ' | '.join(list(rules)[1:]) + ' |')
    print('|---|---|---|' + '---|' * (len(rules) - 1))
    for name, model in lamp_models().items():
        total, confirmed = 0, dict.fromkeys(rules, 0)
        for rate, frequency, duty in itertools.product(RATES_BPS, [*grid, *range(-9, 0)], duties):
            if frequency < 0:  # so many periods a frame
                frequency = -frequency * rate / FRAME.length
                if not 50.0 <= frequency <= 1000.0:
                    continue
            seconds = max(frames * FRAME.length / rate, 30 / frequency)
            events = square_wave(float(frequency), float(duty), seconds, t0_ns=T0_NS, model=model, seed=total)
            characters = read(rate, events) if len(events[0]) else []
            total += len(characters)
            for rule, p in rules.items():
                confirmed[rule] += confirmations(characters, p)
        print(f'| {name} | {total} | ' + ' | '.join(str(count) for count in confirmed.values()) + ' |', flush=True)


# The price for beacons


def texts() -> Iterator[tuple[str, list[str]]]:
    """Yield kinds of text, each as texts of one beacon."""
    random = np.random.default_rng(3)

    def letters(alphabet: str, count: int, all_different: bool = False) -> str:
        return ''.join(random.choice(list(alphabet), count, replace=not all_different))

    upper = 'ABCDEFGHIJKLMNOPQRSTUVWXYZ'
    yield 'sonnet', [SONNET]
    yield 'telemetry', [''.join(f'x={v[0]:.3f},y={v[1]:.3f},z={v[2]:.2f}\n' for v in random.normal(size=(100, 3)))]
    yield 'position sentences', [
        ''.join(f'$GPGGA,{t:06d},4807.{t % 997:03d},N,01131.000,E,1,08,0.9,545.4,M*47\r\n' for t in range(0, 40_000, 997))
    ]
    yield 'digits', [letters('0123456789', 2000)]
    yield 'upper-case letters', [letters(upper, 2000)]
    yield 'identities of 4 different, repeated', [letters(upper + '0123456789', 4, True) * 20 for _ in range(400)]
    yield 'identities of 8, any, repeated', [letters(upper + '0123456789', 8) * 10 for _ in range(400)]
    yield '7-bit bytes', [''.join(map(chr, random.integers(0, 128, 3000)))]


def delay(text: str, start: int, errors: float, confidence: float, random: np.random.Generator) -> float:
    """Return the counted characters until a beacon is confirmed that is seen from ``start`` on; inf: not at all."""
    p = Parameters()
    record, frame_ns = ParityRecord(p), round(FRAME.duration_ns(504.0))
    for k, letter in enumerate(text[start : start + 300]):
        status = Status.PARITY_ERROR if random.random() < errors else Status.OK
        code = ord(letter)
        record.push(Character(T0_NS + k * frame_ns, code, status, confidence, FRAME.frame_of(code), 504.0))
        if record.confirmed:
            return k + 1
        if record.demoted:
            record = ParityRecord(p)
    return math.inf


def print_price() -> None:
    """Print how many characters a beacon is confirmed after."""
    random = np.random.default_rng(4)
    print('\n## Characters until a beacon is confirmed: median / 95 of 100, and the share never confirmed in its text\n')
    print('| text | no errors | 5 % errors | 10 % errors | 10 % errors, confidence 0.3 |')
    print('|---|---|---|---|---|')
    for name, samples in texts():
        cells = []
        for errors, confidence in ((0.0, 0.9), (0.05, 0.9), (0.1, 0.9), (0.1, 0.3)):
            tries = 600 // len(samples)
            starts = [(text, int(s)) for text in samples for s in random.integers(0, max(1, len(text) - 75), tries)]
            found = np.array([delay(text, start, errors, confidence, random) for text, start in starts])
            never = np.isinf(found).mean()
            known = found[np.isfinite(found)]
            cells.append(f'{np.median(known):.0f} / {np.quantile(known, 0.95):.0f}, {never:.1%}')
        print(f'| {name} | ' + ' | '.join(cells) + ' |', flush=True)


def main() -> None:
    """Print everything."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('--full', action='store_true', help='all of the lamp sweep')
    full = parser.parse_args().full
    print_paper_rule()
    print_random_lines(1_000_000)
    print_sequence(1_000_000, 300 if full else 100)
    print_check()
    print_price()
    print_lamps(full)


if __name__ == '__main__':
    main()
