#!/usr/bin/env python3
"""Draw how the sequence receiver reads three characters of the real 3125 bps recording, and how the paper's receiver does.

    python docs/sequence_figure.py              # writes docs/figures/sequence_receiver.png

The stretch is the end of one line of the sonnet and the beginning of the next: a line feed (00001010011 on the line) has
a lone 0 between two 1s, the hardest of all bits.  Both receivers read the recording from its first event on.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from beacon_comm.core.character import Character, Status
from beacon_comm.core.demodulator import make_demodulator
from beacon_comm.core.events import NS_PER_S
from beacon_comm.core.framing import CharacterFrame
from beacon_comm.core.high_pass import HighPassFilter
from beacon_comm.core.parameters import Parameters
from beacon_comm.evaluation.held import Signal
from beacon_comm.evaluation.scoring import score
from beacon_comm.evaluation.truth import SONNET18
from beacon_comm.recordings.folder import recordings_folder
from beacon_comm.recordings.mat import read_mat

PROJECT = Path(__file__).resolve().parents[1]
FIGURE = PROJECT / 'docs' / 'figures' / 'sequence_receiver.png'
RECORDING, NOMINAL_BPS = '3125hz_30m.mat', 3125.0
SHOWN = 'e\nN'
FRAME = CharacterFrame()
BINS_PER_BIT = 4
MARGIN_BITS = 1.5
ON_COLOUR, OFF_COLOUR, WRONG_COLOUR, RIGHT_COLOUR = '#d9822b', '#3b6ea8', '#c62828', '#2e7d32'
PART_COLOURS = {'start': '#d5d5d5', 'data': '#ffffff', 'parity': '#f6e2a8', 'stop': '#d5d5d5'}


@dataclass(frozen=True, slots=True)
class Stretch:
    """What is drawn.

    Attributes:
        t_ns, polarity: events, ``(n,)`` int64 and ``(n,)`` int8.
        edges_ns, rising: edges of the paper's binarised line, ``(m,)`` int64 and ``(m,)`` bool.
        paper, sequence: what the receivers read, in order.
        sent: the text.
    """

    t_ns: NDArray[np.int64]
    polarity: NDArray[np.int8]
    edges_ns: NDArray[np.int64]
    rising: NDArray[np.bool_]
    paper: tuple[Character, ...]
    sequence: tuple[Character, ...]
    sent: str

    @property
    def zero_ns(self) -> int:
        """Where the first character's start bit begins, by the sequence receiver's clock (ns)."""
        return self.sequence[0].t_ns

    @property
    def bit_ns(self) -> float:
        """A bit of the sequence receiver's clock (ns)."""
        return NS_PER_S / self.sequence[0].bit_rate_bps

    def bits_at(self, t_ns: Any) -> Any:
        """Return times (ns) in bits from the first character's start."""
        return (t_ns - self.zero_ns) / self.bit_ns


def decode(t_ns: NDArray[np.int64], polarity: NDArray[np.int8], parameters: Parameters) -> list[Character]:
    """Return all characters of a recording."""
    demodulator = make_demodulator(parameters)
    return demodulator.push(t_ns, polarity, int(t_ns[-1]) + 1) + demodulator.flush()


def nearest(characters: list[Character], due_ns: float) -> Character:
    """Return the character that begins nearest to a time (ns)."""
    return min(characters, key=lambda one: abs(one.t_ns - due_ns))


def stretch(path: Path) -> Stretch:
    """Read the recording with both receivers; return the last place where the text says :data:`SHOWN`."""
    t_ns, polarity = read_mat(path)
    threshold = Parameters(receiver='threshold', bit_rates=(NOMINAL_BPS,))
    paper = decode(t_ns, polarity, threshold)
    sequence = decode(t_ns, polarity, Parameters(receiver='sequence', rate_search='blind'))
    sent = score(sequence, SONNET18, (int(t_ns[0]), int(t_ns[-1])), Signal(t_ns, polarity))[-1]
    assert sent.start_ns is not None and sent.bit_rate_bps is not None
    first = SONNET18.rindex(SHOWN)
    due_ns = [sent.start_ns + (first + k) * FRAME.duration_ns(sent.bit_rate_bps) for k in range(len(SHOWN))]
    edges = HighPassFilter(NOMINAL_BPS, threshold).push(t_ns, polarity)
    return Stretch(
        t_ns,
        polarity,
        edges.t_ns,
        edges.rising,
        tuple(nearest(paper, due) for due in due_ns),
        tuple(nearest(sequence, due) for due in due_ns),
        SHOWN,
    )


def shown(code: int) -> str:
    """Return a code as text."""
    return {0x0A: 'LF', 0x20: 'SP'}.get(code, f'“{chr(code)}”' if chr(code).isprintable() else f'0x{code:02X}')


def bits_of(frame: int) -> list[int]:
    """Return the bits of a frame in the order they are sent."""
    return [frame >> (FRAME.length - 1 - k) & 1 for k in range(FRAME.length)]


def part_of(place: int) -> tuple[str, str]:
    """Return what the bit at a place of the frame is, and its label."""
    if place == 0:
        return 'start', 'S'
    if place <= FRAME.data_bits:
        return 'data', f'd{FRAME.data_bits - place}'
    if place <= FRAME.data_bits + FRAME.parity_bits:
        return 'parity', 'P'
    return 'stop', 'E'


# Panels


def draw_events(axes: Any, found: Stretch, last_bit: float) -> None:
    """Draw ON events upwards and OFF events downwards, in quarter bits."""
    edges = np.arange(round(-MARGIN_BITS * BINS_PER_BIT), round(last_bit * BINS_PER_BIT) + 1) / BINS_PER_BIT
    at = found.bits_at(found.t_ns)
    for sign, colour, name in ((1, ON_COLOUR, 'ON'), (-1, OFF_COLOUR, 'OFF')):
        counts, _ = np.histogram(at[found.polarity == sign], edges)
        axes.bar(edges[:-1], sign * counts, 1 / BINS_PER_BIT, align='edge', color=colour, label=f'{name} events')
    axes.axhline(0.0, color='0.3', linewidth=0.8)
    axes.set_ylabel('events in a\nquarter bit')
    axes.yaxis.set_major_formatter(lambda value, _: f'{abs(value):g}')
    low, high = axes.get_ylim()
    axes.set_ylim(low, high + 0.3 * (high - low))
    axes.legend(loc='upper left', ncols=2, frameon=False, borderaxespad=0.2, fontsize=9)


def draw_paper(axes: Any, found: Stretch) -> None:
    """Draw the paper's binarised line, the bits it reads, and which of them are wrong."""
    at = found.bits_at(found.edges_ns)
    axes.step(at, found.rising.astype(float), where='post', color='0.2', linewidth=1.2)
    for character, sent in zip(found.paper, found.sent, strict=True):
        begin = float(found.bits_at(character.t_ns))
        per_bit = NS_PER_S / character.bit_rate_bps / found.bit_ns
        pairs = zip(bits_of(character.frame), bits_of(FRAME.frame_of(ord(sent))), strict=True)
        for place, (bit, true) in enumerate(pairs):
            x = begin + (place + 0.5) * per_bit
            if bit != true:
                axes.axvspan(x - 0.5 * per_bit, x + 0.5 * per_bit, color=WRONG_COLOUR, alpha=0.2, linewidth=0)
            colour, weight = ('0.25', 'normal') if bit == true else (WRONG_COLOUR, 'bold')
            axes.text(x, -0.35, bit, ha='center', va='center', color=colour, weight=weight, fontsize=9)
        right = character.code == ord(sent)
        text = f'{shown(character.code)} {status_text(character.status)}' + ('' if right else ', wrong')
        axes.text(
            begin + 0.5 * FRAME.length * per_bit, 1.45, text, ha='center', va='center', weight='bold',
            color=RIGHT_COLOUR if right else WRONG_COLOUR, fontsize=10,
        )  # fmt: skip
    axes.set(ylim=(-0.7, 1.8), yticks=(0, 1))
    axes.set_ylabel('threshold:\nline, bits')


def status_text(status: Status) -> str:
    """Return a status in words."""
    return status.name.lower().replace('_', ' ')


def draw_ratios(axes: Any, found: Stretch) -> None:
    """Draw each bit's log-likelihood ratio, and ring the weakest one and those that the frame decides otherwise."""
    x = np.concatenate([float(found.bits_at(one.t_ns)) + 0.5 + np.arange(FRAME.length) for one in found.sequence])
    ratios = np.concatenate([one.bit_llr for one in found.sequence])
    decided = np.concatenate([bits_of(one.frame) for one in found.sequence])
    axes.bar(x, ratios, 0.72, color=np.where(ratios > 0.0, ON_COLOUR, OFF_COLOUR))
    axes.axhline(0.0, color='0.3', linewidth=0.8)
    low, high = axes.get_ylim()
    axes.set_ylim(low, high + 0.4 * (high - low))
    ringed = set(np.flatnonzero((ratios > 0.0) != (decided == 1))) | {int(np.argmin(np.abs(ratios)))}
    for n in sorted(ringed):
        axes.plot(
            x[n], ratios[n], 'o', markersize=13, markerfacecolor='none', markeredgecolor=WRONG_COLOUR, markeredgewidth=1.6
        )
        said = 'the bits alone can hardly tell' if (ratios[n] > 0.0) == decided[n] else 'the frame decides otherwise'
        axes.annotate(
            f'{ratios[n]:+.1f} nat: {said}'.replace('-', '\N{MINUS SIGN}'), (x[n], ratios[n]), (0, 52),
            textcoords='offset points', ha='center', va='bottom', color=WRONG_COLOUR, fontsize=9,
            arrowprops={'arrowstyle': '-', 'color': WRONG_COLOUR, 'shrinkB': 8.0},
        )  # fmt: skip
    axes.set_ylabel('sequence:\nlog p(1)/p(0), nat')


def draw_frames(axes: Any, found: Stretch) -> None:
    """Draw the frame: what each bit is, how it was decided, and the character."""
    from matplotlib.patches import Rectangle

    for character, sent in zip(found.sequence, found.sent, strict=True):
        begin = float(found.bits_at(character.t_ns))
        for place, bit in enumerate(bits_of(character.frame)):
            part, label = part_of(place)
            axes.add_patch(Rectangle((begin + place, 0.0), 1.0, 1.0, facecolor=PART_COLOURS[part], edgecolor='0.5'))
            axes.text(begin + place + 0.5, 0.5, bit, ha='center', va='center', fontsize=9)
            axes.text(begin + place + 0.5, -0.35, label, ha='center', va='center', fontsize=8, color='0.4')
        right = character.code == ord(sent)
        sure = f'{character.confidence:.3f}' if character.confidence < 0.999 else '> 0.999'
        text = f'{shown(character.code)} {status_text(character.status)}, confidence {sure}'
        axes.text(
            begin + 0.5 * FRAME.length, 1.5, text, ha='center', va='center', weight='bold',
            color=RIGHT_COLOUR if right else WRONG_COLOUR, fontsize=10,
        )  # fmt: skip
    axes.set(ylim=(-0.7, 2.0), yticks=())
    axes.set_ylabel('sequence:\nframe, bits')


def draw(found: Stretch, path: Path) -> None:
    """Draw everything."""
    import matplotlib

    matplotlib.use('Agg')
    from matplotlib import pyplot as plt

    last_bit = float(found.bits_at(found.sequence[-1].t_ns)) + FRAME.length + 1.0
    figure, panels = plt.subplots(
        4, 1, figsize=(9.0, 6.4), height_ratios=(3.0, 1.6, 2.6, 1.2), sharex=True, layout='constrained'
    )
    draw_events(panels[0], found, last_bit)
    draw_paper(panels[1], found)
    draw_ratios(panels[2], found)
    draw_frames(panels[3], found)
    begins = [float(found.bits_at(character.t_ns)) for character in found.sequence]
    for axes in panels:
        for begin in begins:
            for bit in range(FRAME.length + 1):
                heavy = bit in (0, FRAME.length)
                axes.axvline(
                    begin + bit, color='0.35' if heavy else '0.85', linewidth=1.0 if heavy else 0.6, zorder=0
                )
        for side in ('top', 'right'):
            axes.spines[side].set_visible(False)
    for axes in panels[:-1]:
        axes.tick_params(axis='x', length=0)
    panels[-1].set_xlim(-MARGIN_BITS, last_bit)
    panels[-1].set_xlabel(
        f"bits of the receiver's clock, found blind: {found.sequence[0].bit_rate_bps:.0f} bps"
        '   (S start, d data, P even parity, E stop)'
    )
    figure.align_ylabels(panels)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=150)
    plt.close(figure)


def main() -> None:
    """Draw the figure."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('--folder', type=Path, default=recordings_folder(), help='folder of the recordings')
    parser.add_argument('--output', type=Path, default=FIGURE)
    arguments = parser.parse_args()
    draw(stretch(Path(arguments.folder) / RECORDING), arguments.output)


if __name__ == '__main__':
    main()
