"""Pictures of the line's level: for a terminal, and as an image.

       'S'                                    one cell a bit; the line is high (LED on) before and after
    ─┐  ┌──┐  ┌──┐     ┌─────┐  ┌───────
     └──┘  └──┘  └─────┘     └──┘
      0  1  0  1  0  0  1  1  0  1  1
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from beacon_comm.core.errors import RecordingError
from beacon_comm.core.framing import CharacterFrame

if TYPE_CHECKING:
    from matplotlib.axes import Axes

Bits = NDArray[np.uint8]
CELL = 3
CHARACTERS_A_ROW = 6
# An image with more is no picture any more; the rest of a text is left out, and the image says so.
MOST_ROWS = 16
PART_COLOURS = {'start': '#d1495b', 'data': '#30638e', 'parity': '#edae49', 'stop': '#5b8e7d'}


def frame_parts(frame: CharacterFrame) -> tuple[tuple[str, int, int], ...]:
    """Return name, first bit and end of each part of a character's frame."""
    data_end = 1 + frame.data_bits
    parity_end = data_end + frame.parity_bits
    parts = (('start', 0, 1), ('data', 1, data_end), ('parity', data_end, parity_end), ('stop', parity_end, frame.length))
    return tuple(part for part in parts if part[2] > part[1])


def visible(symbol: str) -> str:
    """Return a character as a label: quoted, with an escape where it cannot be printed."""
    return repr(symbol)


def terminal_waveform(text: str, bits: Bits, frame: CharacterFrame, width: int) -> str:
    """Return the waveform in box-drawing characters, wrapped to ``width`` columns.

    Args:
        text: what is sent.
        bits: its bits, ``(len(text) * frame.length,)``.
        frame: layout of a character.
        width: columns of the terminal.
    """
    a_row = max(1, (width - 2 * CELL) // (frame.length * CELL))
    rows = []
    for first in range(0, len(text), a_row):
        part = text[first : first + a_row]
        row_bits = bits[first * frame.length : (first + len(part)) * frame.length]
        before = int(bits[first * frame.length - 1]) if first else 1
        names = ''.join(visible(symbol).ljust(frame.length * CELL) for symbol in part)
        rows.append('\n'.join(line.rstrip() for line in (' ' + names, *_levels(row_bits, before))))
    return '\n\n'.join(rows)


def _levels(bits: Bits, before: int) -> tuple[str, str, str]:
    """Return upper line, lower line and bit values of one row."""
    upper, lower, values = ('─', ' ', ' ') if before else (' ', '─', ' ')
    level = before
    for bit in (*(int(bit) for bit in bits), None):
        following = level if bit is None else bit
        if following != level:
            upper += '┌' if following else '┐'
            lower += '┘' if following else '└'
        else:
            upper += '─' if level else ' '
            lower += ' ' if level else '─'
        if bit is not None:
            upper += ('─' if bit else ' ') * (CELL - 1)
            lower += (' ' if bit else '─') * (CELL - 1)
            values += f'{bit:^{CELL}}'
        level = following
    return upper, lower, values


def save_waveform(path: str | Path, text: str, bits: Bits, frame: CharacterFrame, bit_rate_bps: float) -> None:
    """Draw the waveform into an image file, a few characters a row; the suffix tells the format.

    Raises:
        RecordingError: the file cannot be written, or its format is not known.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg  # slow to import
    from matplotlib.figure import Figure
    from matplotlib.patches import Patch

    rows = min(MOST_ROWS, -(-len(text) // CHARACTERS_A_ROW))
    shown = text[: rows * CHARACTERS_A_ROW]
    figure = Figure(figsize=(14.0, 1.1 + 1.35 * rows), layout='constrained')
    FigureCanvasAgg(figure)
    axes = figure.subplots(rows, 1, squeeze=False)[:, 0]
    for row in range(rows):
        first = row * CHARACTERS_A_ROW
        _draw_row(axes[row], shown[first : first + CHARACTERS_A_ROW], first, bits, frame, bit_rate_bps)
    axes[-1].set_xlabel('time (ms)')
    handles = [
        Patch(color=PART_COLOURS[name], alpha=0.35, label=f'{name} bit' if stop - start == 1 else f'{name} bits')
        for name, start, stop in frame_parts(frame)
    ]
    figure.legend(handles=handles, loc='outside upper right', ncols=len(handles), frameon=False)
    rest = f' (the first {len(shown)} of {len(text)} characters)' if len(shown) < len(text) else ''
    figure.suptitle(f'{len(text)} character{"s" * (len(text) > 1)} at {bit_rate_bps:g} bit/s{rest}', x=0.01, ha='left')
    try:
        figure.savefig(path, dpi=100)
    except (OSError, ValueError) as error:
        raise RecordingError(f'{path}: cannot be written ({getattr(error, "strerror", None) or error})') from error


def _draw_row(
    axes: Axes, part: str, first: int, bits: Bits, frame: CharacterFrame, bit_rate_bps: float
) -> None:
    bit_ms = 1e3 / bit_rate_bps
    begin = first * frame.length
    row_bits = bits[begin : begin + len(part) * frame.length].astype(int)
    before = int(bits[begin - 1]) if begin else 1
    after = int(bits[begin + len(row_bits)]) if begin + len(row_bits) < len(bits) else 1
    levels = np.concatenate(([before], row_bits, [after]))
    edges_ms = (begin - 1 + np.arange(len(levels) + 1)) * bit_ms
    axes.stairs(levels, edges_ms, baseline=None, color='black', linewidth=1.6)
    for place, symbol in enumerate(part):
        start = begin + place * frame.length
        for name, a, b in frame_parts(frame):
            axes.axvspan((start + a) * bit_ms, (start + b) * bit_ms, color=PART_COLOURS[name], alpha=0.22, linewidth=0)
        axes.text((start + frame.length / 2) * bit_ms, 1.42, visible(symbol), ha='center', va='center', fontsize=11)
        for j in range(frame.length):
            axes.text((start + j + 0.5) * bit_ms, -0.28, str(bits[start + j]), ha='center', va='center', fontsize=8)
    axes.set_ylim(-0.5, 1.65)
    # A short last row keeps the scale of the others.
    columns = len(part) if first == 0 else CHARACTERS_A_ROW
    axes.set_xlim((begin - 1) * bit_ms, (begin + columns * frame.length + 1) * bit_ms)
    axes.set_yticks([0, 1], ['off 0', 'on 1'])
    for side in ('top', 'right'):
        axes.spines[side].set_visible(False)
