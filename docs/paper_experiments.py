#!/usr/bin/env python3
"""Do the paper's experiments again (section IV), with both receivers; write paper_experiments.md and its figures.

    python docs/paper_experiments.py                  # some two minutes: prints a page of fewer points, writes nothing
    python docs/paper_experiments.py --full --write   # about ten minutes: docs/paper_experiments.md, docs/figures/paper_*.png

::

    real:       .mat at 30 m ──────────────────────────────────► both receivers ──► the outdoor table
    simulated:  LED at a distance ─► lens, pixels, readout ─┬─► its blob's events ─► both receivers ─► accuracy against bit rate
                                                            └─► detection, tracking, sequence receiver ─► the same
                4 kHz square wave ─► the same ─► the paper's filter and levels ──► control voltage against filtered events

A simulated point sends the beginning of Sonnet 18.  As in the paper a first part lets the receiver find the signal and does not
count; where no start is found in what was decoded, message accuracy is 0 and bit accuracy 0.5.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

from beacon_comm.cli.collector import Collector
from beacon_comm.cli.offline import receive_signal
from beacon_comm.cli.progress import progress
from beacon_comm.core.character import Character
from beacon_comm.core.events import NS_PER_S, EventBatch
from beacon_comm.core.framing import CharacterFrame
from beacon_comm.core.parameters import Parameters
from beacon_comm.core.receiver import Receiver
from beacon_comm.evaluation.held import Signal
from beacon_comm.evaluation.report import PUBLISHED
from beacon_comm.evaluation.scene_score import primary_characters
from beacon_comm.evaluation.scoring import Transmission, not_found, score, score_at, wilson_interval
from beacon_comm.evaluation.stress_report import markdown_table
from beacon_comm.evaluation.truth import SONNET18
from beacon_comm.evaluation.views import Stretch, Trace, trace_filter
from beacon_comm.recordings.folder import recordings_folder
from beacon_comm.recordings.mat import read_mat
from beacon_comm.simulation.description import make_description
from beacon_comm.simulation.scene import simulate

PROJECT = Path(__file__).resolve().parents[1]
PAGE = PROJECT / 'docs' / 'paper_experiments.md'
FIGURES = PROJECT / 'docs' / 'figures'
RECORDED = {'504hz_30m.mat': 504.0, '3125hz_30m.mat': 3125.0}
RECEIVERS = ('threshold', 'sequence')
WHOLE = 'sequence, whole receiver'
ALL = (*RECEIVERS, WHOLE)
FRAME = CharacterFrame()
SIZE_PX = 64
# What is sent before the characters that count, so that the receiver has found the signal: this long (s), and so many
# characters at least; and how many after them.
LEAD_IN_S, LEAD_IN, LEAD_OUT = 0.3, 16, 4
# Signals are simulated for no longer than this (s) or the whole sonnet, but for so many characters at least.
LONGEST_S, QUICK_S = 8.0, 1.5
FEWEST = 30
LEAST_DRAWN = {'message': -0.02, 'bit': 0.45}  # what lies below is drawn there
NEAR_RADII, LEAST_RADIUS_PX = 1.5, 3.0

# Outdoors: the LED, driver and lens of the 30 m recordings, which the simulator is calibrated on.
OUTDOOR_M = (7.0, 14.0, 20.0, 30.0, 50.0, 100.0)
OUTDOOR_BPS = (20.0, 100.0, 500.0, 1000.0, 2000.0, 3125.0, 4000.0, 6000.0, 10_000.0)
# Indoors: a 5 mm indicator LED (see INDOOR_TEXT) and an 8 mm lens at f/1.4, over 15 µm pixels.
INDOOR_M = (0.15, 0.3, 0.5, 1.0, 2.0, 3.0)
INDOOR_BPS = (20.0, 100.0, 500.0, 1000.0, 2000.0, 4000.0, 6000.0, 10_000.0)
# A quick run has the points that the paper makes statements of.
QUICK = {
    'outdoor': ((30.0, 500.0), (30.0, 3125.0), (100.0, 500.0), (100.0, 3125.0)),
    'indoor': ((0.3, 4000.0), (0.5, 1000.0), (0.5, 2000.0), (3.0, 20.0)),
}

OUTDOOR_LENS = (70.0, 5.6)  # focal length (mm), f-number
INDOOR_LENS = (8.0, 1.4)
PIXEL_UM = 15.0
BRIGHT_CD, DIM_CD = 34.0, 0.03
OUTDOOR_CD_M2, INDOOR_CD_M2 = 5000.0, 75.0
SQUARE_HZ, SQUARE_M = 4000.0, 0.3
INDOOR_TEXT = (
    'The paper does not say how bright its dim LED was, nor the light in the room. Assumed, and nothing was fitted: an'
    f' indicator LED of {1e3 * DIM_CD:g} mcd on a wire, 1 µs rise and fall; a background of {INDOOR_CD_M2:g} cd/m² indoors and'
    f" {OUTDOOR_CD_M2:g} cd/m² in the sun; {BRIGHT_CD:g} cd for the bright LED (107 lm, Lambertian). A point's irradiance"
    " on the sensor goes as intensity times (focal length / f-number)² over distance², a surface's as luminance over f-number²:"
    ' this carries the contrast that was calibrated outdoors over to the room.'
)


@dataclass(frozen=True, slots=True)
class Room:
    """Where a series is simulated.

    Attributes:
        name: ``outdoor`` or ``indoor``.
        brightness: of the background, 1: outdoors in full sun.
        focal_px: of the lens.
        led: its keys in a scene file.
    """

    name: str
    brightness: float
    focal_px: float
    led: dict[str, float]


def rooms() -> dict[str, Room]:
    """Return both rooms; see :data:`INDOOR_TEXT`."""
    (far_mm, far_n), (near_mm, near_n) = OUTDOOR_LENS, INDOOR_LENS
    calibrated = make_description({'beacons': [{}]}).beacons[0].led
    brightness = INDOOR_CD_M2 / OUTDOOR_CD_M2 * (far_n / near_n) ** 2
    contrast = calibrated.contrast * DIM_CD / BRIGHT_CD * ((near_mm / near_n) / (far_mm / far_n)) ** 2
    direct = {'contrast': contrast, 'size_mm': 5.0} | dict.fromkeys(('rise_us', 'fall_us', 'rise_slew_us', 'fall_slew_us'), 1.0)
    return {
        'outdoor': Room('outdoor', 1.0, 1e3 * far_mm / PIXEL_UM, {}),
        'indoor': Room('indoor', brightness, 1e3 * near_mm / PIXEL_UM, direct),
    }


@dataclass(frozen=True, slots=True)
class Point:
    """One receiver at one distance and bit rate.

    Attributes:
        room, distance_m, bit_rate_bps, receiver: which.
        transmission: its score.
        events_a_bit: near the beacon.
    """

    room: str
    distance_m: float
    bit_rate_bps: float
    receiver: str
    transmission: Transmission
    events_a_bit: float


def characters_at(bit_rate_bps: float, longest_s: float) -> int:
    """Return how many characters count at a bit rate."""
    return int(np.clip(longest_s * bit_rate_bps / FRAME.length, FEWEST, len(SONNET18)))


def lead_in(bit_rate_bps: float) -> int:
    """Return how many characters are sent before those that count."""
    return int(np.clip(LEAD_IN_S * bit_rate_bps / FRAME.length, LEAD_IN, len(SONNET18)))


def run_point(room: Room, distance_m: float, bit_rate_bps: float, longest_s: float, seed: int) -> list[Point]:
    """Simulate one distance and bit rate, and let both receivers read it."""
    count = characters_at(bit_rate_bps, longest_s)
    first = lead_in(bit_rate_bps)
    text = SONNET18[-first:] + SONNET18[:count]
    length_s = FRAME.duration_ns(bit_rate_bps) / NS_PER_S
    start_s = 0.05
    description = make_description(
        {
            'duration_s': start_s + (len(text) + LEAD_OUT) * length_s + 0.05,
            'sensor': {'width': SIZE_PX, 'height': SIZE_PX},
            'camera': {'focal_px': room.focal_px},
            'background': {'brightness': room.brightness},
            'beacons': [
                {
                    'text': text,
                    'bit_rate_bps': bit_rate_bps,
                    'distance_m': distance_m,
                    'start_s': start_s,
                    'gap_bits': 16,
                    'led': room.led,
                }
            ],
        }
    )
    batches, truth = simulate(description, seed)
    beacon = truth.beacons[0]
    near_px = NEAR_RADII * max(LEAST_RADIUS_PX, float(beacon.radius_px(0)))
    middle = np.array([float(value) for value in beacon.centre(0)])
    whole = Receiver(Parameters(bit_rates=(bit_rate_bps,)), (SIZE_PX, SIZE_PX))
    collector = Collector()
    times, polarities = [], []
    for batch in batches:
        near = np.hypot(batch.x - middle[0], batch.y - middle[1]) <= near_px
        times.append(batch.t_ns[near])
        polarities.append(batch.polarity[near])
        collector.take(whole.push(batch), whole)
        collector.sample(whole)
    collector.take(whole.flush(), whole)
    t_ns, polarity = np.concatenate(times), np.concatenate(polarities)
    read = {WHOLE: on_beacon(collector, middle, near_px)}
    for name in RECEIVERS:
        parameters = Parameters(receiver=name, bit_rates=(bit_rate_bps,))
        read[name] = receive_signal(t_ns, polarity, parameters).characters if len(t_ns) else ()
    start_ns, events = int(beacon.sendings_ns[0]), len(t_ns) / (FRAME.length * (len(text) + LEAD_OUT))
    scored = {name: scored_as_the_paper(read[name], text, first, start_ns, bit_rate_bps) for name in ALL}
    return [Point(room.name, distance_m, bit_rate_bps, name, one, events) for name, one in scored.items()]


def on_beacon(collector: Collector, middle: np.ndarray[Any, np.dtype[np.float64]], near_px: float) -> Sequence[Character]:
    """Return the characters of the track that gave most of those near the beacon, one after the other where it was lost."""
    tracks, _ = collector.beacons()
    near = []
    for track in tracks:
        x, y = (np.median([getattr(point, name) for point in track.path]) for name in ('x_px', 'y_px'))
        if track.path and np.hypot(x - middle[0], y - middle[1]) <= near_px:
            near.append(track)
    return primary_characters(near, FRAME)


def scored_as_the_paper(
    read: Sequence[Character], text: str, first: int, start_ns: int, bit_rate_bps: float
) -> Transmission:
    """Score what was sent from character ``first`` on; a start that is not found in what was read is accuracy 0 and 0.5."""
    length_ns = FRAME.duration_ns(bit_rate_bps)
    span_ns = (0, round(start_ns + (len(text) + 2) * length_ns))
    known = replace(
        not_found(text, FRAME), start_ns=start_ns, bit_rate_bps=bit_rate_bps, first=first, characters=len(text) - first
    )
    if not score(read, text, span_ns, None, FRAME):
        return not_found(text[first:], FRAME)
    return score_at(read, text, [known], FRAME)[0]


def run_series(names: Sequence[str], full: bool, seed: int, processes: int = 1) -> list[Point]:
    """Simulate all distances and bit rates of some rooms."""
    axes = {'outdoor': product(OUTDOOR_M, OUTDOOR_BPS), 'indoor': product(INDOOR_M, INDOOR_BPS)} if full else QUICK
    jobs = [(rooms()[name], metres, rate) for name in names for metres, rate in axes[name]]
    longest_s = LONGEST_S if full else QUICK_S
    with ProcessPoolExecutor(processes) as pool:
        running = [pool.submit(run_point, *job, longest_s, seed) for job in jobs]
        found = [job.result() for job in progress(running, 'simulated points', len(jobs))]
    return [point for points in found for point in points]


# The real recordings


def run_recorded(folder: Path) -> list[tuple[str, str, Transmission]]:
    """Return recording, receiver and score of the last transmission, as the paper counts; none where they are not there."""
    found = []
    for name in RECORDED:
        if not (folder / name).is_file():
            continue
        t_ns, polarity = read_mat(folder / name)
        t_ns = t_ns - t_ns[0]
        for receiver in RECEIVERS:
            beacon = receive_signal(t_ns, polarity, Parameters(receiver=receiver), name)
            transmissions = score(beacon.characters, SONNET18, (0, int(t_ns[-1])), Signal(t_ns, polarity), FRAME)
            found.append((name, receiver, transmissions[-1] if transmissions else not_found(SONNET18, FRAME)))
    return found


# The control voltage


@dataclass(frozen=True, slots=True, eq=False)
class SquareWave:
    """The events of a 4 kHz square wave, filtered.

    Attributes:
        stretch: what is shown.
        trace: the paper's filter.
        polarity, t_ns: the events.
        phase_ns: when the LED goes on, for the first time in the stretch (ns).
        agreement: share of the voltage's half periods, of 0.15 s, in the middle of which the binarised line is as it is.
    """

    stretch: Stretch
    trace: Trace
    t_ns: np.ndarray[Any, np.dtype[np.int64]]
    polarity: np.ndarray[Any, np.dtype[np.int8]]
    phase_ns: float
    agreement: float


def run_square_wave(seed: int, frequency_hz: float = SQUARE_HZ) -> SquareWave:
    """Simulate the LED on a square wave at 30 cm, and filter its events."""
    room = rooms()['indoor']
    radius_px = 0.5 * 1e-3 * room.led['size_mm'] / SQUARE_M * room.focal_px
    psf_px = make_description({}).sensor.psf_px
    # In the middle of a wide disc there is this share of a point's peak: its flux is spread over the disc.
    share = (1.0 - np.exp(-0.5 * (radius_px / psf_px) ** 2)) * 2.0 * psf_px**2 / radius_px**2
    contrast = room.led['contrast'] * (30.0 / SQUARE_M) ** 2 * float(share)
    lamp = {
        'kind': 'pwm',
        'frequency_hz': frequency_hz,
        'duty': 0.5,
        'contrast': contrast,
        'radius_px': radius_px,
        'edge_us': 1.0,
        'path': {'kind': 'still', 'at_px': [SIZE_PX / 2, SIZE_PX / 2]},
    }
    description = make_description(
        {
            'duration_s': 0.2,
            'sensor': {'width': SIZE_PX, 'height': SIZE_PX},
            'background': {'brightness': room.brightness},
            'distractors': [lamp],
        }
    )
    batches, _ = simulate(description, seed)
    parts: list[EventBatch] = list(batches)
    near = [np.hypot(one.x - SIZE_PX / 2, one.y - SIZE_PX / 2) <= 2.0 * radius_px for one in parts]
    t_ns = np.concatenate([one.t_ns[own] for one, own in zip(parts, near, strict=True)])
    polarity = np.concatenate([one.polarity[own] for one, own in zip(parts, near, strict=True)])
    # A bit is half a period.
    begin_ns, end_ns = 150_000_000, 152_000_000
    parameters = Parameters()
    trace = trace_filter(t_ns, polarity, Stretch(begin_ns, end_ns, 2.0 * frequency_hz, ''), parameters)
    whole = trace_filter(t_ns, polarity, Stretch(50_000_000, 200_000_000, 2.0 * frequency_hz, ''), parameters)
    period_ns = NS_PER_S / frequency_hz
    # The phase is drawn by the simulator: it is the one at which most half periods agree.
    middles_ns = 50_000_000 + (np.arange(int(0.149 * frequency_hz * 2)) + 0.5) * period_ns / 2.0
    delays_ns = np.arange(80) * period_ns / 80.0
    at = np.searchsorted(whole.edges_ns, middles_ns[None, :] + delays_ns[:, None], side='right') - 1
    line = np.where(at < 0, whole.line_before, whole.rising[np.maximum(at, 0)])
    shares = (line == (np.arange(len(middles_ns)) % 2 == 0)).mean(axis=1)
    best = int(np.argmax(shares))
    phase_ns = begin_ns + (50_000_000 + float(delays_ns[best]) - begin_ns) % period_ns
    return SquareWave(Stretch(begin_ns, end_ns, 2.0 * frequency_hz, ''), trace, t_ns, polarity, phase_ns, float(shares[best]))


# Figures


COLOURS = ('#1f5fa8', '#2f9e63', '#b8860b', '#d9822b', '#c44e52', '#8d6cc2')


def draw_series(points: Sequence[Point], room: str, path: Path) -> None:
    """Draw message and bit accuracy against the bit rate: a column for each receiver, a curve for each distance."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure
    from matplotlib.ticker import NullFormatter

    figure = Figure(figsize=(12.5, 6.2), layout='constrained')
    FigureCanvasAgg(figure)
    panels = figure.subplots(2, len(ALL), sharex=True, sharey='row')
    distances = sorted({point.distance_m for point in points if point.room == room})
    for column, receiver in enumerate(ALL):
        for row, kind in enumerate(('message', 'bit')):
            axes = panels[row][column]
            for place, metres in enumerate(distances):
                own = sorted(
                    (one for one in points if (one.room, one.receiver, one.distance_m) == (room, receiver, metres)),
                    key=lambda one: one.bit_rate_bps,
                )
                x = [one.bit_rate_bps for one in own]
                y = [max(getattr(one.transmission, f'{kind}_accuracy'), LEAST_DRAWN[kind]) for one in own]
                intervals = [interval_of(one.transmission, kind) for one in own]
                colour = COLOURS[place % len(COLOURS)]
                axes.fill_between(x, [i[0] for i in intervals], [i[1] for i in intervals], color=colour, alpha=0.1, linewidth=0)
                axes.plot(
                    x, y, color=colour, marker='osD^vP'[place % 6], markersize=7.0 - 0.8 * place, linewidth=2.4 - 0.3 * place,
                    label=f'{metres:g} m', clip_on=False, zorder=3 + place,
                )  # fmt: skip
            axes.set_xscale('log')
            axes.set_ylim(LEAST_DRAWN[kind], 1.02)
            axes.yaxis.set_major_formatter(lambda value, _: f'{100 * value:g} %')
            axes.xaxis.set_major_formatter(lambda value, _: f'{value:g}')
            axes.xaxis.set_minor_formatter(NullFormatter())
            axes.grid(alpha=0.25)
            for side in ('top', 'right'):
                axes.spines[side].set_visible(False)
            if not row:
                axes.set_title(receiver)
            else:
                axes.set_xlabel('bit rate (bit/s)')
            if not column:
                axes.set_ylabel(f'{kind} accuracy')
    panels[1][0].legend(loc='lower left', frameon=False, title='simulated', ncols=2)
    figure.savefig(path, dpi=130)


def interval_of(transmission: Transmission, kind: str) -> tuple[float, float]:
    """Return the 95 % interval of an accuracy; of one that was set, since no start was found, the value itself."""
    share = getattr(transmission, f'{kind}_accuracy')
    if not transmission.found:
        return share, share
    trials = transmission.characters if kind == 'message' else transmission.bits
    interval = wilson_interval(share, trials)
    return interval.low, interval.high


def draw_square_wave(wave: SquareWave, path: Path) -> None:
    """Draw the control voltage, the filtered events with their levels, and the binarised line (the paper's figure)."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9.6, 5.4), layout='constrained')
    FigureCanvasAgg(figure)
    panels = figure.subplots(4, 1, sharex=True, height_ratios=(1.0, 2.0, 1.2, 1.0))
    begin_ns, end_ns = wave.stretch.begin_ns, wave.stretch.end_ns

    def at(t_ns: Any) -> Any:
        return (np.asarray(t_ns, np.float64) - begin_ns) / 1e6

    half_ns = 0.5 * NS_PER_S / SQUARE_HZ
    changes = np.arange(wave.phase_ns - 2 * half_ns, end_ns + half_ns, half_ns)
    panels[0].step(at(changes), np.arange(len(changes)) % 2 == 0, where='post', color='0.15')
    panels[0].set_ylabel('control\nvoltage')
    trace = wave.trace
    panels[1].plot(at(trace.t_ns), trace.filtered, color='0.15', linewidth=1.0)
    panels[1].plot(at(trace.t_ns), trace.high, color='#c62828', linewidth=1.2, label='high level')
    panels[1].plot(at(trace.t_ns), trace.low, color='#1f5fa8', linewidth=1.2, label='low level')
    panels[1].set_ylabel('filtered signal\n(events)')
    panels[1].legend(loc='upper right', ncols=2, frameon=False, fontsize=8)
    edges = np.arange(begin_ns, end_ns, half_ns / 5)
    for sign, colour in ((1, '#d9822b'), (-1, '#3b6ea8')):
        counts, _ = np.histogram(wave.t_ns[wave.polarity == sign], edges)
        panels[2].bar(at(edges[:-1]), sign * counts, half_ns / 5e6, align='edge', color=colour, linewidth=0)
    panels[2].axhline(0.0, color='0.4', linewidth=0.7)
    panels[2].set_ylabel('events in\n25 µs')
    last = trace.rising[-1] if len(trace.rising) else trace.line_before
    line = [float(trace.line_before), *trace.rising.astype(float), float(last)]
    panels[3].step(at([begin_ns, *trace.edges_ns, end_ns]), line, where='post', color='0.15')
    panels[3].set_ylabel('binarised')
    for axes in (panels[0], panels[3]):
        axes.set(yticks=(0, 1), ylim=(-0.2, 1.2))
    for axes in panels:
        for change in changes:
            axes.axvline(at(change), color='0.88', linewidth=0.6, zorder=0)
        for side in ('top', 'right'):
            axes.spines[side].set_visible(False)
    panels[3].set_xlim(0.0, at(end_ns))
    panels[3].set_xlabel('ms')
    figure.align_ylabels(panels)
    figure.savefig(path, dpi=130)


# The page


def accuracy(transmission: Transmission) -> str:
    """Return both accuracies with the message's interval."""
    if not transmission.found:
        return 'no start: 0, 0.5'
    low, high = interval_of(transmission, 'message')
    right = transmission.characters - transmission.wrong
    return (
        f'{transmission.message_accuracy:.3f}, {transmission.bit_accuracy:.4f} ({right} of {transmission.characters},'
        f' [{low:.3f}, {high:.3f}])'
    )


def statement_rows(points: Sequence[Point]) -> list[tuple[str, ...]]:
    """Return what the paper states, and what came out beside it."""

    def of(room: str, metres: Sequence[float], rates: Sequence[float]) -> tuple[str, ...]:
        cells = []
        for receiver in ALL:
            own = [
                one.transmission
                for one in points
                if one.room == room and one.receiver == receiver and one.distance_m in metres and one.bit_rate_bps in rates
            ]
            if not own:
                cells.append('–')
            elif len(own) == 1:
                cells.append(accuracy(own[0]))
            else:
                worst = min(own, key=lambda one: one.message_accuracy)
                cells.append(f'worst of {len(own)}: {accuracy(worst)}')
        return tuple(cells)

    near = [metres for metres in INDOOR_M if metres <= 0.5]
    return [
        ('“up to 4 kbps in an indoor environment”', 'indoor, 0.3 m, 4000 bps', *of('indoor', [0.3], [4000.0])),
        (
            'within 50 cm “more than 1 kbps … with more than 96 % message accuracy rate and 98 % bit accuracy rate”',
            'indoor, to 0.5 m, 1000 and 2000 bps',
            *of('indoor', near, [1000.0, 2000.0]),
        ),
        ('“100 % … of 3 meters with … 20 bps”', 'indoor, 3 m, 20 bps', *of('indoor', [3.0], [20.0])),
        ('“100-meter error-free transmission at 500 bps”', 'outdoor, 100 m, 500 bps', *of('outdoor', [100.0], [500.0])),
        ('3125 bps at 100 m: 0.435, 0.906', 'outdoor, 100 m, 3125 bps', *of('outdoor', [100.0], [3125.0])),
        ('3125 bps at 30 m: 0.877, 0.987', 'outdoor, 30 m, 3125 bps', *of('outdoor', [30.0], [3125.0])),
        ('500 bps at 30 m: 1, 1', 'outdoor, 30 m, 500 bps', *of('outdoor', [30.0], [500.0])),
    ]


def grid(points: Sequence[Point], room: str, receiver: str) -> str:
    """Return message accuracy, bit accuracy of every distance and bit rate."""
    own = {(one.distance_m, one.bit_rate_bps): one for one in points if (one.room, one.receiver) == (room, receiver)}
    rates = sorted({rate for _, rate in own})

    def cell(metres: float, rate: float) -> str:
        found = own.get((metres, rate))
        if found is None:
            return '–'
        one = found.transmission
        return '0, 0.5 (no start)' if not one.found else f'{one.message_accuracy:.3f}, {one.bit_accuracy:.3f}'

    rows = [(f'{metres:g} m', *(cell(metres, rate) for rate in rates)) for metres in sorted({m for m, _ in own})]
    return markdown_table(('', *(f'{rate:g} bps' for rate in rates)), rows)


def page(
    recorded: Sequence[tuple[str, str, Transmission]], points: Sequence[Point], wave: SquareWave, full: bool, seed: int
) -> str:
    """Return the whole page as Markdown."""
    table = []
    for name in RECORDED:
        paper = PUBLISHED[Path(name).stem]
        own = {receiver: one for recording, receiver, one in recorded if recording == name}
        cells = (accuracy(own[receiver]) if receiver in own else '–' for receiver in RECEIVERS)
        table.append((name, f'{paper.message_accuracy:g}, {paper.bit_accuracy:g}', *cells))
    columns = ('The paper', 'Here', *ALL)
    parts = [
        "# The paper's experiments again",
        'Written by `python docs/paper_experiments.py --full --write`'
        + ('' if full else ' (this is a quick run)')
        + f"; seed {seed}. Every cell: message accuracy, bit accuracy, as the paper's section IV defines them"
        ' ([evaluation](evaluation.md)); in brackets the 95 % interval of the message accuracy (Wilson).',
        '## Outdoors, 30 m: the real recordings',
        'The last transmission of each recording, as the paper counts. One set of defaults for both.',
        markdown_table(('Recording', 'Paper', *RECEIVERS), table),
        '## What the paper states, simulated',
        'Everything below is **simulated** ([simulator](simulator.md)), not measured: the sensor, LED and driver of the'
        ' outdoor recordings, carried to other distances by the inverse square law. The receivers read the events of the'
        " blob, as in the paper's recordings; the *whole receiver* finds and follows it in an image of"
        f' {SIZE_PX}×{SIZE_PX} pixels besides. The listed rate is the true one. Each point sends the beginning of Sonnet 18,'
        f' for {LONGEST_S:g} s or to its end, {FEWEST} characters at least, after {LEAD_IN_S:g} s of its end that do not'
        f' count, {LEAD_IN} characters at least; one run a point.',
        markdown_table(columns, statement_rows(points)),
        'Nothing reads 10 kbps whole here, where an edge of the LED and the pixels is several bits long: the sequence receiver'
        ' never locks, the threshold receiver gets a part of the characters when it is near.',
        '## Control voltage against filtered events, 4 kHz (simulated)',
        '![Control voltage, filtered events, events and binarised line](figures/paper_control_voltage.png)',
        f'An LED on a 4 kHz square wave at {100 * SQUARE_M:g} cm, the filter at 8000 bit/s: the binarised line is'
        f' right in the middle of {100 * wave.agreement:.1f} % of the half periods. The voltage is drawn at the delay at which'
        ' most agree. The paper finds that the events follow the voltage "with high accuracy".',
        '## Accuracy against bit rate, outdoors (simulated)',
        '![Outdoors](figures/paper_outdoor.png)',
        *(part for receiver in ALL for part in (f'### {receiver}', grid(points, 'outdoor', receiver))),
        '## Accuracy against bit rate, indoors (simulated)',
        INDOOR_TEXT,
        '![Indoors](figures/paper_indoor.png)',
        *(part for receiver in ALL for part in (f'### {receiver}', grid(points, 'indoor', receiver))),
        '## Events',
        'Events a bit near the beacon, in the mean:',
        *(events_table(points, room) for room in ('outdoor', 'indoor')),
    ]
    return '\n\n'.join(parts) + '\n'


def events_table(points: Sequence[Point], room: str) -> str:
    """Return the events a bit at every distance and bit rate."""
    own = {(one.distance_m, one.bit_rate_bps): one.events_a_bit for one in points if one.room == room}
    rates = sorted({rate for _, rate in own})
    rows = [
        (f'{metres:g} m', *(f'{own[metres, rate]:.3g}' if (metres, rate) in own else '–' for rate in rates))
        for metres in sorted({m for m, _ in own})
    ]
    return markdown_table((room, *(f'{rate:g} bps' for rate in rates)), rows)


def main() -> None:
    """Run everything; print the page or write it."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('--folder', type=Path, default=recordings_folder(), help='folder of the recordings')
    parser.add_argument('--full', action='store_true', help='every distance and bit rate, for the page')
    parser.add_argument('--write', action='store_true', help='write the page and its figures')
    parser.add_argument('--output', type=Path, default=PAGE, help='where to (default: docs/paper_experiments.md)')
    parser.add_argument('--seed', type=int, default=1)
    parser.add_argument('--processes', type=int, default=1, help='points simulated at once')
    arguments = parser.parse_args()
    recorded = run_recorded(Path(arguments.folder))
    if not recorded:
        print('no recordings: the outdoor table stays empty', file=sys.stderr)
    wave = run_square_wave(arguments.seed)
    points = run_series(('outdoor', 'indoor'), arguments.full, arguments.seed, arguments.processes)
    text = page(recorded, points, wave, arguments.full, arguments.seed)
    print(text)
    if arguments.write:
        figures = arguments.output.parent / 'figures'
        figures.mkdir(parents=True, exist_ok=True)
        draw_square_wave(wave, figures / 'paper_control_voltage.png')
        for room in ('outdoor', 'indoor'):
            draw_series(points, room, figures / f'paper_{room}.png')
        arguments.output.write_text(text, encoding='utf-8')
        print(f'wrote {arguments.output}', file=sys.stderr)


if __name__ == '__main__':
    main()
