"""How many characters each receiver gets wrong as a waveform gets harder to read: tables, figures, JSON.

::

    share  │            ╭── threshold        one figure a stress, one panel a waveform,
    wrong  │        ╭───╯                    one curve a receiver,
           │  ╭─────╯   ╭── sequence         0 on the axis, too
         0 ┼──┴─────────╯
           └──────────────► severity
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from beacon_comm.core.errors import RecordingError
from beacon_comm.evaluation.scoring import wilson_interval

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

FIGURE_FOLDER = 'figures'
PANELS_A_ROW = 3
# Shares below this are drawn on a linear scale, so that 0 has a place beside the decades.
LINEAR_BELOW = 1e-3
MARKERS = 'osD^vPX'
COLOURS = ('#c44e52', '#1f5fa8', '#2f9e63', '#8d6cc2', '#b8860b', '#555555', '#d97ab3')


@dataclass(frozen=True, slots=True)
class Stress:
    """One way to make a waveform harder to read.

    Attributes:
        name: for command lines and files.
        title: for people.
        meaning: what is done to the events; Markdown.
        axis: what the severity is, with its unit.
        unit: behind a severity in tables.
        severities: in order.
        none: the severity that changes nothing; one of them.
        asked: the one that the summary shows.
        logarithmic: whether the axis is.
    """

    name: str
    title: str
    meaning: str
    axis: str
    unit: str
    severities: tuple[float, ...]
    none: float
    asked: float
    logarithmic: bool = False

    def text_of(self, severity: float) -> str:
        """Return a severity with its unit."""
        return f'{severity:g}{" " if self.unit else ""}{self.unit}'


@dataclass(frozen=True, slots=True)
class StressedWaveform:
    """One of the waveforms that are made harder.

    Attributes:
        name: for people.
        events: as it is.
        bit_rate_bps: the sender's (bit/s).
        listed_bps: bit rates that the receivers are told to try (bit/s).
        sendings: of the truth.
        characters: of these sendings, together.
    """

    name: str
    events: int
    bit_rate_bps: float
    listed_bps: tuple[float, ...]
    sendings: int
    characters: int


@dataclass(frozen=True, slots=True)
class StressCount:
    """What one receiver made of one waveform at one severity; all sendings together.

    Attributes:
        stress, waveform, receiver: names.
        severity: in the stress's unit.
        events: after the stress.
        characters: truth characters that the unstressed waveform holds.
        wrong: of these, decoded as another code, or missing; and what was inserted.
        missing: not decoded at all.
        inserted: decoded characters inside the sendings without a match.
        wrong_ok: wrong (not missing) ones with the status ok.
        repaired: matched characters with the status repaired, right or wrong.
        outside: decoded characters before, between and after the sendings; not among the wrong ones.
        untouched: characters that no gap touched; None where there are no gaps.
        untouched_wrong: of these, wrong or missing.
    """

    stress: str
    waveform: str
    receiver: str
    severity: float
    events: int
    characters: int
    wrong: int
    missing: int
    inserted: int
    wrong_ok: int
    repaired: int
    outside: int
    untouched: int | None = None
    untouched_wrong: int | None = None

    @property
    def share(self) -> float:
        """Wrong over sent characters; 1 at most, as a message accuracy is 0 at least."""
        return min(1.0, self.wrong / self.characters)


@dataclass(frozen=True, slots=True)
class StressResults:
    """Everything that was measured.

    Attributes:
        stresses: in order.
        waveforms: in order.
        receivers: names, in order.
        counts: one for each stress, waveform, receiver and severity.
    """

    stresses: tuple[Stress, ...]
    waveforms: tuple[StressedWaveform, ...]
    receivers: tuple[str, ...]
    counts: tuple[StressCount, ...]

    def curve(self, stress: str, waveform: str, receiver: str) -> list[StressCount]:
        """Return the counts of one curve, by severity."""
        found = [
            count
            for count in self.counts
            if (count.stress, count.waveform, count.receiver) == (stress, waveform, receiver)
        ]
        return sorted(found, key=lambda count: count.severity)

    def at(self, stress: str, waveform: str, receiver: str, severity: float) -> StressCount | None:
        """Return one point of a curve, None where there is none."""
        curve = self.curve(stress, waveform, receiver)
        return next((count for count in curve if count.severity == severity), None)


def require_matplotlib() -> None:
    """Check that figures can be drawn, before anything is measured.

    Raises:
        RecordingError: matplotlib is not there.
    """
    try:
        import matplotlib.figure  # noqa: F401 (slow to import)
    except ImportError as error:
        raise RecordingError(f'the figures need matplotlib ({error})') from error


def write_report(folder: Path, results: StressResults, command: str) -> list[Path]:
    """Write ``stress.md``, ``stress.json`` and ``figures/stress_*.png``; return their paths.

    Args:
        folder: where to; it is made.
        results: what was measured.
        command: that measured it, for the page.

    Raises:
        RecordingError: a file cannot be written, or matplotlib is not there.
    """
    require_matplotlib()
    figures = folder / FIGURE_FOLDER
    page, data = folder / 'stress.md', folder / 'stress.json'
    try:
        figures.mkdir(parents=True, exist_ok=True)
        for stress in results.stresses:
            stress_figure(results, stress).savefig(figures / figure_name(stress), dpi=110)
        page.write_text(markdown(results, command), encoding='utf-8')
        data.write_text(json.dumps(stress_json(results), indent=1) + '\n', encoding='utf-8')
    except OSError as error:
        raise RecordingError(f'{folder}: cannot be written ({error.strerror or error})') from error
    return [page, data, *(figures / figure_name(stress) for stress in results.stresses)]


def figure_name(stress: Stress) -> str:
    """Return the file name of a stress's figure."""
    return f'stress_{stress.name}.png'


def stress_json(results: StressResults) -> dict[str, Any]:
    """Return everything as one JSON object; keys as the attributes of the values in this file."""
    return {
        'stresses': [asdict(stress) for stress in results.stresses],
        'waveforms': [asdict(waveform) for waveform in results.waveforms],
        'receivers': list(results.receivers),
        'counts': [asdict(count) for count in results.counts],
    }


# Tables


def markdown(results: StressResults, command: str) -> str:
    """Return the page with all tables and figures."""
    parts = [HEAD.format(command=command), _waveforms_table(results), SUMMARY_HEAD, summary_table(results), CELLS]
    for stress in results.stresses:
        parts += [
            f'## {stress.title}',
            stress.meaning,
            f'![{stress.title}: wrong characters]({FIGURE_FOLDER}/{figure_name(stress)})',
            counts_table(results, stress),
        ]
        if any(count.untouched is not None for count in results.counts if count.stress == stress.name):
            parts += [UNTOUCHED, untouched_table(results, stress)]
    return '\n\n'.join(parts) + '\n'


HEAD = """# Stress

What becomes of the characters when a waveform that can be read is made harder: one stress at a time, on the real
recordings and on simulated sonnets. The paper's receiver is `threshold`. This page, its figures and `stress.json` are
written by

```
{command}
```

All characters count that the waveform holds before it is stressed, from the first one on: wrong are those decoded as
another code, missing ones and inserted ones. (What is read at wrong times counts twice, as missing and as inserted, so
that there may be more than 100 %; the figures stop there.) Where the characters lie is known of a simulated text, and of
a recording it is found before it is stressed; it is carried through every change of the time axis and nothing is aligned
anew, so that a receiver that reads nothing has all of them wrong. Events reach the receivers in pieces of 100 ms, through
the candidate slot with its parity record. The random numbers of every stress have a fixed
seed; the simulated LED is the one of `simulation/led.py`."""

SUMMARY_HEAD = """## In short

Wrong characters, each at one severity (with the 95 % interval of the share, as if characters erred independently, in the
figures)."""

CELLS = """In the tables below a cell is **wrong** (missing, inserted; wrong with status ok; repaired)."""

UNTOUCHED = """Of the characters that no gap touched (a gap in one of its 11 bits, or in the half bit before or after): wrong
or missing ones, and what was inserted anywhere inside the sendings. In the figure, the broken line is the share of the
characters that a gap touched."""


def _waveforms_table(results: StressResults) -> str:
    rows = [
        (
            waveform.name,
            f'{waveform.bit_rate_bps:.2f}',
            ', '.join(f'{rate:g}' for rate in waveform.listed_bps),
            f'{waveform.events:,}',
            str(waveform.characters),
            str(waveform.sendings),
        )
        for waveform in results.waveforms
    ]
    return markdown_table(('Waveform', 'bit/s', 'rates listed', 'events', 'characters', 'sendings'), rows)


def summary_table(results: StressResults) -> str:
    """Return the share of wrong characters of every receiver at one severity of each stress."""
    rows = []
    for title, severity_of, names in _summary_lines(results):
        for waveform in results.waveforms:
            found = [results.at(names, waveform.name, name, severity_of) for name in results.receivers]
            if any(found):
                rows.append((title, waveform.name, *('–' if count is None else _percent(count) for count in found)))
    return markdown_table(('Stress', 'Waveform', *results.receivers), rows)


def _summary_lines(results: StressResults) -> Iterable[tuple[str, float, str]]:
    """Return title, severity and name of the stress: first none at all, then each at the severity asked for."""
    if results.stresses:
        first = results.stresses[0]
        yield 'none', first.none, first.name
    for stress in results.stresses:
        yield f'{stress.title}: {stress.text_of(stress.asked)}', stress.asked, stress.name


def counts_table(results: StressResults, stress: Stress) -> str:
    """Return all counts of one stress, a row for each waveform and severity."""

    def cell(count: StressCount) -> str:
        return f'**{count.wrong}** ({count.missing}, {count.inserted}; {count.wrong_ok}; {count.repaired})'

    return _by_severity(results, stress, cell)


def untouched_table(results: StressResults, stress: Stress) -> str:
    """Return, for gaps, the wrong ones of the characters that none touched, and the inserted ones."""

    def cell(count: StressCount) -> str:
        return f'**{count.untouched_wrong}** of {count.untouched}, {count.inserted} inserted'

    return _by_severity(results, stress, cell)


def _by_severity(results: StressResults, stress: Stress, cell: Callable[[StressCount], str]) -> str:
    rows = []
    for waveform in results.waveforms:
        for severity in stress.severities:
            found = [results.at(stress.name, waveform.name, name, severity) for name in results.receivers]
            sent = next((str(count.characters) for count in found if count is not None), None)
            if sent is not None:
                cells = ('–' if count is None else cell(count) for count in found)
                rows.append((waveform.name, stress.text_of(severity), sent, *cells))
    return markdown_table(('Waveform', 'Severity', 'Sent', *results.receivers), rows)


def markdown_table(columns: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Return a Markdown table."""
    lines = [columns, ['---'] * len(columns), *rows]
    return '\n'.join('| ' + ' | '.join(line) + ' |' for line in lines)


def _percent(count: StressCount) -> str:
    share = 100.0 * count.wrong / count.characters
    digits = 0 if share >= 100.0 else 1 if share >= 1.0 or not share else 2
    return f'{share:.{digits}f} % ({count.wrong} of {count.characters})'


# Figures


def stress_figure(results: StressResults, stress: Stress) -> Figure:
    """Draw one stress: a panel for each waveform, a curve for each receiver."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg  # slow to import
    from matplotlib.figure import Figure

    # The legend has a panel's place.
    places = len(results.waveforms) + 1
    columns = min(places, PANELS_A_ROW)
    rows = -(-places // columns)
    figure = Figure(figsize=(3.1 * columns, 0.5 + 2.6 * rows), layout='constrained')
    FigureCanvasAgg(figure)
    panels = figure.subplots(rows, columns, squeeze=False).ravel()
    for panel, waveform in zip(panels, results.waveforms, strict=False):
        _draw_panel(panel, results, stress, waveform.name)
    for place, panel in enumerate(panels[: len(results.waveforms)]):
        if place % columns == 0:
            panel.set_ylabel('wrong characters')
        if place + columns >= places - 1:
            panel.set_xlabel(stress.axis)
    for panel in panels[len(results.waveforms) :]:
        panel.set_axis_off()
    handles, labels = panels[0].get_legend_handles_labels()
    panels[len(results.waveforms)].legend(handles, labels, loc='center', frameon=False)
    figure.suptitle(stress.title, x=0.01, ha='left')
    return figure


def _draw_panel(panel: Axes, results: StressResults, stress: Stress, waveform: str) -> None:
    from matplotlib.ticker import FixedLocator, FuncFormatter, NullLocator

    for place, receiver in enumerate(results.receivers):
        curve = results.curve(stress.name, waveform, receiver)
        x = [count.severity for count in curve]
        colour = COLOURS[place % len(COLOURS)]
        intervals = [wilson_interval(count.share, count.characters) for count in curve]
        panel.fill_between(
            x, [i.low for i in intervals], [i.high for i in intervals], color=colour, alpha=0.13, linewidth=0
        )
        # Where curves lie on one another, the later one is smaller and lets the earlier one be seen.
        panel.plot(
            x,
            [count.share for count in curve],
            label=receiver,
            color=colour,
            marker=MARKERS[place % len(MARKERS)],
            markersize=max(3.0, 7.0 - 1.5 * place),
            linewidth=max(1.0, 2.2 - 0.5 * place),
            clip_on=False,
            zorder=3 + place,
        )
    touched = [
        (count.severity, 1.0 - count.untouched / count.characters)
        for count in results.curve(stress.name, waveform, results.receivers[0])
        if count.untouched is not None
    ]
    if touched:
        panel.plot(*zip(*touched, strict=True), '--', color='0.45', linewidth=1.0, label='touched by a gap', zorder=2)
    if stress.logarithmic:
        if min(stress.severities) > 0.0:
            panel.set_xscale('log')
        else:
            panel.set_xscale('symlog', linthresh=_least(stress), linscale=0.5)
        panel.xaxis.set_minor_locator(NullLocator())
    panel.xaxis.set_major_locator(FixedLocator(_spread(stress)))
    panel.xaxis.set_major_formatter(FuncFormatter(lambda x, _: f'{x:g}'))
    panel.set_yscale('symlog', linthresh=LINEAR_BELOW, linscale=0.5)
    panel.set_ylim(0.0, 1.15)
    panel.yaxis.set_major_locator(FixedLocator([0.0, 0.001, 0.01, 0.1, 1.0]))
    panel.yaxis.set_minor_locator(NullLocator())
    panel.yaxis.set_major_formatter(FuncFormatter(lambda y, _: f'{100.0 * y:g} %'))
    if stress.none == max(stress.severities):
        panel.invert_xaxis()  # harder to the right
    panel.set_title(waveform, fontsize='medium')
    panel.grid(alpha=0.25)
    for side in ('top', 'right'):
        panel.spines[side].set_visible(False)


def _least(stress: Stress) -> float:
    """Return the smallest severity above 0: below it, a logarithmic axis that has a 0 is linear."""
    return min(severity for severity in stress.severities if severity > 0.0)


def _spread(stress: Stress) -> list[float]:
    """Return the severities that get a tick: none so close to one before that their numbers would touch."""
    def place(severity: float) -> float:
        return math.log10(max(severity, 0.3 * _least(stress))) if stress.logarithmic else severity

    low, high = place(min(stress.severities)), place(max(stress.severities))
    ticks: list[float] = []
    for severity in sorted(stress.severities, reverse=stress.none == max(stress.severities)):
        if not ticks or abs(place(severity) - place(ticks[-1])) >= 0.13 * (high - low):
            ticks.append(severity)
    return ticks
