"""The report's figures: signal, image, errors and accuracy over time, reliability, accuracy against bit rate."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from beacon_comm.core.character import Character
from beacon_comm.core.events import NS_PER_S
from beacon_comm.core.framing import CharacterFrame
from beacon_comm.evaluation.page import INK, LINE, MUTED, SHADE, new_figure
from beacon_comm.evaluation.reliability import Bin
from beacon_comm.evaluation.scoring import Interval
from beacon_comm.evaluation.views import ImageView, SignalView

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

HIGH_COLOUR, LOW_COLOUR = '#d8443c', '#3d7fd0'
ON_COLOUR, OFF_COLOUR = '#dd8a33', '#4a86c5'
WRONG_COLOUR, RIGHT_COLOUR = '#d8443c', '#2f9e5f'
COLOURS = ('#3d7fd0', '#dd8a33', '#2f9e5f', '#c0549b', '#8a6fd1', '#1aa3a3', '#b8860b', '#d8443c')
RECEIVER_COLOURS = {'sequence': '#3d7fd0', 'threshold': '#d8443c'}
MOST_POINTS = 1500
ROLLING_CHARACTERS = 25
# Confidences and shares are drawn by their nines, up to this many.
MOST_NINES = 6.0


def signal_figure(view: SignalView, frame: CharacterFrame) -> Figure:
    """Draw the filtered signal with its levels, the binarised line, and every receiver's bits and characters.

    The paper's Figures 1 and 6: the first row the filtered signal between the high (red) and the low level (blue), the second
    the binarised one.
    """
    ratios = {name: read for name, read in view.read.items() if any(any(one.bit_llr) for one in read)}
    heights = [2.6, 1.3, 0.7, *(1.5 for _ in ratios), *(0.8 for _ in view.read), *([0.55] if view.sent else [])]
    figure = new_figure(10.5, 0.55 + 0.72 * sum(heights))
    panels: list[Axes] = list(figure.subplots(len(heights), 1, sharex=True, height_ratios=heights, squeeze=False)[:, 0])
    rest = iter(panels)
    _draw_filtered(next(rest), view)
    _draw_events(next(rest), view)
    _draw_line(next(rest), view)
    for name, read in ratios.items():
        _draw_ratios(next(rest), view, name, read)
    for name, read in view.read.items():
        _draw_frames(next(rest), view, name, read, frame)
    if view.sent:
        _draw_sent(next(rest), view, frame)
    length_ms = frame.duration_ns(view.stretch.bit_rate_bps) / 1e6
    starts = [due / 1e6 for due, _ in view.sent] or [one.t_ns / 1e6 for read in view.read.values() for one in read]
    origin_ms = view.stretch.begin_ns / 1e6
    for panel in panels:
        for start in starts:
            for bit in range(frame.length + 1):
                heavy = bit in (0, frame.length)
                x = start - origin_ms + bit * length_ms / frame.length
                panel.axvline(x, color=MUTED if heavy else LINE, linewidth=0.9 if heavy else 0.5, zorder=0)
        panel.grid(False, axis='x')
    for panel in panels[:-1]:
        panel.tick_params(axis='x', length=0)
    panels[-1].set_xlim(0.0, (view.stretch.end_ns - view.stretch.begin_ns) / 1e6)
    panels[-1].set_xlabel(f'ms after {view.stretch.begin_ns / NS_PER_S:.3f} s')
    figure.align_ylabels(panels)
    return figure


def _name(axes: Axes, text: str) -> None:
    axes.set_ylabel(text, rotation=0, ha='right', va='center')


def _milliseconds(view: SignalView, t_ns: Any) -> Any:
    return (t_ns - view.stretch.begin_ns) / 1e6


def _draw_filtered(axes: Axes, view: SignalView) -> None:
    trace = view.trace
    t = _milliseconds(view, trace.t_ns)
    few = slice(None, None, max(1, len(t) // 300))  # the levels change slowly
    axes.fill_between(t[few], trace.low[few], trace.high[few], color=SHADE, linewidth=0)
    kept = extremes(trace.filtered, MOST_POINTS)
    axes.plot(t[kept], trace.filtered[kept], color=INK, linewidth=0.9)
    axes.plot(t[few], trace.high[few], color=HIGH_COLOUR, linewidth=1.2, label='high level')
    axes.plot(t[few], trace.low[few], color=LOW_COLOUR, linewidth=1.2, label='low level')
    _name(axes, 'filtered\nsignal\n(events)')
    low, high = axes.get_ylim()
    axes.set_ylim(low, high + 0.22 * (high - low))
    axes.legend(loc='upper right', ncols=2, borderaxespad=0.1)


def _draw_events(axes: Axes, view: SignalView) -> None:
    stretch = view.stretch
    edges = np.arange(stretch.begin_ns, stretch.end_ns, stretch.bit_ns / 4.0)
    t = _milliseconds(view, edges[:-1])
    for sign, colour, name in ((1, ON_COLOUR, 'ON'), (-1, OFF_COLOUR, 'OFF')):
        counts, _ = np.histogram(view.t_ns[view.polarity == sign], edges)
        axes.bar(t, sign * counts, stretch.bit_ns / 4e6, align='edge', color=colour, label=name, linewidth=0)
    axes.axhline(0.0, color=MUTED, linewidth=0.7)
    _name(axes, 'events in\n¼ bit')
    axes.yaxis.set_major_formatter(lambda value, _: f'{abs(value):g}')
    low, high = axes.get_ylim()
    axes.set_ylim(low, high + 0.3 * (high - low))
    axes.legend(loc='upper right', ncols=2, borderaxespad=0.1)


def _draw_line(axes: Axes, view: SignalView) -> None:
    trace = view.trace
    t = _milliseconds(view, np.array([view.stretch.begin_ns, *trace.edges_ns, view.stretch.end_ns], np.float64))
    last = trace.rising[-1] if len(trace.rising) else trace.line_before
    axes.step(t, [float(trace.line_before), *trace.rising.astype(float), float(last)], where='post', color=INK, linewidth=1.1)
    axes.set(ylim=(-0.25, 1.25), yticks=(0, 1))
    _name(axes, 'binarised')
    axes.grid(False)


def _draw_ratios(axes: Axes, view: SignalView, name: str, read: Sequence[Character]) -> None:
    for one in read:
        bit_ms = 1e3 / one.bit_rate_bps
        x = _milliseconds(view, one.t_ns) + bit_ms * (np.arange(len(one.bit_llr)) + 0.5)
        values = np.array(one.bit_llr)
        axes.bar(x, values, 0.7 * bit_ms, color=np.where(values > 0.0, ON_COLOUR, OFF_COLOUR), linewidth=0)
    axes.axhline(0.0, color=MUTED, linewidth=0.7)
    _name(axes, f'{name}\nlog p(1)/p(0)\n(nat)')


def _draw_frames(axes: Axes, view: SignalView, name: str, read: Sequence[Character], frame: CharacterFrame) -> None:
    sent = dict(view.sent)
    for one in read:
        due = min(sent, key=lambda t: abs(t - one.t_ns), default=None)
        is_due = due is not None and abs(due - one.t_ns) < 0.25 * frame.duration_ns(one.bit_rate_bps)
        right = None if not sent else bool(is_due and due is not None and sent[due] == one.code)
        true = frame.frame_of(sent[due]) if is_due and due is not None else None
        _draw_cells(axes, view, one.t_ns, one.bit_rate_bps, one.frame, true, frame)
        colour = INK if right is None else RIGHT_COLOUR if right else WRONG_COLOUR
        label = f'{shown(one.code)}  {one.status.name.lower().replace("_", " ")}'
        if one.confidence < 0.999:
            label += f', {one.confidence:.2f}'
        if right is False:
            label += ', wrong' if is_due else ', inserted'
        middle = _milliseconds(view, one.t_ns) + 0.5 * frame.length * 1e3 / one.bit_rate_bps
        axes.text(middle, 1.5, label, ha='center', va='center', color=colour, weight='bold', fontsize=9, clip_on=True)
    axes.set(ylim=(0.0, 2.0), yticks=())
    _name(axes, f'{name}\nreads')
    axes.grid(False)
    axes.spines['left'].set_visible(False)


def _draw_sent(axes: Axes, view: SignalView, frame: CharacterFrame) -> None:
    for due_ns, code in view.sent:
        _draw_cells(axes, view, due_ns, view.stretch.bit_rate_bps, frame.frame_of(code), None, frame)
    axes.set(ylim=(0.0, 1.0), yticks=())
    _name(axes, 'sent')
    axes.grid(False)
    axes.spines['left'].set_visible(False)


def _draw_cells(
    axes: Axes, view: SignalView, t_ns: float, bit_rate_bps: float, bits: int, true: int | None, frame: CharacterFrame
) -> None:
    from matplotlib.patches import Rectangle

    bit_ms = 1e3 / bit_rate_bps
    begin = _milliseconds(view, t_ns)
    for place in range(frame.length):
        bit = bits >> (frame.length - 1 - place) & 1
        wrong = true is not None and bit != (true >> (frame.length - 1 - place) & 1)
        data = 0 < place <= frame.data_bits
        x = begin + place * bit_ms
        fill = WRONG_COLOUR if wrong else 'none' if data else SHADE
        axes.add_patch(
            Rectangle((x, 0.0), bit_ms, 0.98, facecolor=fill, edgecolor=MUTED, linewidth=0.5, alpha=0.8 if wrong else 1.0)
        )
        axes.text(
            x + 0.5 * bit_ms, 0.48, str(bit), ha='center', va='center', fontsize=8, clip_on=True,
            color='white' if wrong else INK,
        )  # fmt: skip


def shown(code: int) -> str:
    """Return a code as text."""
    return {0x0A: 'LF', 0x20: 'SP'}.get(code, f'“{chr(code)}”' if chr(code).isprintable() else f'0x{code:02X}')


def image_figure(view: ImageView) -> Figure:
    """Draw the index image, the blobs of the instant, and the paths of the whole recording."""
    from matplotlib.colors import PowerNorm
    from matplotlib.patches import Circle

    height, width = view.index.shape
    figure = new_figure(9.6, 0.5 + 8.0 * height / width)
    axes = figure.subplots()
    top = float(np.quantile(view.index[view.index > 0.0], 0.999)) if (view.index > 0.0).any() else 1.0
    norm = PowerNorm(0.5, 0.0, max(top, 1.0))
    image = axes.imshow(view.index, cmap='magma', norm=norm, interpolation='nearest', origin='upper', aspect='equal')
    bar = figure.colorbar(image, ax=axes, shrink=0.75, pad=0.015)
    bar.set_label('index I = n / (B + |Σσ|)')
    bar.outline.set_visible(False)
    for blob in view.blobs:
        ring = Circle((blob.x_px, blob.y_px), blob.extent_px + 2.0, fill=False, edgecolor='white', linewidth=0.8, alpha=0.8)
        axes.add_patch(ring)
    tracks = [path for path in view.paths if not path.true]
    for path in (one for one in view.paths if one.true):
        axes.plot(path.x_px, path.y_px, color='white', linewidth=2.6, alpha=0.35, solid_capstyle='round')
    place = 0
    for path in tracks:
        colour = COLOURS[place % len(COLOURS)] if path.confirmed else '#9a9a9a'
        place += path.confirmed
        axes.plot(path.x_px, path.y_px, color=colour, linewidth=1.3 if path.confirmed else 0.6)
        if path.at is None:
            continue
        x, y, extent = path.at
        if path.confirmed:
            axes.add_patch(Circle((x, y), extent + 5.0, fill=False, edgecolor=colour, linewidth=1.8))
            left = x > 0.85 * width
            axes.annotate(
                path.name, (x, y), (-12 if left else 12, 10), textcoords='offset points', color='white', fontsize=9,
                ha='right' if left else 'left', weight='bold',
                bbox={'boxstyle': 'round,pad=0.25', 'facecolor': colour, 'edgecolor': 'none'},
            )  # fmt: skip
        else:
            axes.plot(x, y, '+', color='#bbbbbb', markersize=4, markeredgewidth=0.7)
    axes.set(xlim=(-0.5, width - 0.5), ylim=(height - 0.5, -0.5), xlabel='x (px)', ylabel='y (px)')
    axes.grid(False)
    return figure


@dataclass(frozen=True, slots=True, eq=False)
class Series:
    """Values over time.

    Attributes:
        name: of the beacon, and the receiver where there are several.
        t_s: times (s), ``(n,)``.
        values: ``(n,)``.
        receiver: who.
    """

    name: str
    t_s: NDArray[np.float64]
    values: NDArray[np.float64]
    receiver: str


def over_time_figure(errors: Sequence[Series], accuracies: Sequence[Series]) -> Figure:
    """Draw the distance from the true path, and the share of right characters, over time."""
    drawn = [
        (errors, 'distance from\nthe true centre (px)'),
        (accuracies, f'right of the last\n{ROLLING_CHARACTERS} characters'),
    ]
    drawn = [(series, label) for series, label in drawn if series]
    figure = new_figure(10.5, 0.7 + 2.1 * len(drawn))
    panels = figure.subplots(len(drawn), 1, sharex=True, squeeze=False)[:, 0]
    names = list(dict.fromkeys(one.name for series, _ in drawn for one in series))
    receivers = list(dict.fromkeys(one.receiver for series, _ in drawn for one in series))
    many = len(names) > len(COLOURS)
    colours = {name: MUTED if many else COLOURS[place % len(COLOURS)] for place, name in enumerate(names)}
    for axes, (series, label) in zip(panels, drawn, strict=True):
        for one in series:
            keep = slice(None, None, max(1, len(one.t_s) // MOST_POINTS))
            dashed = receivers.index(one.receiver) > 0 and len(names) > 1
            axes.plot(
                one.t_s[keep],
                one.values[keep],
                color=RECEIVER_COLOURS.get(one.receiver, MUTED) if len(names) == 1 else colours[one.name],
                linewidth=0.6 if many else 1.1,
                alpha=0.5 if many else 0.9,
                linestyle='--' if dashed else '-',
                label=None if many else one.name + (f', {one.receiver}' if len(receivers) > 1 else ''),
            )
        axes.set_ylabel(label)
        if series is errors:
            top = max(float(np.quantile(np.concatenate([one.values for one in series]), 0.995)), 0.5)
            axes.set_ylim(0.0, 1.15 * top)
        else:
            least = min(float(one.values.min()) for one in series)
            axes.set_ylim(min(0.75, least - 0.05), 1.04)
            axes.yaxis.set_major_formatter(lambda y, _: f'{100.0 * y:g} %')
    if not many:
        figure.legend(*panels[0].get_legend_handles_labels(), loc='outside upper left', ncols=4)
    panels[-1].set_xlabel('recording time (s)')
    figure.align_ylabels(panels)
    return figure


@dataclass(frozen=True, slots=True)
class RatePoint:
    """Accuracy of one beacon at its bit rate.

    Attributes:
        group: what it is one of, for its colour: a receiver.
        bit_rate_bps: at which rate (bit/s).
        message_accuracy, bit_accuracy: shares.
        message_interval, bit_interval: 95 %.
    """

    group: str
    bit_rate_bps: float
    message_accuracy: float
    bit_accuracy: float
    message_interval: Interval
    bit_interval: Interval


def rate_figure(points: Sequence[RatePoint]) -> Figure:
    """Draw message and bit accuracy against the bit rate."""
    from matplotlib.ticker import FixedLocator, NullLocator

    figure = new_figure(10.5, 3.4)
    panels = figure.subplots(1, 2, sharey=True)
    groups = list(dict.fromkeys(point.group for point in points))
    for axes, kind in zip(panels, ('message', 'bit'), strict=True):
        for place, group in enumerate(groups):
            own = sorted((point for point in points if point.group == group), key=lambda point: point.bit_rate_bps)
            x = [point.bit_rate_bps * (1.0 + 0.02 * (place - 0.5 * (len(groups) - 1))) for point in own]
            y = np.array([getattr(point, f'{kind}_accuracy') for point in own])
            low = y - [getattr(point, f'{kind}_interval').low for point in own]
            high = [getattr(point, f'{kind}_interval').high for point in own] - y
            colour = RECEIVER_COLOURS.get(group, COLOURS[place % len(COLOURS)])
            axes.errorbar(
                x, y, np.maximum((low, high), 0.0), fmt='os'[place % 2], color=colour, markersize=5, capsize=2, label=group,
                linewidth=1.0,
            )  # fmt: skip
        axes.set_xscale('log')
        rates = sorted({round(point.bit_rate_bps) for point in points})
        if len(rates) <= 8:
            axes.xaxis.set_major_locator(FixedLocator(rates))
        axes.xaxis.set_minor_locator(NullLocator())
        axes.set(title=f'{kind} accuracy', xlabel='bit rate (bit/s)', ylim=(-0.04, 1.06))
        axes.xaxis.set_major_formatter(lambda x, _: f'{x:g}')
        axes.yaxis.set_major_formatter(lambda y, _: f'{100.0 * y:g} %')
    panels[0].legend(loc='lower left')
    return figure


def reliability_figure(bins: Mapping[str, Sequence[Bin]]) -> Figure:
    """Draw, for each receiver, the share of right characters against the confidence that they were given with."""
    figure = new_figure(6.4, 4.6)
    axes = figure.subplots()
    axes.plot((0.0, MOST_NINES), (0.0, MOST_NINES), color=MUTED, linewidth=1.0, linestyle=':', label='calibrated')
    for place, (receiver, own) in enumerate(bins.items()):
        colour = RECEIVER_COLOURS.get(receiver, COLOURS[place % len(COLOURS)])
        x = np.array([nines(one.confidence) for one in own])
        y = np.array([nines(one.share) for one in own])
        low = np.array([nines(one.interval.low) for one in own])
        high = np.array([nines(one.interval.high) for one in own])
        axes.errorbar(x, y, (y - low, np.maximum(high - y, 0.0)), fmt='none', ecolor=colour, linewidth=0.9, alpha=0.7)
        size = 12.0 + 14.0 * np.log10([one.characters for one in own])
        flawless = np.array([one.right == one.characters for one in own])
        axes.scatter(x, y, size, facecolors=np.where(flawless, 'none', colour), edgecolors=colour, label=receiver, zorder=3)
    ticks = (0.0, 0.6, 0.9, 0.99, 0.999, 0.9999, 0.99999)
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_ticks([nines(tick) for tick in ticks], [f'{100.0 * tick:g} %' for tick in ticks])
    axes.set(xlabel='confidence', ylabel='right', xlim=(-0.15, MOST_NINES + 0.15), ylim=(-0.15, MOST_NINES + 0.15))
    axes.legend(loc='lower right')
    return figure


def nines(share: float) -> float:
    """Return −log10(1 − share), at most :data:`MOST_NINES`: the nines of a share, with 0 at 0."""
    return min(MOST_NINES, -math.log10(max(1.0 - share, 10.0**-MOST_NINES)))


def extremes(values: NDArray[np.float64], most: int) -> NDArray[np.int64]:
    """Return the places of the least and the greatest value of each of so many stretches: what a curve looks like, ``(m,)``."""
    if len(values) <= 2 * most:
        return np.arange(len(values))
    edges = np.linspace(0, len(values), most + 1).astype(np.int64)
    places = [(a + int(np.argmin(values[a:b])), a + int(np.argmax(values[a:b]))) for a, b in pairwise(edges)]
    return np.unique(np.array([0, *(place for pair in places for place in pair), len(values) - 1], np.int64))


def rolling_share(right: NDArray[np.bool_], count: int = ROLLING_CHARACTERS) -> NDArray[np.float64]:
    """Return the share of right ones among the last ``count`` at each, fewer at the beginning, ``(n,)``."""
    total = np.concatenate(([0], np.cumsum(right)))
    ends = np.arange(1, len(right) + 1)
    begins = np.maximum(ends - count, 0)
    return np.asarray((total[ends] - total[begins]) / (ends - begins), np.float64)
