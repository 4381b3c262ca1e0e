#!/usr/bin/env python3
"""Compare every receiver's confidence with how often it is right, on stressed waveforms; write reliability.md and its figure.

    python docs/reliability.py                                # a minute or so: prints the page, draws nothing
    python docs/reliability.py --full --write                 # writes docs/reliability.md and docs/figures/reliability.png
    python docs/reliability.py --full --dump FILE.npz         # every judged character, to fit a calibration with

::

    real 30 m recordings, simulated sonnets ─► stress of a random severity ─► receiver ─► characters: right or wrong?
    seeds    0   1   2   3   4   5 …
             fit     fit     fit               for whoever fits a map of confidences (the dump holds both halves)
                 page    page    page          what the page and the figure show
"""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, fields
from functools import lru_cache
from itertools import product
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from beacon_comm.core.character import Character, Status
from beacon_comm.core.events import NS_PER_S
from beacon_comm.core.framing import CharacterFrame
from beacon_comm.core.parameters import Parameters
from beacon_comm.core.receiver import SignalReceiver
from beacon_comm.evaluation.held import Signal
from beacon_comm.evaluation.receivers import declared_receivers
from beacon_comm.evaluation.reliability import (
    BIN_EDGES,
    OUTSIDE,
    Bin,
    Due,
    expected_calibration_error,
    judged,
    reliability_bins,
)
from beacon_comm.evaluation.scoring import score, wilson_interval
from beacon_comm.evaluation.truth import SONNET18
from beacon_comm.recordings.folder import recordings_folder
from beacon_comm.recordings.mat import read_mat
from beacon_comm.simulation import stress
from beacon_comm.simulation.led import simulate_text

Events = tuple[NDArray[np.int64], NDArray[np.int8]]
Random = np.random.Generator

PROJECT = Path(__file__).resolve().parents[1]
PAGE = PROJECT / 'docs' / 'reliability.md'
FIGURE = PROJECT / 'docs' / 'figures' / 'reliability.png'
LISTED_BPS = (504.0, 1000.0, 3125.0)
RECORDED = {'504hz_30m.mat': 504.0, '3125hz_30m.mat': 3125.0}
SIMULATED = {f'simulated, {bit_rate_bps:g} bps': bit_rate_bps for bit_rate_bps in LISTED_BPS}
T0_NS = NS_PER_S
BATCH_NS = 100_000_000
QUICK_SEEDS, FULL_SEEDS = 2, 8
RESAMPLED = 500
CODES = np.array([ord(symbol) for symbol in SONNET18], np.int64)


# Waveforms of which it is known what was sent when


@dataclass(frozen=True, slots=True)
class Waveform:
    """Events of one beacon, and what it sent.

    Attributes:
        t_ns, polarity: times (ns) ``(n,)`` int64 and ±1 ``(n,)`` int8.
        bit_rate_bps: nominal bit rate (bit/s).
        sendings: what was sent when, in order.
    """

    t_ns: NDArray[np.int64]
    polarity: NDArray[np.int8]
    bit_rate_bps: float
    sendings: tuple[Due, ...]


@lru_cache(maxsize=len(RECORDED))
def recorded(name: str) -> Waveform:
    """Return a real recording; what was sent when is found in what the paper's receiver reads of it, unstressed."""
    t_ns, polarity = read_mat(recordings_folder() / name)
    bit_rate_bps = RECORDED[name]
    characters = receive((t_ns, polarity), Parameters(receiver='threshold', bit_rates=(bit_rate_bps,)))
    sendings = []
    for sent in score(characters, SONNET18, (int(t_ns[0]), int(t_ns[-1])), Signal(t_ns, polarity)):
        if sent.start_ns is not None and sent.bit_rate_bps is not None:
            places = np.arange(sent.first, sent.first + sent.characters)
            period_ns = CharacterFrame().duration_ns(sent.bit_rate_bps)
            sendings.append(Due(sent.start_ns + np.rint(places * period_ns).astype(np.int64), CODES[places]))
    return Waveform(t_ns, polarity, bit_rate_bps, tuple(sendings))


def simulated(bit_rate_bps: float, random: Random) -> Waveform:
    """Return a sonnet of the LED model, its clock some 300 ppm off."""
    actual_bps = bit_rate_bps * (1.0 + random.normal(0.0, 3e-4))
    t_ns, polarity = simulate_text(SONNET18, actual_bps, t0_ns=T0_NS, seed=seed_from(random))
    due_ns = T0_NS + np.rint(np.arange(len(CODES)) * CharacterFrame().duration_ns(actual_bps)).astype(np.int64)
    return Waveform(t_ns, polarity, bit_rate_bps, (Due(due_ns, CODES),))


def seed_from(random: Random) -> int:
    """Draw a seed."""
    return int(random.integers(2**32))


# Stresses, each of a random severity


def warped(waveform: Waveform, warp: stress.Warp) -> Waveform:
    """Return a waveform whose time runs otherwise, for sender and events alike."""
    sendings = tuple(Due(warp.apply(due.t_ns), due.codes) for due in waveform.sendings)
    return Waveform(warp.apply(waveform.t_ns), waveform.polarity, waveform.bit_rate_bps, sendings)


def with_events(waveform: Waveform, events: Events) -> Waveform:
    """Return a waveform with other events of the same sendings."""
    return Waveform(*events, waveform.bit_rate_bps, waveform.sendings)


def thinned(w: Waveform, random: Random) -> Waveform:
    """25, 10, 5 or 3 % of the events."""
    share = float(random.choice([0.25, 0.1, 0.05, 0.03]))
    return with_events(w, stress.thinned(w.t_ns, w.polarity, share, seed_from(random)))


def clock(w: Waveform, random: Random) -> Waveform:
    """A clock that is off by up to 2 %."""
    return warped(w, stress.clock_warp(w.t_ns, 1.0 + random.uniform(-0.02, 0.02)))


def drifting_clock(w: Waveform, random: Random) -> Waveform:
    """A clock that swings by 0.5 to 4 % within a second."""
    return warped(w, stress.drift_warp(w.t_ns, float(random.choice([0.005, 0.01, 0.02, 0.04]))))


def jitter(w: Waveform, random: Random) -> Waveform:
    """Edges that come early or late, by 10 to 25 % of a bit."""
    starts_ns = [int(due.t_ns[0]) for due in w.sendings]
    share = float(random.choice([0.1, 0.15, 0.2, 0.25]))
    return with_events(
        w, stress.with_jitter(w.t_ns, w.polarity, w.bit_rate_bps, share, starts_ns, seed_from(random))
    )


def background(w: Waveform, random: Random) -> Waveform:
    """Background events, 1 to 4 for each event of the beacon."""
    ratio = float(random.choice([1.0, 2.0, 3.0, 4.0]))
    return with_events(w, stress.with_background(w.t_ns, w.polarity, ratio, seed_from(random)))


def gaps(w: Waveform, random: Random) -> Waveform:
    """Gaps of 1 to 50 bits, one in every 200 to 600 bits."""
    length = float(random.choice([1, 2, 5, 10, 20, 50]))
    every = random.uniform(200.0, 600.0)
    t_ns, polarity, _ = stress.with_gaps(w.t_ns, w.polarity, w.bit_rate_bps, length, every, seed_from(random))
    return with_events(w, (t_ns, polarity))


def fading(w: Waveform, random: Random) -> Waveform:
    """An amplitude that fades 10:1 to 50:1 within a second."""
    ratio = float(random.choice([10.0, 20.0, 50.0]))
    return with_events(w, stress.with_fading(w.t_ns, w.polarity, ratio, seed=seed_from(random)))


def leak(w: Waveform, random: Random) -> Waveform:
    """20 to 60 % of the events of the same beacon at another time."""
    other = stress.from_another_time(w.t_ns, w.polarity, random.uniform(0.2, 0.8))
    share = float(random.choice([0.2, 0.4, 0.6]))
    return with_events(w, stress.with_leak(w.t_ns, w.polarity, *other, share, seed_from(random)))


def faint_in_background(w: Waveform, random: Random) -> Waveform:
    """A quarter of the events, and background events 1:1."""
    few = stress.thinned(w.t_ns, w.polarity, 0.25, seed_from(random))
    return with_events(w, stress.with_background(*few, 1.0, seed_from(random)))


STRESSES: dict[str, Callable[[Waveform, Random], Waveform]] = {
    'thinned to 3 to 25 %': thinned,
    'clock up to 2 % off': clock,
    'clock drifting': drifting_clock,
    'jitter, 5 to 20 % of a bit': jitter,
    'background 0.5 to 2': background,
    'gaps of 1 to 50 bits': gaps,
    'fading 3 to 20:1': fading,
    'leak of 10 to 40 %': leak,
    'thinned to 25 %, background 1': faint_in_background,
}


# Runs


def receive(events: Events, parameters: Parameters) -> list[Character]:
    """Return the characters that a receiver gives out of one beacon's events, in pieces of 100 ms."""
    t_ns, polarity = events
    receiver = SignalReceiver(parameters)
    end_ns = int(t_ns[-1]) + 1
    cuts_ns = [*range(int(t_ns[0]) + BATCH_NS, end_ns, BATCH_NS), end_ns]
    outputs = []
    start = 0
    for cut_ns, stop in zip(cuts_ns, np.searchsorted(t_ns, cuts_ns).tolist(), strict=True):
        outputs.append(receiver.push_signal(t_ns[start:stop], polarity[start:stop], cut_ns))
        start = stop
    outputs.append(receiver.flush())
    return [received.character for output in outputs for received in output.characters]


@dataclass(frozen=True, slots=True)
class Judged:
    """Judged characters of one run or of many, one row each.

    Attributes:
        confidence: 0 to 1, float64.
        right: bool.
        status: of :class:`Status`, int8.
        receiver, stress, source: names.
        seed: of the run.
    """

    confidence: NDArray[np.float64]
    right: NDArray[np.bool_]
    status: NDArray[np.int8]
    receiver: NDArray[np.str_]
    stress: NDArray[np.str_]
    source: NDArray[np.str_]
    seed: NDArray[np.int64]

    def __len__(self) -> int:
        return len(self.confidence)

    def where(self, rows: NDArray[np.bool_]) -> Judged:
        """Return some of the rows."""
        return Judged(*(getattr(self, field.name)[rows] for field in fields(Judged)))

    @classmethod
    def joined(cls, parts: Sequence[Judged]) -> Judged:
        """Return all rows of several."""
        return cls(*(np.concatenate([getattr(part, field.name) for part in parts]) for field in fields(cls)))


@dataclass(frozen=True, slots=True)
class Job:
    """One waveform under one stress, for all receivers."""

    source: str
    stress: str
    seed: int
    receivers: dict[str, Parameters]

    def run(self) -> tuple[Judged, int]:
        """Return the judged characters, and how many lay outside every sending."""
        random = np.random.default_rng([self.seed, *self.source.encode(), 0, *self.stress.encode()])
        waveform = simulated(SIMULATED[self.source], random) if self.source in SIMULATED else recorded(self.source)
        stressed = STRESSES[self.stress](waveform, random)
        parts = []
        outside = 0
        for name, parameters in self.receivers.items():
            characters = receive((stressed.t_ns, stressed.polarity), parameters)
            verdicts = judged(characters, stressed.sendings)
            kept = verdicts != OUTSIDE
            outside += int(np.sum(~kept))
            count = int(kept.sum())
            parts.append(
                Judged(
                    np.array([character.confidence for character in characters], np.float64)[kept],
                    verdicts[kept] == 1,
                    np.array([character.status for character in characters], np.int8)[kept],
                    np.full(count, name),
                    np.full(count, self.stress),
                    np.full(count, self.source),
                    np.full(count, self.seed, np.int64),
                )
            )
        return Judged.joined(parts), outside


def run_job(job: Job) -> tuple[Judged, int]:
    """Run a job; for a pool of processes."""
    return job.run()


def run_jobs(jobs: Sequence[Job], processes: int) -> Iterator[tuple[Judged, int]]:
    """Run jobs, here or in a pool; yield in order."""
    if processes <= 1:
        yield from map(run_job, jobs)
        return
    with ProcessPoolExecutor(processes) as pool:
        yield from pool.map(run_job, jobs)


# Page


HEAD = """# Reliability of the confidence

A calibrated confidence of 0.99 is wrong once in a hundred times. Here is how often each receiver's is, on waveforms
that are hard to read ({sources}), each under the stresses of
[`stress.py`](../beacon_comm/simulation/stress.py) with random severities. Listed rates: {rates} bps.

A character is right if the character that was due in its place has its code; one decoded inside a sending in no character's
place, or second in one, is wrong. {outside} outside every sending (in pauses, before and after) are not judged; missing
ones have no confidence. Only odd seeds are shown here: a map of confidences may have been fitted on the even ones. The
simulated waveforms of the two halves differ; the recordings are the same, stressed otherwise.

Intervals of shares are 95 % (Wilson), as if characters erred independently; errors come in bursts, so they are too
narrow. The calibration error is the mean distance of confidence and share right over the bins below, its interval from
drawing whole runs anew {resampled} times. The Brier score is the mean squared error of the confidence; in brackets, that
of one and the same confidence for all.

```
python docs/reliability.py {arguments}
```

"""


def percent(share: float) -> str:
    """Return a share in percent, with the more digits the nearer it is to 1."""
    digits = 2 if share >= 1.0 else min(6, max(2, math.ceil(-math.log10(1.0 - share)) - 1))
    return f'{100 * share:.{digits}f} %'


def with_interval(right: int, count: int) -> str:
    """Return a share in percent, and its interval."""
    interval = wilson_interval(right / count, count)
    return f'{percent(right / count)} ({100 * interval.low:.2f} to {100 * interval.high:.2f})'


def table(head: Sequence[str], rows: Sequence[Sequence[object]]) -> list[str]:
    """Return the lines of a Markdown table, and an empty one."""
    lines = [head, ['---'] * len(head), *rows]
    return ['| ' + ' | '.join(str(cell) for cell in cells) + ' |' for cells in lines] + ['']


def error_interval(found: Judged) -> tuple[float, float]:
    """Return the 95 % interval of the expected calibration error: runs are drawn anew."""
    place = np.clip(np.searchsorted(BIN_EDGES, found.confidence, side='right') - 1, 0, len(BIN_EDGES) - 2)
    runs = np.unique(np.char.add(np.char.add(found.stress, found.source), found.seed.astype(str)), return_inverse=True)[1]
    sums = np.zeros((int(runs.max()) + 1, len(BIN_EDGES) - 1))
    np.add.at(sums, (runs, place), found.right - found.confidence)
    counts = np.bincount(runs)
    drawn = np.random.default_rng(0).integers(len(sums), size=(RESAMPLED, len(sums)))
    errors = [np.abs(sums[rows].sum(axis=0)).sum() / counts[rows].sum() for rows in drawn]
    low, high = np.quantile(errors, [0.025, 0.975])
    return float(low), float(high)


def summary(receivers: dict[str, Judged]) -> list[str]:
    """Return the table of all receivers."""
    rows = []
    for name, found in receivers.items():
        wrong = int(np.sum(~found.right))
        low, high = error_interval(found)
        brier = float(np.mean((found.confidence - found.right) ** 2))
        base = float(found.right.mean())
        rows.append(
            (
                name, len(found), wrong, percent(base), percent(float(found.confidence.mean())),
                f'{expected_calibration_error(reliability_bins(found.confidence, found.right)):.4f} ({low:.4f} to {high:.4f})',
                f'{brier:.4f} ({base * (1 - base):.4f})',
            )
        )  # fmt: skip
    head = ('receiver', 'characters', 'wrong', 'right', 'mean confidence', 'calibration error', 'Brier score')
    return table(head, rows)


def details(name: str, found: Judged) -> list[str]:
    """Return the tables of one receiver: bins, statuses, stresses."""
    lines = [f'## {name}', '']
    bins = reliability_bins(found.confidence, found.right)
    lines += table(
        ('confidence', 'characters', 'wrong', 'mean confidence', 'right (95 % interval)'),
        [
            (
                f'{one.low:g} to {one.high:g}', one.characters, one.characters - one.right, percent(one.confidence),
                with_interval(one.right, one.characters),
            )
            for one in bins
        ],
    )  # fmt: skip
    for title, column, kinds in (
        ('status', found.status, [(status.name, int(status)) for status in Status]),
        ('stress', found.stress, [(text, text) for text in STRESSES]),
        ('waveform', found.source, [(text, text) for text in (*RECORDED, *SIMULATED)]),
    ):
        rows = []
        for shown, value in kinds:
            some = found.where(column == value)
            if len(some):
                calibration = expected_calibration_error(reliability_bins(some.confidence, some.right))
                rows.append(
                    (
                        shown, len(some), int(np.sum(~some.right)), percent(some.confidence.mean()),
                        with_interval(int(some.right.sum()), len(some)), f'{calibration:.4f}',
                    )
                )  # fmt: skip
        lines += table((title, 'characters', 'wrong', 'mean confidence', 'right (95 % interval)', 'calibration error'), rows)
    return lines


def page(receivers: dict[str, Judged], outside: int, sources: Sequence[str], arguments: Sequence[str], figure: bool) -> str:
    """Return the whole page."""
    head = HEAD.format(
        sources=', '.join(sources),
        rates=', '.join(f'{bit_rate_bps:g}' for bit_rate_bps in LISTED_BPS),
        outside=outside,
        resampled=RESAMPLED,
        arguments=' '.join(arguments),
    )
    lines = ['![Share right against confidence](figures/reliability.png)', ''] if figure else []
    lines += summary(receivers)
    for name, found in receivers.items():
        lines += details(name, found)
    return head + '\n'.join(lines)


# Figure


def log_odds(share: NDArray[np.float64] | float, least: float = 2e-7) -> NDArray[np.float64]:
    """Return natural log odds of shares, bounded to where the figure ends."""
    inside = np.clip(share, least, 1.0 - least)
    return np.asarray(np.log(inside / (1.0 - inside)))


def draw(receivers: dict[str, Judged], path: Path) -> None:
    """Draw share right against confidence, both by their log odds, and how many characters have which."""
    import matplotlib

    matplotlib.use('Agg')
    from matplotlib import pyplot as plt

    ticks = np.array([0.01, 0.1, 0.5, 0.9, 0.99, 0.999, 0.9999, 0.99999, 0.999999])
    labels = [f'{100 * tick:.10g} %' for tick in ticks]
    limits = (float(log_odds(0.003)), float(log_odds(1.0)) + 0.5)
    figure, axes = plt.subplots(
        2, len(receivers), figsize=(4.6 * len(receivers) + 0.6, 6.8), height_ratios=(3, 1), sharex=True, sharey='row',
        squeeze=False, layout='constrained',
    )  # fmt: skip
    for (name, found), top, bottom in zip(receivers.items(), axes[0], axes[1], strict=True):
        bins = reliability_bins(found.confidence, found.right)
        x = np.maximum(log_odds(np.array([one.confidence for one in bins])), limits[0] + 0.15)
        y = np.maximum(log_odds(np.array([one.share for one in bins])), limits[0] + 0.15)
        low = log_odds(np.array([one.interval.low for one in bins]))
        high = log_odds(np.array([one.interval.high for one in bins]))
        top.plot(limits, limits, color='0.6', linewidth=1, label='calibrated')
        top.errorbar(
            x, y, yerr=(np.maximum(y - low, 0.0), np.maximum(high - y, 0.0)), fmt='o', markersize=4, capsize=2,
            linewidth=1, color='tab:blue', label='share right, 95 %',
        )  # fmt: skip
        error = expected_calibration_error(bins)
        wrong = int(np.sum(~found.right))
        top.set_title(f'{name}\n{len(found):,} characters, {wrong:,} wrong, calibration error {error:.3f}', fontsize=9)
        top.set(xlim=limits, ylim=limits, yticks=log_odds(ticks))
        top.set_yticklabels(labels)
        top.grid(color='0.92')
        top.legend(loc='upper left', fontsize=8)
        draw_counts(bottom, bins)
        bottom.set_xticks(log_odds(ticks), labels, rotation=45, ha='right')
        bottom.set_xlabel('confidence (log odds)')
        bottom.grid(axis='y', color='0.92')
    axes[0, 0].set_ylabel('share right (log odds)')
    axes[1, 0].set_ylabel('characters')
    axes[1, 0].set_ylim(0.7, 30.0 * axes[1, 0].dataLim.ymax)
    axes[1, 0].legend(fontsize=8, loc='upper left', ncols=2)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=110)
    plt.close(figure)


def draw_counts(axes: object, bins: Sequence[Bin]) -> None:
    """Draw how many characters, and how many wrong ones, each bin holds."""
    left = log_odds(np.array([one.low for one in bins]))
    width = log_odds(np.array([one.high for one in bins])) - left
    counts = np.array([one.characters for one in bins])
    wrong = counts - np.array([one.right for one in bins])
    axes.bar(left, counts, width, align='edge', color='tab:blue', alpha=0.35, label='all')  # type: ignore[attr-defined]
    axes.bar(left, wrong, width, align='edge', color='tab:red', alpha=0.8, label='wrong')  # type: ignore[attr-defined]
    axes.set_axisbelow(True)  # type: ignore[attr-defined]
    axes.set_yscale('log')  # type: ignore[attr-defined]


def main() -> None:
    """Run the waveforms; print or write the page."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('--full', action='store_true', help=f'{FULL_SEEDS} seeds, not {QUICK_SEEDS}')
    parser.add_argument('--seeds', type=int, help='so many seeds, 2 at least')
    parser.add_argument('--receivers', help='only those with one of these words, separated by commas, in their names')
    parser.add_argument('--processes', type=int, default=1)
    parser.add_argument('--write', action='store_true', help='write docs/reliability.md and its figure')
    parser.add_argument('--dump', type=Path, help='write every judged character of both halves to this .npz file')
    arguments = parser.parse_args()
    seeds = arguments.seeds or (FULL_SEEDS if arguments.full else QUICK_SEEDS)
    if seeds < 2:
        parser.error('--seeds: 2 at least')
    sources = [*(name for name in RECORDED if (recordings_folder() / name).is_file()), *SIMULATED]
    if len(sources) == len(SIMULATED):
        print(f'no recordings at {recordings_folder()}: simulated waveforms only; set BEACON_COMM_DATA', file=sys.stderr)
    wanted = (arguments.receivers or '').split(',')
    declared = declared_receivers(bit_rates=LISTED_BPS)
    receivers = {name: parameters for name, parameters in declared.items() if any(word in name for word in wanted)}
    jobs = [Job(source, name, seed, receivers) for source, name, seed in product(sources, STRESSES, range(seeds))]
    parts: list[Judged] = []
    outside = 0
    for done, (job, (found, more)) in enumerate(zip(jobs, run_jobs(jobs, arguments.processes), strict=True), start=1):
        parts.append(found)
        outside += more if job.seed % 2 else 0
        print(f'\r{done} of {len(jobs)}', end='', file=sys.stderr, flush=True)
    print(file=sys.stderr)
    everything = Judged.joined(parts)
    if arguments.dump is not None:
        np.savez_compressed(arguments.dump, **{field.name: getattr(everything, field.name) for field in fields(Judged)})
    shown = everything.where(everything.seed % 2 == 1)
    by_receiver = {name: shown.where(shown.receiver == name) for name in receivers}
    by_receiver = {name: found for name, found in by_receiver.items() if len(found)}
    words = ['--full'] if arguments.full else []
    words += [f'--seeds {arguments.seeds}'] if arguments.seeds else []
    words += [f"--receivers '{arguments.receivers}'"] if arguments.receivers else []
    text = page(by_receiver, outside, sources, [*words, '--write'], arguments.write)
    if arguments.write:
        draw(by_receiver, FIGURE)
        PAGE.write_text(text)
    else:
        print(text)


if __name__ == '__main__':
    main()
