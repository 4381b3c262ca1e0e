"""``beacon_encode``: what a beacon sends for a text: bits, transition times, a picture of the waveform."""

from __future__ import annotations

import argparse
import json
import re
import shutil
import sys
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from beacon_comm.cli.interrupts import ignore_interrupts, interrupts_held
from beacon_comm.cli.parser import EXIT_ERROR, EXIT_OK, OneLineParser
from beacon_comm.cli.waveform import frame_parts, save_waveform, terminal_waveform, visible
from beacon_comm.core.errors import BeaconCommError, FramingError, ParameterError
from beacon_comm.core.events import NS_PER_S
from beacon_comm.core.framing import CharacterFrame, transitions
from beacon_comm.core.parameters import Declaration, Parameters, declarations

NAME = 'beacon_encode'
TERMINAL = '-'
DEFAULT_RATE_BPS = 504.0
FRAME_OPTIONS = ('data_bits', 'parity', 'stop_bits', 'bit_order')
LEVEL_NAMES = ('off', 'on')


def make_parser() -> argparse.ArgumentParser:
    """Return the command line's parser; the frame's options are the parameters of the same names."""
    parser = OneLineParser(prog=NAME, description='Print what a beacon sends for a text, and draw it.')
    parser.add_argument('text', metavar='TEXT', help='what to send; -: read it from standard input')
    parser.add_argument(
        '--bit-rate', type=float, default=DEFAULT_RATE_BPS, metavar='BPS', help='bit rate (default: %(default)g)'
    )
    parser.add_argument('--output-format', choices=('text', 'csv', 'json'), default='text', help='default: text')
    parser.add_argument(
        '--plot', nargs='?', const=TERMINAL, metavar='FILE', help='draw the waveform: as an image, or without FILE here'
    )
    for declaration in _frame_declarations():
        parser.add_argument(
            f'--{declaration.name.replace("_", "-")}',
            type=type(declaration.default),
            default=declaration.default,
            metavar='N' if isinstance(declaration.default, int) else 'NAME',
            help=f'{declaration.meaning}: {declaration.range_text()} (default: {declaration.default})',
        )
    return parser


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command; return its exit code."""
    arguments = make_parser().parse_args(argv)
    try:
        parameters = _parameters(arguments)
        frame = CharacterFrame.from_parameters(parameters)
        (bit_rate_bps,) = parameters.bit_rates
        text = sys.stdin.read() if arguments.text == '-' else arguments.text
        if not text:
            raise FramingError('no text to encode')
        bits = frame.encode_bits(text)
        if arguments.plot not in (None, TERMINAL):
            with interrupts_held():  # a second or two, and no half image
                save_waveform(arguments.plot, text, bits, frame, bit_rate_bps)
        print(OUTPUTS[arguments.output_format](text, bits, frame, bit_rate_bps))
        if arguments.plot == TERMINAL:
            print('\n' + terminal_waveform(text, bits, frame, shutil.get_terminal_size((100, 24)).columns))
    except BeaconCommError as error:
        print(f'{NAME}: {error}', file=sys.stderr)
        return EXIT_ERROR
    except KeyboardInterrupt:
        if argv is None:
            ignore_interrupts()  # a second Ctrl-C must not cut the process's end short
        print(f'{NAME}: interrupted', file=sys.stderr)
        return EXIT_ERROR
    except BrokenPipeError:
        sys.stderr.close()  # the reader has gone: nothing to say, and nobody to say it to
        return EXIT_ERROR
    return EXIT_OK


def _parameters(arguments: argparse.Namespace) -> Parameters:
    try:
        return Parameters(
            bit_rates=(arguments.bit_rate,), **{name: getattr(arguments, name) for name in FRAME_OPTIONS}
        )
    except ParameterError as error:
        raise ParameterError(re.sub('^bit_rates =', '--bit-rate', str(error))) from error


def text_output(text: str, bits: NDArray[np.uint8], frame: CharacterFrame, bit_rate_bps: float) -> str:
    """Return one line a character with its parts set apart, then one line a transition."""
    count = f'{len(text)} character{"s" * (len(text) > 1)}'
    lines = [f'{count}, {len(bits)} bits, {bit_rate_bps:g} bit/s, {len(bits) / bit_rate_bps:.6g} s', '']
    names = ' '.join(f'{name:{stop - start}}' for name, start, stop in frame_parts(frame))
    lines.append(f'{"start_s":>12}  code  {names}')
    for k, symbol in enumerate(text):
        row = ''.join(str(bit) for bit in bits[k * frame.length : (k + 1) * frame.length])
        parts = ' '.join(
            row[start:stop].ljust(max(len(name), stop - start)) for name, start, stop in frame_parts(frame)
        )
        lines.append(f'{k * frame.length / bit_rate_bps:12.9f}  {ord(symbol):4d}  {parts}  {visible(symbol)}')
    t_ns, levels = transitions(bits, bit_rate_bps)
    lines += ['', f'{"time_s":>12}  LED']
    lines += [f'{_seconds(t)}  {LEVEL_NAMES[level]}' for t, level in zip(t_ns, levels, strict=True)]
    return '\n'.join(lines)


def csv_output(text: str, bits: NDArray[np.uint8], frame: CharacterFrame, bit_rate_bps: float) -> str:
    """Return the transitions, ``time_s,level`` (1: LED on)."""
    t_ns, levels = transitions(bits, bit_rate_bps)
    rows = (f'{_seconds(t).strip()},{level}' for t, level in zip(t_ns, levels, strict=True))
    return '\n'.join(('time_s,level', *rows))


def json_output(text: str, bits: NDArray[np.uint8], frame: CharacterFrame, bit_rate_bps: float) -> str:
    """Return everything as one JSON object."""
    t_ns, levels = transitions(bits, bit_rate_bps)
    line = ''.join(str(bit) for bit in bits)
    content = {
        'text': text,
        'bit_rate_bps': bit_rate_bps,
        **{name: getattr(frame, name) for name in FRAME_OPTIONS},
        'bits': line,
        'characters': [
            {
                'start_s': round(k * frame.length / bit_rate_bps, 9),
                'code': ord(symbol),
                'frame': line[k * frame.length : (k + 1) * frame.length],
            }
            for k, symbol in enumerate(text)
        ],
        'transitions': [[int(t) / NS_PER_S, int(level)] for t, level in zip(t_ns, levels, strict=True)],
    }
    return json.dumps(content)


OUTPUTS = {'text': text_output, 'csv': csv_output, 'json': json_output}


def _seconds(t_ns: np.int64) -> str:
    return f'{int(t_ns) / NS_PER_S:12.9f}'


def _frame_declarations() -> list[Declaration]:
    return [declaration for declaration in declarations(Parameters) if declaration.name in FRAME_OPTIONS]


if __name__ == '__main__':
    sys.exit(main())
