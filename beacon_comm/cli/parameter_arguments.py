"""The receiver's parameters from a command line: a YAML file, ``--set name=value``, and flags; the last word counts."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from beacon_comm.core.errors import ParameterError
from beacon_comm.core.parameters import Parameters, declarations, from_mapping
from beacon_comm.core.yaml_text import load_yaml


def add_parameter_arguments(parser: argparse.ArgumentParser) -> None:
    """Add ``--receiver --bit-rate --params --set``."""
    parser.add_argument('--receiver', help="demodulator of the candidate slots (default: the parameters')")
    parser.add_argument('--bit-rate', metavar='BPS[,BPS…]', help='bit rates to try, e.g. 504,3125')
    parser.add_argument(
        '--params', metavar='YAML', help="parameters of the receiver, such as the node's config/beacon.yaml"
    )
    parser.add_argument(
        '--set', metavar='NAME=VALUE', action='append', default=[], help='set one parameter; may be repeated'
    )


def parameters_from(arguments: argparse.Namespace) -> tuple[Parameters, list[str]]:
    """Return the parameters that were asked for, and the names in a node's file that are not the receiver's.

    Raises:
        ParameterError: an unreadable file, an unknown name or a refused value.
    """
    values: dict[str, Any] = {}
    passed_over: list[str] = []
    if arguments.params is not None:
        values, passed_over = _from_file(Path(arguments.params))
    for setting in arguments.set:
        name, equals, text = setting.partition('=')
        if not equals:
            raise ParameterError(f'--set {setting}: must be NAME=VALUE')
        try:
            values[name.strip()] = load_yaml(text)
        except ValueError as error:
            raise ParameterError(f'--set {setting}: {text!r} is no value') from error
    if arguments.receiver is not None:
        values['receiver'] = arguments.receiver
    if arguments.bit_rate is not None:
        values['bit_rates'] = _rates(arguments.bit_rate)
    if 'bit_rates' in values and isinstance(values['bit_rates'], (int, float)):
        values['bit_rates'] = [values['bit_rates']]
    return from_mapping(Parameters, values), passed_over


def _rates(text: str) -> list[float]:
    try:
        return [float(rate) for rate in text.split(',')]
    except ValueError as error:
        raise ParameterError(f'--bit-rate {text}: must be numbers with commas between them') from error


def _from_file(path: Path) -> tuple[dict[str, Any], list[str]]:
    """Read a flat YAML mapping, or a ROS parameter file: there, names that are not the receiver's are the node's."""
    try:
        content = load_yaml(path.read_text(encoding='utf-8'))
    except (OSError, UnicodeDecodeError) as error:
        raise ParameterError(f'{path}: cannot be read ({getattr(error, "strerror", None) or error})') from error
    except ValueError as error:
        raise ParameterError(f'{path}: no YAML ({error})') from error
    content = {} if content is None else content
    if not isinstance(content, dict):
        raise ParameterError(f'{path}: not a mapping of parameters')
    nodes = [entry['ros__parameters'] for entry in content.values() if _is_node_entry(entry)]
    if not nodes:
        return content, []
    known = {declaration.name for declaration in declarations(Parameters)}
    merged = {name: value for node in nodes for name, value in (node or {}).items()}
    return (
        {name: value for name, value in merged.items() if name in known},
        [name for name in merged if name not in known],
    )


def _is_node_entry(entry: object) -> bool:
    return isinstance(entry, dict) and 'ros__parameters' in entry
