#!/usr/bin/env python3
"""Start every receiver at random times of the real 30 m recordings; print the page random_starts.md.

    python docs/random_starts.py                                          # some minutes
    python docs/random_starts.py --output docs/random_starts.md           # writes the page
    python docs/random_starts.py --runs 5                                 # a quick look

::

    recording    ├──────────────────────────────────────────────────────────────────┤
    start        ·   ▲ random, within the first 60 %
    sent            k│  k+1 │ k+2 │ k+3 │ …                                      held to the end
    due              │ ├────┼─────┼─────┼────── every character whose start edge lies behind the start
    given out        │                     ▲ first one of them           ▲ each of the others
    lock             │ ├───────────────────┤
    decision delay                                         character's end ├──┤

What was sent when is told by the paper's receiver on the whole recording, for all receivers alike.  Batches of 10 ms,
but of one bit until the first character is out (and, for the delays, all along): that changes no character, only how
exactly it is known when it came.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from math import ceil
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from beacon_comm.core.character import Character, Status
from beacon_comm.core.demodulator import make_demodulator
from beacon_comm.core.events import NS_PER_S
from beacon_comm.core.framing import CharacterFrame
from beacon_comm.core.parameters import Parameters
from beacon_comm.evaluation.held import Signal
from beacon_comm.evaluation.scoring import Transmission, score, score_at
from beacon_comm.evaluation.truth import SONNET18
from beacon_comm.recordings.folder import recordings_folder
from beacon_comm.recordings.mat import read_mat

RECORDINGS = {'504hz_30m.mat': 504.0, '3125hz_30m.mat': 3125.0}
BOTH_BPS = tuple(RECORDINGS.values())
BATCH_NS = 10_000_000
LATEST_START = 0.6
SEED = 7
DEFAULT_RUNS = 50
WITHIN = 5
"""Locks within so many characters are counted; the bit that the batches are long is not held against them."""
FRAME = CharacterFrame()


@dataclass(frozen=True, slots=True)
class Recording:
    """A recording, and what it holds.

    Attributes:
        name: of the file.
        nominal_bps: nominal bit rate (bit/s).
        t_ns, polarity: times (ns) ``(n,)`` int64 and ±1 ``(n,)`` int8.
        sent: what was sent when.
    """

    name: str
    nominal_bps: float
    t_ns: NDArray[np.int64]
    polarity: NDArray[np.int8]
    sent: tuple[Transmission, ...]

    @property
    def fitted_bps(self) -> float:
        """The bit rate fitted to the longest sending (bit/s)."""
        longest = max(self.sent, key=lambda one: one.characters)
        assert longest.bit_rate_bps is not None
        return longest.bit_rate_bps

    @property
    def period_ns(self) -> float:
        """Duration of a character (ns)."""
        return FRAME.duration_ns(self.fitted_bps)

    def due_after(self, start_ns: int) -> tuple[Transmission, ...]:
        """Return what was sent from a start on: whole characters only; the recording's first event changes nothing."""
        if start_ns <= int(self.t_ns[0]):
            return self.sent
        found = []
        for one in self.sent:
            assert one.start_ns is not None and one.bit_rate_bps is not None
            first = max(one.first, ceil((start_ns - one.start_ns) / FRAME.duration_ns(one.bit_rate_bps)))
            if first < one.first + one.characters:
                found.append(replace(one, first=first, characters=one.first + one.characters - first))
        return tuple(found)


@dataclass(frozen=True, slots=True)
class Given:
    """A character, and the stream's time when it came out (ns); the end of the stream has its own."""

    character: Character
    at_ns: int


@dataclass(frozen=True, slots=True)
class Run:
    """One run of one receiver.

    Attributes:
        due, wrong, missing, inserted, wrong_ok, repaired: characters, added up over the sendings.
        before: characters given out of what was sent before the first one that is due: a fragment.
        given, ok: characters given out, and those of them with the status ok.
        lock: from the first due character's start to when the first of the due ones came out (characters), None: never.
        rate_bps, rate_std_bps: estimated bit rate at the end, and how sure the receiver says it is (bit/s).
        delays: of the characters after the lock, from their end to when they came out (bits), ``(n,)``.
    """

    due: int
    wrong: int
    missing: int
    inserted: int
    wrong_ok: int
    repaired: int
    before: int
    given: int
    ok: int
    lock: float | None
    rate_bps: float | None
    rate_std_bps: float | None
    delays: NDArray[np.float64]


def receivers(nominal_bps: float) -> dict[str, Parameters]:
    """Return the receivers by their names in the table, for a recording of a nominal bit rate (bit/s)."""
    both = ' and '.join(f'{bit_rate_bps:g}' for bit_rate_bps in BOTH_BPS)
    return {
        "the paper's (threshold), its rate listed": Parameters(receiver='threshold', bit_rates=(nominal_bps,)),
        'sequence, its rate listed': Parameters(receiver='sequence', rate_search='listed', bit_rates=(nominal_bps,)),
        f'sequence, {both} listed': Parameters(receiver='sequence', rate_search='listed', bit_rates=BOTH_BPS),
        'sequence, blind': Parameters(receiver='sequence', rate_search='blind'),
    }


def recorded(name: str, nominal_bps: float) -> Recording:
    """Return a recording; what was sent when is told by the paper's receiver, from the beginning on."""
    t_ns, polarity = read_mat(recordings_folder() / name)
    parameters = Parameters(receiver='threshold', bit_rates=(nominal_bps,))
    given, _ = decode(t_ns, polarity, parameters, lambda _: BATCH_NS)
    span_ns = int(t_ns[0]), int(t_ns[-1])
    sent = score([one.character for one in given], SONNET18, span_ns, Signal(t_ns, polarity))
    return Recording(name, nominal_bps, t_ns, polarity, tuple(one for one in sent if one.found))


def decode(
    t_ns: NDArray[np.int64], polarity: NDArray[np.int8], parameters: Parameters, step_ns: Callable[[bool], int]
) -> tuple[list[Given], tuple[float | None, float | None]]:
    """Demodulate a stream.

    Args:
        t_ns, polarity: the events.
        parameters: the receiver's.
        step_ns: length of the next batch (ns), given whether a character came out before.

    Returns:
        The characters, and the bit rate and its standard deviation at the end (bit/s), before the stream is flushed.
    """
    demodulator = make_demodulator(parameters)
    given: list[Given] = []
    start, now_ns, end_ns = 0, int(t_ns[0]), int(t_ns[-1]) + 1
    while now_ns < end_ns:
        now_ns = min(now_ns + step_ns(bool(given)), end_ns)
        stop = int(np.searchsorted(t_ns, now_ns))
        given += [Given(one, now_ns) for one in demodulator.push(t_ns[start:stop], polarity[start:stop], now_ns)]
        start = stop
    rate = demodulator.bit_rate_bps, demodulator.bit_rate_std_bps
    return given + [Given(one, end_ns) for one in demodulator.flush()], rate


def run(recording: Recording, start_ns: int, parameters: Parameters, by_bits: bool = False) -> Run:
    """Return one run from a start on.

    Args:
        recording: what to read.
        start_ns: where the stream begins (ns).
        parameters: the receiver's.
        by_bits: hand the stream over bit by bit to its end.
    """
    a = int(np.searchsorted(recording.t_ns, start_ns))
    t_ns, polarity = recording.t_ns[a:], recording.polarity[a:]
    bit_ns = round(NS_PER_S / recording.nominal_bps)
    given, (rate_bps, rate_std_bps) = decode(
        t_ns, polarity, parameters, lambda begun: bit_ns if by_bits or not begun else BATCH_NS
    )
    due = recording.due_after(start_ns)
    characters = [one.character for one in given]
    scores = score_at(characters, SONNET18, due)
    assert due[0].start_ns is not None
    first_ns = due[0].start_ns + due[0].first * recording.period_ns
    inside = [one for one in given if one.character.t_ns >= first_ns - 0.25 * recording.period_ns]
    lock = (inside[0].at_ns - first_ns) / recording.period_ns if inside else None
    delays = [
        (one.at_ns - one.character.t_ns - recording.period_ns) / (recording.period_ns / FRAME.length)
        for one in inside
        if inside[0].at_ns - recording.period_ns < one.character.t_ns and one.at_ns <= int(t_ns[-1])
    ]
    return Run(
        due=sum(one.characters for one in due),
        wrong=sum(one.wrong for one in scores),
        missing=sum(one.missing for one in scores),
        inserted=sum(one.inserted for one in scores),
        wrong_ok=sum(one.wrong_ok for one in scores),
        repaired=sum(one.repaired for one in scores),
        before=len(given) - len(inside),
        given=len(characters),
        ok=sum(one.status is Status.OK for one in characters),
        lock=lock,
        rate_bps=rate_bps,
        rate_std_bps=rate_std_bps,
        delays=np.array(delays),
    )


def starts(recording: Recording, runs: int) -> list[int]:
    """Return the beginning and ``runs`` random starts (ns), the same for every receiver."""
    first_ns, length_ns = int(recording.t_ns[0]), int(recording.t_ns[-1] - recording.t_ns[0])
    shares = np.random.default_rng(SEED).uniform(0.0, LATEST_START, runs)
    return [first_ns, *(first_ns + int(share * length_ns) for share in shares)]


# The page


def table(head: Sequence[str], rows: Sequence[Sequence[object]]) -> list[str]:
    """Return the lines of a Markdown table."""
    lines = [head, ['---'] * len(head), *rows]
    return ['| ' + ' | '.join(str(cell) for cell in line) + ' |' for line in lines] + ['']


def middle_and_worst(values: Sequence[float], digits: int = 1) -> str:
    """Return median and greatest of some values, as text."""
    return f'{np.median(values):.{digits}f}, {max(values):.{digits}f}' if len(values) else '–'


def errors(recording: Recording, name: str, runs: Sequence[Run]) -> tuple[object, ...]:
    """Return a row of the table of errors."""
    ok, given = sum(one.ok for one in runs), sum(one.given for one in runs)
    return (
        recording.name, name, len(runs), sum(one.due for one in runs), sum(one.wrong for one in runs),
        sum(one.missing for one in runs), sum(one.inserted for one in runs), sum(one.wrong_ok for one in runs),
        sum(one.repaired for one in runs), f'{ok / given:.4f}' if given else '–', max(one.wrong for one in runs),
        sum(one.wrong > 0 for one in runs), sum(one.before for one in runs),
    )  # fmt: skip


def times(recording: Recording, name: str, runs: Sequence[Run], by_bits: Run) -> tuple[object, ...]:
    """Return a row of the table of times and rates."""
    locks = [one.lock for one in runs if one.lock is not None]
    never = len(runs) - len(locks)
    bit_ms = 1e3 / recording.fitted_bps
    known = [(one.rate_bps, one.rate_std_bps) for one in runs if one.rate_bps is not None]
    off = [1e6 * (rate_bps / recording.fitted_bps - 1.0) for rate_bps, _ in known]
    stated = [1e6 * std_bps / recording.fitted_bps for _, std_bps in known if std_bps is not None]
    shown = known[0][0] if known else None
    delays = list(by_bits.delays)
    return (
        recording.name, name, middle_and_worst(locks) + (f' ({never} never)' if never else ''),
        f'{sum(lock <= WITHIN + 1 / FRAME.length for lock in locks)} of {len(runs)}',
        middle_and_worst(delays), middle_and_worst([bit_ms * delay for delay in delays]), len(delays),
        '–' if shown is None else f'{shown:.3f}', f'{recording.fitted_bps:.3f}',
        f'{np.sqrt(np.mean(np.square(off))):.0f}' if off else '–',
        f'{np.median(stated):.0f}' if stated else '–',
    )  # fmt: skip


HEAD = """# Random starts

A robot turns its head and a beacon comes into view anywhere in a sentence. Here every receiver starts at the beginning
and at {runs} random times within the first {share:.0f} % of each real 30 m recording (seed {seed}), and reads to its end.
Written by `python docs/random_starts.py --output docs/random_starts.md`{differs}.

*Due* are all characters whose start edge lies behind the start, by the fitted line and to where the signal ends, also
those that go by before a receiver has locked. *Wrong* counts other codes, missing and inserted ones. *Wrong but ok* had
the wrong code and the status `ok`. *Fragments* are characters that were given out for what lies before the first due
one, the cut one and before; they count neither as right nor as wrong. The share *ok* is of all characters given out.

"""

BETWEEN = """## Lock, delay and bit rate

*Lock*: from the start of the first due character until the first character of the message is out, in characters
({characters}). *Decision delay*, of the run from the beginning, handed over bit by bit: from a
character's nominal end until it is out, for the characters that end after the lock; it includes up to one bit of the
batch. The *estimated* rate is that of the run from the beginning at its end, the *fitted* one that of the scoring.
*Error* is the root mean square over all runs of the difference between the two, *stated* the median of the receiver's
own standard deviation: of its clock's period at that time, which follows the transmitter, and is no mean over the
recording.

*Within 5 characters* is more than can be promised of any text: a run of letters from `a` to `o` is `0 11 0xxxx p 11` again
and again, and begun three bits later it is a run of right frames as well (start bit 0, `xxxxp11`, whose parity is even if
the letter's is, stop bits 11). A lock waits for a character that tells the two apart.
"""


def page(runs: int) -> str:
    """Run everything; return the page."""
    recordings = [recorded(name, nominal_bps) for name, nominal_bps in RECORDINGS.items()]
    jobs = [(one, name, parameters) for one in recordings for name, parameters in receivers(one.nominal_bps).items()]
    error_rows, time_rows = [], []
    for done, (recording, name, parameters) in enumerate(jobs):
        found = []
        for k, start_ns in enumerate(starts(recording, runs)):
            print(f'\r{done + 1} of {len(jobs)}, run {k + 1} of {runs + 1}   ', end='', file=sys.stderr, flush=True)
            found.append(run(recording, start_ns, parameters))
        by_bits = run(recording, int(recording.t_ns[0]), parameters, by_bits=True)
        error_rows.append(errors(recording, name, found))
        time_rows.append(times(recording, name, found, by_bits))
    print(file=sys.stderr)
    lines = table(
        (
            'recording', 'receiver', 'runs', 'due', 'wrong', 'of these missing', 'inserted', 'wrong but ok', 'repaired',
            'ok', 'wrong in the worst run', 'runs with an error', 'fragments',
        ),
        error_rows,
    )  # fmt: skip
    durations = ', '.join(f'{one.period_ns / 1e6:.2f} ms at {one.nominal_bps:g} bps' for one in recordings)
    lines += BETWEEN.format(characters=durations).splitlines() + ['']
    lines += table(
        (
            'recording', 'receiver', 'lock (characters: median, worst)', f'within {WITHIN} and a bit',
            'decision delay (bits: median, worst)',
            '(ms: median, worst)', 'characters', 'estimated (bps)', 'fitted (bps)', 'error (ppm)', 'stated (ppm)',
        ),
        time_rows,
    )  # fmt: skip
    differs = '' if runs == DEFAULT_RUNS else f' with `--runs {runs}`'
    head = HEAD.format(runs=runs, share=100 * LATEST_START, seed=SEED, differs=differs)
    return head + '\n'.join(lines).rstrip() + '\n'


def main() -> None:
    """Print or write the page."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('--runs', type=int, default=DEFAULT_RUNS, help=f'random starts a recording ({DEFAULT_RUNS})')
    parser.add_argument('--output', type=Path, help='write the page to this file')
    arguments = parser.parse_args()
    if arguments.runs < 0:
        parser.error('--runs: not below 0')
    text = page(arguments.runs)
    if arguments.output is None:
        print(text, end='')
    else:
        arguments.output.write_text(text)


if __name__ == '__main__':
    main()
