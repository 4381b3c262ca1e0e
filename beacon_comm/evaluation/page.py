"""One HTML page that needs nothing else: tables, figures as SVG in it, light and dark by the reader's own setting.

Figures are drawn in a few colours that stand for a role (ink, lines, shade); in the page these become its style's variables.
"""

from __future__ import annotations

import html
import io
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from beacon_comm.core.errors import RecordingError
from beacon_comm.evaluation.report import LEFT, without_sole_receiver

if TYPE_CHECKING:
    from matplotlib.figure import Figure

PX_PER_INCH = 114
INK, MUTED, LINE, SHADE = '#10141a', '#6a7280', '#dde1e7', '#eef1f4'
_ROLES = {INK: 'var(--ink)', MUTED: 'var(--muted)', LINE: 'var(--line)', SHADE: 'var(--shade)'}

_STYLE = """
:root { color-scheme: light dark;
  --ink: #1a1e25; --muted: #5d6673; --line: #dde1e7; --shade: #eef1f4; --page: #fbfbfa; --card: #ffffff;
  --accent: #1f6fbf; --wrong: #c62f2f; --wrong-shade: #fbe3e1; --right: #23804a; }
@media (prefers-color-scheme: dark) { :root {
  --ink: #e6e9ee; --muted: #9aa4b2; --line: #343b46; --shade: #262c35; --page: #14171c; --card: #1b1f26;
  --accent: #6cb2ff; --wrong: #ff8a80; --wrong-shade: #4a2422; --right: #74cf98; } }
* { box-sizing: border-box; }
body { margin: 0; background: var(--page); color: var(--ink);
  font: 16px/1.55 system-ui, -apple-system, "Segoe UI", Roboto, "DejaVu Sans", sans-serif; }
main { max-width: 1240px; margin: 0 auto; padding: 2.5rem 1.25rem 5rem; }
h1 { font-size: 1.9rem; line-height: 1.2; margin: 0 0 .4rem; letter-spacing: -.01em; }
h2 { font-size: 1.35rem; margin: 3.2rem 0 .6rem; padding-top: 1.1rem; border-top: 1px solid var(--line); }
h3 { font-size: 1.05rem; margin: 2rem 0 .4rem; }
p { max-width: 52rem; margin: .5rem 0 .9rem; }
.lead, .note, figcaption { color: var(--muted); }
.lead { font-size: 1.05rem; }
code, pre, .text { font-family: ui-monospace, "SF Mono", Menlo, Consolas, "DejaVu Sans Mono", monospace; font-size: .86em; }
pre { background: var(--shade); padding: .8rem 1rem; border-radius: 8px; overflow-x: auto; white-space: pre-wrap;
  overflow-wrap: anywhere; }
nav { margin: 1rem 0 0; display: flex; flex-wrap: wrap; gap: .3rem 1.2rem; }
a { color: var(--accent); text-decoration: none; } a:hover { text-decoration: underline; }
.tiles { display: grid; grid-template-columns: repeat(auto-fit, minmax(9.2rem, 1fr)); gap: .8rem; margin: 1.6rem 0 .6rem; }
.tile { background: var(--card); border: 1px solid var(--line); border-radius: 10px; padding: .8rem 1rem; }
.tile b { display: block; font-size: 1.55rem; line-height: 1.25; font-variant-numeric: tabular-nums; }
.tile span { color: var(--muted); font-size: .86rem; }
.tile b.bad { color: var(--wrong); } .tile b.good { color: var(--right); }
.scroll { overflow-x: auto; margin: .8rem 0 1.2rem; border: 1px solid var(--line); border-radius: 10px;
  background: var(--card); }
table { border-collapse: collapse; width: 100%; font-size: .82rem; font-variant-numeric: tabular-nums; }
th, td { padding: .4rem .6rem; text-align: right; white-space: nowrap; border-bottom: 1px solid var(--line); }
tr:last-child td { border-bottom: 0; }
th { color: var(--muted); font-weight: 600; } th.left, td.left { text-align: left; }
td .interval { display: block; color: var(--muted); font-size: .9em; }
th:first-child, td:first-child { position: sticky; left: 0; background: var(--card); }
th { vertical-align: bottom; } td { vertical-align: top; }
figure { margin: 1.2rem 0 1.8rem; background: var(--card); border: 1px solid var(--line); border-radius: 10px;
  padding: 1rem 1rem .8rem; }
figure .drawing { overflow-x: auto; } figure svg { display: block; width: 100%; min-width: 560px;
  height: auto; margin: 0 auto; }
figcaption { font-size: .9rem; margin-top: .7rem; max-width: 60rem; }
details { margin: .6rem 0; } summary { cursor: pointer; color: var(--accent); }
.text { white-space: pre-wrap; overflow-wrap: anywhere; line-height: 1.75; background: var(--card);
  border: 1px solid var(--line); border-radius: 10px; padding: .8rem 1rem; margin: .6rem 0 1rem; }
.text .w { background: var(--wrong-shade); color: var(--wrong); border-radius: 3px; font-weight: 700; padding: 0 .1em; }
.text .feed { color: var(--muted); }
"""


class Page:
    """A page that grows from top to bottom.

    Args:
        title: of the page.
        lead: what it is, in a sentence or two (HTML).
    """

    def __init__(self, title: str, lead: str) -> None:
        self._title = title
        self._lead = lead
        self._parts: list[str] = []
        self._links: list[tuple[str, str]] = []
        self._figures = 0

    def section(self, title: str) -> None:
        """Begin a section; it gets a link at the top."""
        anchor = f's{len(self._links) + 1}'
        self._links.append((anchor, title))
        self._parts.append(f'<h2 id="{anchor}">{html.escape(title)}</h2>')

    def heading(self, title: str) -> None:
        """Begin a part of a section."""
        self._parts.append(f'<h3>{html.escape(title)}</h3>')

    def paragraph(self, text: str, note: bool = False) -> None:
        """Add a paragraph of HTML."""
        self._parts.append(f'<p{" class=note" if note else ""}>{text}</p>')

    def tiles(self, tiles: Sequence[tuple[str, str, str]]) -> None:
        """Add numbers that are seen first: value, what it is, and ``good``, ``bad`` or nothing."""
        made = ''.join(
            f'<div class=tile><b class="{kind}">{html.escape(value)}</b><span>{html.escape(name)}</span></div>'
            for value, name, kind in tiles
        )
        self._parts.append(f'<div class=tiles>{made}</div>')

    def table(self, columns: Sequence[str], rows: Sequence[Sequence[str]]) -> None:
        """Add a table; what stands in brackets is made pale."""
        if not rows:
            return
        columns, rows = without_sole_receiver(columns, rows)
        sides = [' class=left' if name in LEFT else '' for name in columns]
        head = ''.join(f'<th{side}>{html.escape(name)}</th>' for side, name in zip(sides, columns, strict=True))
        body = ''.join(
            '<tr>' + ''.join(f'<td{side}>{_cell(cell)}</td>' for side, cell in zip(sides, row, strict=True)) + '</tr>'
            for row in rows
        )
        self._parts.append(f'<div class=scroll><table><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table></div>')

    def figure(self, figure: Figure, caption: str, alt: str) -> None:
        """Add a figure with its caption (HTML) and what it is for those who do not see it."""
        self._figures += 1
        drawing = inline_svg(figure, f'f{self._figures}', alt)
        self._parts.append(f'<figure><div class=drawing>{drawing}</div><figcaption>{caption}</figcaption></figure>')

    def raw(self, content: str) -> None:
        """Add HTML as it is."""
        self._parts.append(content)

    def folded(self, title: str, content: str) -> None:
        """Add HTML that is seen once it is asked for."""
        self._parts.append(f'<details><summary>{html.escape(title)}</summary>{content}</details>')

    def html(self) -> str:
        """Return the page."""
        links = ''.join(f'<a href="#{anchor}">{html.escape(title)}</a>' for anchor, title in self._links)
        return (
            '<!doctype html>\n<html lang=en>\n<head>\n<meta charset=utf-8>\n'
            '<meta name=viewport content="width=device-width, initial-scale=1">\n'
            f'<title>{html.escape(self._title)}</title>\n<style>{_STYLE}</style>\n</head>\n<body>\n<main>\n'
            f'<h1>{html.escape(self._title)}</h1>\n<p class=lead>{self._lead}</p>\n<nav>{links}</nav>\n'
            + '\n'.join(self._parts)
            + '\n</main>\n</body>\n</html>\n'
        )

    def write(self, path: Path) -> None:
        """Write the page.

        Raises:
            RecordingError: the file cannot be written.
        """
        try:
            path.write_text(self.html(), encoding='utf-8')
        except OSError as error:
            raise RecordingError(f'{path}: cannot be written ({error.strerror})') from error


def _cell(text: str) -> str:
    return re.sub(r'(\[[^\]]*\])', r'<span class=interval>\1</span>', html.escape(text))


def parameters_table(values: Mapping[str, object]) -> str:
    """Return names and values as a table (HTML)."""
    rows = ''.join(
        f'<tr><td class=left><code>{html.escape(name)}</code></td><td class=left>{html.escape(str(value))}</td></tr>'
        for name, value in values.items()
    )
    return f'<div class=scroll><table><tbody>{rows}</tbody></table></div>'


def new_figure(width_in: float, height_in: float) -> Figure:
    """Return an empty figure, drawn in the page's roles of colour."""
    from matplotlib.backends.backend_svg import FigureCanvasSVG  # slow to import
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width_in, height_in), layout='constrained')
    FigureCanvasSVG(figure)
    return figure


STYLE = {
    'svg.fonttype': 'none',
    'svg.hashsalt': 'beacon_comm',
    'font.size': 9.5,
    'axes.edgecolor': MUTED,
    'axes.labelcolor': INK,
    'axes.titlecolor': INK,
    'axes.grid': True,
    'axes.axisbelow': True,
    'axes.spines.top': False,
    'axes.spines.right': False,
    'axes.titlesize': 'medium',
    'axes.facecolor': 'none',
    'figure.facecolor': 'none',
    'grid.color': LINE,
    'grid.linewidth': 0.7,
    'legend.frameon': False,
    'legend.fontsize': 'small',
    'text.color': INK,
    'xtick.color': MUTED,
    'ytick.color': MUTED,
}
"""Matplotlib's settings to draw with, for ``rc_context``."""


def inline_svg(figure: Figure, prefix: str, alt: str) -> str:
    """Return a figure as an ``<svg>`` element whose names begin with ``prefix``, in the page's colours."""
    import matplotlib

    out = io.StringIO()
    with matplotlib.rc_context(STYLE):
        figure.savefig(out, format='svg', dpi=150, metadata={'Date': None, 'Creator': None})
    text = out.getvalue()
    text = text[text.index('<svg') :]
    text = re.sub(r'<metadata>.*?</metadata>', '', text, flags=re.DOTALL)
    text = re.sub(r'\bid="', f'id="{prefix}-', text)
    text = re.sub(r'url\(#', f'url(#{prefix}-', text)
    text = re.sub(r'href="#', f'href="#{prefix}-', text)
    for colour, role in _ROLES.items():
        text = text.replace(colour, role)
    text = text.replace("'DejaVu Sans'", 'system-ui, sans-serif')
    label = html.escape(alt, quote=True)
    widest = f'max-width:{figure.get_figwidth() * PX_PER_INCH:.0f}px'
    attributes = f'role="img" aria-label="{label}" style="{widest}"'
    return re.sub(r'<svg ([^>]*?)width="[^"]*" ', lambda found: f'<svg {attributes} {found[1]}', text, count=1)
