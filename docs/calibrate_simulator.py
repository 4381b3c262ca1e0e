#!/usr/bin/env python3
"""Hold the simulator against the real 30 m recordings: edges, counts, bursts, and both receivers' error rates.

    python docs/calibrate_simulator.py --output docs/calibration.md        # a minute; the page, and its figure
    python docs/calibrate_simulator.py --check                             # exits with 1 where the stated margins do not hold
    python docs/calibrate_simulator.py --fit --sensor --steps 300          # search better values, and print them

What was sent when is known for the real recordings (the times of ``test_truth.py``), so that every event has a time since
the last edge of the line.  Their clock has no zero: how much later the line is than those times is fitted, too
(``SHIFT_US``).  The recordings hold the events of a region that never gives more than 49 in a burst, in
some nine rows: taken to be the 49 pixels within 4 px of its middle, and so from the simulation.

The simulated scenes are the files ``outdoor_30m.yaml`` and ``outdoor_30m_3125.yaml`` of ``config/scenes``, with the
sensor's defaults.
"""

from __future__ import annotations

import argparse
import sys
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from beacon_comm.core.demodulator import make_demodulator
from beacon_comm.core.events import NS_PER_S
from beacon_comm.core.framing import CharacterFrame, transitions
from beacon_comm.core.parameters import Parameters
from beacon_comm.evaluation import held
from beacon_comm.evaluation.scoring import score, wilson_interval
from beacon_comm.evaluation.truth import SONNET18, load_truth
from beacon_comm.recordings.folder import recordings_folder
from beacon_comm.recordings.mat import read_mat
from beacon_comm.simulation.description import SceneDescription, read_description
from beacon_comm.simulation.paths import Still
from beacon_comm.simulation.scene import simulate

PROJECT = Path(__file__).resolve().parents[1]
FIGURE = 'figures/simulator_calibration.png'
REGION_PX = 4.0  # 49 pixels
SIDE_PX = 41
BIN_US = 40.0
LONGEST_US = 1600.0
SEEDS = (2, 3, 4)  # the fit has seed 1
MARGIN = 0.03  # of message accuracy
ON_COLOUR, OFF_COLOUR = '#d9822b', '#3b6ea8'
FRAME = CharacterFrame()
RECEIVERS = ('threshold', 'sequence')


@dataclass(frozen=True, slots=True)
class Recorded:
    """A recording: its last sending's begin (s), rate (bit/s) and characters; the scene that simulates it."""

    start_s: float
    bit_rate_bps: float
    nominal_bps: float
    characters: int
    scene: str
    shift_us: float


RECORDINGS = {
    '504hz_30m': Recorded(12.3804, 503.83, 504.0, 264, 'outdoor_30m', -51.4),
    '3125hz_30m': Recorded(1.07076, 3123.74, 3125.0, 618, 'outdoor_30m_3125', -151.9),
}


@dataclass(frozen=True, slots=True, eq=False)
class Signal:
    """Events of the region, and the line: levels from each change on, until the end (ns)."""

    t_ns: NDArray[np.int64]
    polarity: NDArray[np.int8]
    changes_ns: NDArray[np.int64]
    levels: NDArray[np.uint8]
    end_ns: int
    bit_ns: float

    def first(self, share: float) -> Signal:
        """Return the first part of it."""
        stop = int(share * len(self.changes_ns))
        end_ns = int(self.changes_ns[stop])
        part = slice(*np.searchsorted(self.t_ns, (self.changes_ns[0], end_ns)))
        return Signal(
            self.t_ns[part], self.polarity[part], self.changes_ns[:stop], self.levels[:stop], end_ns, self.bit_ns
        )


def real_signal(name: str) -> Signal:
    """Return a recording from the begin of its last sending on, the line shifted to where the fit has it."""
    recorded = RECORDINGS[name]
    t_ns, polarity = read_mat(recordings_folder() / f'{name}.mat')
    start_ns = round(recorded.start_s * NS_PER_S + recorded.shift_us * 1e3)
    bits = FRAME.encode_bits(SONNET18[: recorded.characters])
    changes_ns, levels = transitions(bits, recorded.bit_rate_bps, start_ns)
    end_ns = start_ns + round(len(bits) / recorded.bit_rate_bps * NS_PER_S)
    part = slice(*np.searchsorted(t_ns, (start_ns - 50_000_000, end_ns)))
    return Signal(t_ns[part], polarity[part], changes_ns, levels, end_ns, NS_PER_S / recorded.bit_rate_bps)


def described(name: str) -> SceneDescription:
    """Return the scene that simulates a recording."""
    return read_description(PROJECT / 'config' / 'scenes' / f'{RECORDINGS[name].scene}.yaml', load_truth)[0]


def simulated_signal(name: str, scene: SceneDescription, characters: int, seed: int) -> Signal:
    """Return what the region sees of a scene's beacon when it sends the same, on a small sensor."""
    recorded = RECORDINGS[name]
    middle = 0.5 * (SIDE_PX - 1)
    (beacon,) = scene.beacons
    small = replace(
        scene,
        duration_s=round(0.06 + characters * 11 / recorded.bit_rate_bps, 3),
        beacons=(
            replace(
                beacon,
                text=SONNET18[:characters],
                bit_rate_bps=(recorded.bit_rate_bps,),
                clock_ppm=0.0,
                start_s=0.05,
                path=Still((middle, middle)),
            ),
        ),
        sensor=replace(scene.sensor, width=SIDE_PX, height=SIDE_PX, hot_share=0.0),
    )
    batches, truth = simulate(small, seed)
    events = list(batches)
    t_ns, x, y = (np.concatenate([getattr(batch, column) for batch in events]) for column in ('t_ns', 'x', 'y'))
    polarity = np.concatenate([batch.polarity for batch in events])
    inside = np.hypot(x - middle, y - middle) <= REGION_PX
    (sent,) = truth.beacons
    bit_ns = NS_PER_S / recorded.bit_rate_bps
    end_ns = int(sent.sendings_ns[0]) + round(characters * 11 * bit_ns)
    return Signal(t_ns[inside], polarity[inside], sent.changes_ns, sent.levels, end_ns, bit_ns)


def held_bits(signal: Signal) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return for how many bits the line was held before each change (9 before the first), and is held after it."""
    now = np.rint(np.diff(np.append(signal.changes_ns, signal.end_ns)) / signal.bit_ns).astype(np.int64)
    return np.concatenate(([9], now[:-1])), now


def profiles(signal: Signal, bin_us: float = BIN_US) -> dict[tuple[int, int, int], tuple[NDArray[np.float64], int]]:
    """Return the mean events since an edge, by kind of edge.

    Returns:
        For (level, bits held before: 1, 2 or 3 for more, bits held: the same) the mean number of ON and OFF events an edge
        in bins of ``bin_us``, ``(2, bins)``, and how many edges there were; rare kinds are left out.
    """
    before, now = held_bits(signal)
    part = slice(*np.searchsorted(signal.t_ns, (signal.changes_ns[0], signal.end_ns)))
    t_ns, polarity = signal.t_ns[part], signal.polarity[part]
    edge = np.searchsorted(signal.changes_ns, t_ns, side='right') - 1
    since = ((t_ns - signal.changes_ns[edge]) * 1e-3 // bin_us).astype(int)
    bins = int(LONGEST_US // bin_us)
    found = {}
    for level in (0, 1):
        for was in (1, 2, 3):
            for held_for in (1, 2, 3):
                chosen = (signal.levels == level) & (np.minimum(before, 3) == was) & (np.minimum(now, 3) == held_for)
                if chosen.sum() < 10:
                    continue
                mine = chosen[edge] & (since < bins)
                table = np.zeros((2, bins))
                np.add.at(table, ((polarity[mine] < 0).astype(int), since[mine]), 1.0)
                found[level, was, held_for] = (table / chosen.sum(), int(chosen.sum()))
    return found


def misfit(real: Signal, simulated: Signal) -> float:
    """Return how far two signals are apart: squared differences of root counts, a kind of edge by its number of edges."""
    theirs, ours = profiles(real), profiles(simulated)
    total, weight = 0.0, 0.0
    kernel = np.array([0.25, 0.5, 0.25])  # the bursts' exact phase is not what is fitted
    for kind, (table, edges) in theirs.items():
        if kind not in ours:
            continue
        mine = ours[kind][0]
        for a, b in zip(table, mine, strict=True):
            smooth = [np.sqrt(np.convolve(one, kernel, mode='same')) for one in (a, b)]
            total += edges * float(np.sum((smooth[0] - smooth[1]) ** 2))
        total += edges * 0.5 * float(np.sum((np.sqrt(table.sum(axis=1)) - np.sqrt(mine.sum(axis=1))) ** 2))
        weight += edges
    return total / weight + _lone_misfit(real, simulated)


def lone_counts(signal: Signal) -> dict[tuple[int, int], NDArray[np.int64]]:
    """Return the events of its own polarity of each lone bit, by (level, bits held before: 1, 2, 3 for more)."""
    before, now = held_bits(signal)
    part = slice(*np.searchsorted(signal.t_ns, (signal.changes_ns[0], signal.end_ns)))
    edge = np.searchsorted(signal.changes_ns, signal.t_ns[part], side='right') - 1
    own = (signal.polarity[part] > 0) == (signal.levels[edge] == 1)
    counts = np.bincount(edge[own], minlength=len(now))
    found = {}
    for level in (0, 1):
        for was in (1, 2, 3):
            chosen = (signal.levels == level) & (np.minimum(before, 3) == was) & (now == 1)
            if chosen.sum() >= 10:
                found[level, was] = counts[chosen]
    return found


def _lone_misfit(real: Signal, simulated: Signal) -> float:
    """Return how far the counts of lone bits are apart: their Wasserstein distance, in units of 15 events, squared."""
    theirs, ours = lone_counts(real), lone_counts(simulated)
    shares = np.linspace(0.02, 0.98, 49)
    total = sum(
        len(counts) * float(np.mean(np.abs(np.quantile(counts, shares) - np.quantile(ours[kind], shares)))) ** 2
        for kind, counts in theirs.items()
        if kind in ours
    )
    return total / 225.0 / max(sum(len(counts) for counts in theirs.values()), 1)


@dataclass(frozen=True, slots=True)
class Numbers:
    """What is compared; an edge's events are those of its polarity until the next edge.

    Attributes:
        a_bit: events a bit. on_to_off: their ratio.
        rise, fall: events an edge, their variation (deviation over mean), median latency (µs), 10–90 % width (µs), and the
            jitter: standard deviation of single edges' median latency (µs).
        silent_falls: share of lone 0s between 1s without any OFF event.
        burst_us: spacing of the bursts: where the autocorrelation peaks between 60 and 200 µs.
    """

    a_bit: float
    on_to_off: float
    rise: tuple[float, float, float, float, float]
    fall: tuple[float, float, float, float, float]
    silent_falls: float
    burst_us: float


def numbers(signal: Signal) -> Numbers:
    """Return the numbers of a signal."""
    part = slice(*np.searchsorted(signal.t_ns, (signal.changes_ns[0], signal.end_ns)))
    t_ns, polarity = signal.t_ns[part], signal.polarity[part]
    edge = np.searchsorted(signal.changes_ns, t_ns, side='right') - 1
    since_us = (t_ns - signal.changes_ns[edge]) * 1e-3
    sides = []
    for level, sign in ((1, 1), (0, -1)):
        mine = (signal.levels[edge] == level) & (polarity == sign)
        counts = np.bincount(edge[mine], minlength=len(signal.levels))[signal.levels == level]
        low, middle, high = np.percentile(since_us[mine], (10, 50, 90))
        stops = np.flatnonzero(np.diff(edge[mine])) + 1
        jitter = np.std([np.median(some) for some in np.split(since_us[mine], stops) if len(some) >= 10])
        spread = float(counts.std() / counts.mean())
        sides.append((float(counts.mean()), spread, float(middle), float(high - low), float(jitter)))
    before, now = held_bits(signal)
    lone = (signal.levels == 0) & (now == 1)
    off = np.bincount(edge[(polarity < 0)], minlength=len(signal.levels))
    bits = (signal.end_ns - signal.changes_ns[0]) / signal.bit_ns
    return Numbers(
        len(t_ns) / bits,
        float(np.count_nonzero(polarity > 0) / max(np.count_nonzero(polarity < 0), 1)),
        sides[0],
        sides[1],
        float(np.mean(off[lone] == 0)),
        burst_spacing_us(t_ns),
    )


def autocorrelation(t_ns: NDArray[np.int64], bin_us: float = 5.0) -> NDArray[np.float64]:
    """Return the autocorrelation of the counts in bins of ``bin_us``, from lag 0 to 400 µs, over its mean far from 0."""
    counts = np.bincount(((t_ns - t_ns[0]) * 1e-3 // bin_us).astype(np.int64)[: 1 << 21]).astype(float)
    size = 1 << (2 * len(counts) - 1).bit_length()
    spectrum = np.abs(np.fft.rfft(counts, size)) ** 2
    correlation = np.fft.irfft(spectrum)[: int(400 / bin_us)]
    return np.asarray(correlation / (counts.mean() ** 2 * len(counts)))


def burst_spacing_us(t_ns: NDArray[np.int64]) -> float:
    """Return the lag (µs) at which the autocorrelation peaks between 60 and 200 µs."""
    correlation = autocorrelation(t_ns)
    return 5.0 * float(12 + np.argmax(correlation[12:40]))


@dataclass(frozen=True, slots=True)
class Errors:
    """Characters that were due, and wrong (missing and inserted ones too), added up."""

    due: int
    wrong: int

    def text(self) -> str:
        """Return ``wrong of due, accuracy [interval]``."""
        share = 1.0 - self.wrong / max(self.due, 1)
        interval = wilson_interval(max(share, 0.0), self.due)
        return f'{self.wrong} of {self.due}: {share:.4f} [{interval.low:.4f}, {interval.high:.4f}]'


def errors(signal: Signal, name: str, receiver: str) -> Errors:
    """Return how a receiver, its rate listed, reads a signal."""
    parameters = Parameters(receiver=receiver, rate_search='listed', bit_rates=(RECORDINGS[name].nominal_bps,))
    demodulator = make_demodulator(parameters)
    characters = []
    begin_ns, end_ns = int(signal.t_ns[0]), int(signal.t_ns[-1]) + 1
    start = 0
    for until_ns in [*range(begin_ns + 10_000_000, end_ns, 10_000_000), end_ns]:
        stop = int(np.searchsorted(signal.t_ns, until_ns))
        characters += demodulator.push(signal.t_ns[start:stop], signal.polarity[start:stop], until_ns)
        start = stop
    characters += demodulator.flush()
    due = round((signal.end_ns - int(signal.changes_ns[0])) / signal.bit_ns / FRAME.length)
    found = score(characters, SONNET18, (begin_ns, end_ns), held.Signal(signal.t_ns, signal.polarity))
    best = max((one for one in found if one.found), key=lambda one: one.characters, default=None)
    if best is None:
        return Errors(due, due)
    return Errors(best.characters, best.wrong)


def added(parts: list[Errors]) -> Errors:
    """Return the sum of some."""
    return Errors(sum(one.due for one in parts), sum(one.wrong for one in parts))


@dataclass(frozen=True, slots=True, eq=False)
class Compared:
    """A recording and its simulations."""

    name: str
    real: Signal
    simulated: list[Signal]
    real_errors: dict[str, Errors]
    simulated_errors: dict[str, Errors]


def compared(name: str, seeds: tuple[int, ...]) -> Compared:
    """Measure a recording and its simulations."""
    real, scene = real_signal(name), described(name)
    simulated = [simulated_signal(name, scene, RECORDINGS[name].characters, seed) for seed in seeds]
    return Compared(
        name,
        real,
        simulated,
        {receiver: errors(real, name, receiver) for receiver in RECEIVERS},
        {receiver: added([errors(one, name, receiver) for one in simulated]) for receiver in RECEIVERS},
    )


def page(results: list[Compared], seeds: tuple[int, ...]) -> str:
    """Return ``docs/calibration.md``."""
    lines = [
        '# The simulator beside the real recordings',
        '',
        'Written by `python docs/calibrate_simulator.py --output docs/calibration.md`. What is simulated, and where it does',
        'not fit: [simulator.md](simulator.md#calibration). Real: the last sending of each recording; simulated: the same',
        f'characters with the seeds {", ".join(map(str, seeds))}, the 49 pixels around the beacon.',
        '',
        f'![Real and simulated edges, bursts and counts]({FIGURE})',
        '',
        '| | ' + ' | '.join(f'{one.name} real | simulated' for one in results) + ' |',
        '|---|' + '---|---|' * len(results),
    ]
    pairs = [(numbers(one.real), numbers(one.simulated[0])) for one in results]
    flat = [value for pair in pairs for value in pair]
    rows = [
        ('events a bit', [f'{one.a_bit:.0f}' for one in flat]),
        ('ON to OFF', [f'{one.on_to_off:.2f}' for one in flat]),
        ('spacing of the bursts (µs)', [f'{one.burst_us:.0f}' for one in flat]),
        ('lone 0s without an OFF event', [f'{one.silent_falls:.2%}' for one in flat]),
    ]
    for side in ('rise', 'fall'):
        values = [getattr(one, side) for one in flat]
        rows += [
            (f'{side}: events until the next edge', [f'{value[0]:.0f}' for value in values]),
            (f'{side}: their variation', [f'{value[1]:.0%}' for value in values]),
            (f'{side}: median latency (µs)', [f'{value[2]:.0f}' for value in values]),
            (f'{side}: 10–90 % width (µs)', [f'{value[3]:.0f}' for value in values]),
            (f'{side}: jitter of an edge (µs)', [f'{value[4]:.0f}' for value in values]),
        ]
    lines += [f'| {title} | ' + ' | '.join(cells) + ' |' for title, cells in rows]
    lines += [
        '',
        'Both receivers, the rate listed; wrong characters (missing and inserted ones too) and message accuracy with its',
        '95 % interval (Wilson):',
        '',
        '| recording | receiver | real | simulated | simulated better by (points) |',
        '|---|---|---|---|---|',
    ]
    for one in results:
        for receiver, real in one.real_errors.items():
            mine = one.simulated_errors[receiver]
            difference = 100.0 * (real.wrong / real.due - mine.wrong / mine.due)
            lines.append(f'| {one.name} | {receiver} | {real.text()} | {mine.text()} | {difference:+.1f} |')
    return '\n'.join([*lines, ''])


def check(results: list[Compared]) -> list[str]:
    """Return where simulated and real differ by more than ``docs/simulator.md`` states."""
    found = []
    for one in results:
        real, mine = numbers(one.real), numbers(one.simulated[0])
        pairs = [('events a bit', real.a_bit, mine.a_bit, 0.05), ('ON to OFF', real.on_to_off, mine.on_to_off, 0.1)]
        for side in ('rise', 'fall'):
            a, b = getattr(real, side), getattr(mine, side)
            pairs += [(f'{side}: events', a[0], b[0], 0.1), (f'{side}: median latency', a[2], b[2], 0.15)]
        found += [f'{one.name}, {title}: {b:.4g}, real {a:.4g}' for title, a, b, most in pairs if abs(b / a - 1.0) > most]
        for receiver, errors_ in one.real_errors.items():
            difference = errors_.wrong / errors_.due - one.simulated_errors[receiver].wrong / one.simulated_errors[receiver].due
            if abs(difference) > MARGIN:
                found.append(f'{one.name}, {receiver}: message accuracy differs by {100 * difference:.1f} points')
    return found


def draw(results: list[Compared], path: Path) -> None:
    """Draw real and simulated side by side: edges, a stretch of the signal, bursts, and counts an edge."""
    import matplotlib

    matplotlib.use('Agg')
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(4, len(results), figsize=(6.5 * len(results), 13), layout='constrained', squeeze=False)
    for column, one in enumerate(results):
        _draw_edges(axes[0, column], one)
        _draw_stretch(axes[1, column], one)
        _draw_bursts(axes[2, column], one)
        _draw_counts(axes[3, column], one)
    figure.savefig(path, dpi=100)
    plt.close(figure)


def _draw_edges(axis: Any, one: Compared) -> None:
    width_us = 20.0
    longest = LONGEST_US if one.real.bit_ns > 1e6 else 960.0
    for signal, style, label in ((one.real, '-', 'real'), (one.simulated[0], '--', 'simulated')):
        tables = profiles(signal, width_us)
        for level, sign, colour in ((1, 1, ON_COLOUR), (0, -1, OFF_COLOUR)):
            held_for = 3 if one.real.bit_ns < 1e6 else 1
            mine = [value for (at, _, now), value in tables.items() if (at, now) == (level, held_for)]
            total = np.sum([table[0 if level else 1] * edges for table, edges in mine], axis=0)
            rate = sign * total / sum(edges for _, edges in mine) / width_us * 1e3
            times = (np.arange(len(rate)) + 0.5) * width_us
            shown = times < longest
            name = 'rise, ON' if level else 'fall, OFF'
            axis.plot(times[shown], rate[shown], style, color=colour, lw=1.3, label=f'{name}, {label}')
    axis.axhline(0.0, color='#888888', lw=0.6)
    held_for_text = 'one bit' if one.real.bit_ns > 1e6 else '3 bits or more'
    axis.set(
        title=f'{one.name}: events since the edge (held {held_for_text})', xlabel='since the edge of the line (µs)',
        ylabel='events a ms, OFF downwards',
    )  # fmt: skip
    axis.legend(fontsize=7, ncols=2)


def _draw_stretch(axis: Any, one: Compared) -> None:
    bins_a_bit, bits = (8, 33) if one.real.bit_ns < 1e6 else (24, 22)
    names = []
    for row, (signal, name) in enumerate(((one.simulated[0], 'simulated'), (one.real, 'real'))):
        begin_ns = int(signal.changes_ns[0]) + 11 * 20 * signal.bit_ns
        edges = begin_ns + np.arange(bits * bins_a_bit + 1) * signal.bit_ns / bins_a_bit
        for sign, colour in ((1, ON_COLOUR), (-1, OFF_COLOUR)):
            counts = np.histogram(signal.t_ns[signal.polarity == sign], edges)[0]
            where = np.arange(len(counts)) / bins_a_bit
            axis.bar(where, sign * counts / 110.0, 1.0 / bins_a_bit, bottom=row * 2.6, color=colour, align='edge')
        level = np.concatenate(([1], signal.levels))
        at = np.searchsorted(signal.changes_ns, edges[:-1] + 1e3, side='right')
        axis.step(np.arange(len(at)) / bins_a_bit, row * 2.6 - 1.25 + 0.3 * level[at], where='post', color='#333333', lw=0.8)
        names.append(name)
    axis.set(title=f'{one.name}: the same three characters and their line', xlabel='bits', yticks=[0.0, 2.6], yticklabels=names)


def _draw_bursts(axis: Any, one: Compared) -> None:
    for signal, style, label in ((one.real, '-', 'real'), (one.simulated[0], '--', 'simulated')):
        axis.plot(np.arange(80) * 5.0, autocorrelation(signal.t_ns), style, color='#444444', label=label)
    axis.set(title=f'{one.name}: bursts', xlabel='lag (µs)', ylabel='autocorrelation of the counts')
    axis.set(yscale='log', ylim=(0.02, 60))
    axis.legend(fontsize=7)


def _draw_counts(axis: Any, one: Compared) -> None:
    for signal, filled, label in ((one.real, True, 'real'), (one.simulated[0], False, 'simulated')):
        edge = np.searchsorted(signal.changes_ns, signal.t_ns, side='right') - 1
        for level, sign, colour in ((1, 1, ON_COLOUR), (0, -1, OFF_COLOUR)):
            mine = (edge >= 0) & (signal.levels[edge] == level) & (signal.polarity == sign)
            _, now = held_bits(signal)
            chosen = (signal.levels == level) & (now == 1)
            counts = np.bincount(edge[mine], minlength=len(signal.levels))[chosen]
            axis.hist(
                counts, np.arange(0, 480, 10), density=True, color=colour, histtype='stepfilled' if filled else 'step',
                alpha=0.35 if filled else 1.0, label=f'{"rise" if level else "fall"}, {label}',
            )  # fmt: skip
    axis.set(title=f'{one.name}: events of one held bit', xlabel='events', yticks=[])
    axis.legend(fontsize=7)


# One sensor for all recordings; of each recording its LED, its line's shift, and how bright its background is: that of
# REFERENCE is 1, by definition.
SHARED = (
    'threshold_on', 'threshold_off', 'photoreceptor_us', 'follower_us', 'refractory_us', 'photon_noise', 'psf_px',
    'threshold_mismatch',
)  # fmt: skip
OF_LED = ('contrast', 'rise_us', 'fall_us', 'rise_slew_us', 'fall_slew_us')
REFERENCE = '504hz_30m'
FIT_CHARACTERS = {'504hz_30m': 40, '3125hz_30m': 250}
SHIFT_UNIT_US = 100.0
ERRORS_UNIT = 0.03  # a share of wrong characters that is so far off counts like a misfit of 1


@dataclass(frozen=True, slots=True)
class Key:
    """A value that is searched: of the sensor (no recording), or of one recording's LED, background or shift."""

    recording: str
    part: str
    name: str


def fit(names: list[str], steps: int, seed: int, sensor_too: bool) -> None:
    """Search around the scenes by random steps, larger after a success and smaller after a failure; print what is better."""
    random = np.random.default_rng(seed)
    scenes = {name: described(name) for name in names}
    keys = [Key('', 'sensor', one) for one in (SHARED if sensor_too else ())]
    for name in names:
        keys += [Key(name, 'led', one) for one in OF_LED]
        keys += [Key(name, 'background', 'brightness')] if name != REFERENCE else []
        keys += [Key(name, 'shift', 'e')]  # exp(shift / SHIFT_UNIT_US): all values are searched by their logarithms
    real = {name: real_signal(name).first(0.35) for name in names}
    found = {(name, receiver): errors(real_signal(name), name, receiver) for name in names for receiver in RECEIVERS}
    wrong = {name: {one: found[name, one].wrong / found[name, one].due for one in RECEIVERS} for name in names}

    def begin(key: Key) -> float:
        scene = scenes[key.recording or names[0]]
        parts = {'sensor': scene.sensor, 'led': scene.beacons[0].led, 'background': scene.background}
        return 1.0 if key.part == 'shift' else max(float(getattr(parts[key.part], key.name)), 1e-6)

    def cost(values: NDArray[np.float64]) -> float:
        total = 0.0
        for name, scene in scenes.items():
            changes: dict[str, dict[str, float]] = {'sensor': {}, 'led': {}, 'background': {}, 'shift': {'e': 1.0}}
            for key, value in zip(keys, values, strict=True):
                if key.recording in ('', name):
                    changes[key.part][key.name] = float(value)
            beacon = scene.beacons[0]
            mine = replace(
                scene,
                sensor=replace(scene.sensor, **changes['sensor']),
                background=replace(scene.background, **changes['background']),
                beacons=(replace(beacon, led=replace(beacon.led, **changes['led'])),),
            )
            by_ns = round(np.log(changes['shift']['e']) * SHIFT_UNIT_US * 1e3)
            moved = replace(real[name], changes_ns=real[name].changes_ns + by_ns, end_ns=real[name].end_ns + by_ns)
            simulated = simulated_signal(name, mine, FIT_CHARACTERS[name], 1)
            total += misfit(moved, simulated)
            for receiver, share in wrong[name].items():
                now = errors(simulated, name, receiver)
                total += min((now.wrong / now.due - share) / ERRORS_UNIT, 3.0) ** 2
        return total

    best = np.log([begin(key) for key in keys])
    least, size = cost(np.exp(best)), 0.2
    print(f'misfit {least:.3f}', flush=True)
    for step in range(steps):
        trial = best + size * random.normal(size=len(keys)) * (random.random(len(keys)) < 0.3)
        now = cost(np.exp(trial))
        if now < least:
            best, least, size = trial, now, min(size * 1.3, 0.5)
            shown = ', '.join(
                f'shift {SHIFT_UNIT_US * value:+.1f} µs' if key.part == 'shift' else f'{key.name}: {np.exp(value):.4g}'
                for key, value in zip(keys, best, strict=True)
            )
            print(f'{step}: misfit {least:.3f}  {shown}', flush=True)
        else:
            size = max(size * 0.96, 0.03)


def main() -> None:
    """Run the command."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument('--output', type=Path, help='write the page to this file, and the figure beside it')
    parser.add_argument('--check', action='store_true', help='exit with 1 where the stated margins do not hold')
    parser.add_argument('--fit', metavar='NAME', nargs='*', help='search better values instead (default: for all recordings)')
    parser.add_argument('--steps', type=int, default=300, help='of the search (default 300)')
    parser.add_argument('--seed', type=int, default=1, help='of the search (default 1)')
    parser.add_argument('--sensor', action='store_true', help="search the sensor's values, too")
    arguments = parser.parse_args()
    if arguments.fit is not None:
        unknown = set(arguments.fit) - set(RECORDINGS)
        if unknown:
            parser.error(f'--fit: no recording {", ".join(unknown)}')
        fit(arguments.fit or list(RECORDINGS), arguments.steps, arguments.seed, arguments.sensor)
        return
    results = [compared(name, SEEDS) for name in RECORDINGS]
    text = page(results, SEEDS)
    if arguments.output is None:
        sys.stdout.write(text)
    else:
        arguments.output.write_text(text)
        draw(results, arguments.output.parent / FIGURE)
    outside = check(results) if arguments.check else []
    for line in outside:
        print(line, file=sys.stderr)
    sys.exit(1 if outside else 0)


if __name__ == '__main__':
    main()
