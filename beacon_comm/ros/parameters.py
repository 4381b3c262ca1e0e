"""The node's parameters: its own, declared like the core's, and the way of all of them from and to ROS.

``python -m beacon_comm.ros.parameters`` prints ``config/beacon.yaml``, with ``--markdown`` the README's table.
"""

from __future__ import annotations

import argparse
import difflib
import math
import textwrap
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from beacon_comm.core.parameters import Declaration, Declared, Parameters, declarations, parameter

if TYPE_CHECKING:
    from rcl_interfaces.msg import ParameterDescriptor
    from rclpy.node import Node


@dataclass(frozen=True)
class NodeParameters(Declared):
    """Parameters of the node itself."""

    publish_rate_hz: float = parameter(50.0, 'rate of ~/beacons and ~/bearings, bound of ~/text', 'Hz', 0.1, 1000.0)
    qos_reliability: str = parameter(
        'best_effort', 'reliability asked of the event topic', choices=('best_effort', 'reliable')
    )
    qos_depth: int = parameter(1000, 'event messages that may wait for the node', 'messages', 1, 100_000)
    max_lag_s: float = parameter(
        0.05, 'messages that would be read later than this are shed: unread, counted, characters erased', 's', 0.001, 3600.0
    )
    silent_clock_after_s: float = parameter(
        0.05, 'a topic without messages for this long is silent: its time goes on by the clock …', 's', 0.01, 10.0
    )
    silent_clock_lag_s: float = parameter(
        0.5, '… and stays so far behind it while there is a publisher, whose next message may be late', 's', 0.0, 10.0
    )
    camera_info_file: str = parameter(
        '', "calibration YAML of the event camera: a path, a file:// or a package:// URL; '': pixels only"
    )
    use_camera_info: bool = parameter(False, 'take the calibration from the topic camera_info')
    text_codes: int = parameter(1024, "characters of a beacon's text that ~/text repeats", 'characters', 1, 1024)


def all_declarations() -> tuple[Declaration, ...]:
    """Return the declarations of everything that can be set on the node."""
    return (*declarations(Parameters), *declarations(NodeParameters))


def read_parameters(node: Node) -> tuple[Parameters, NodeParameters]:
    """Declare all parameters on a node and return their values; numbers may be given as whole ones.

    Raises:
        ParameterError: a value is refused; the text names it and its range.
    """
    values: dict[str, Any] = {}
    for declaration in all_declarations():
        values[declaration.name] = _declare(node, declaration)
    core_names = {declaration.name for declaration in declarations(Parameters)}
    core = Parameters(**{name: value for name, value in values.items() if name in core_names})
    own = NodeParameters(**{name: value for name, value in values.items() if name not in core_names})
    return core, own


def unknown_parameters(given: list[str]) -> list[str]:
    """Return one line for each given name that is no parameter of the node, with the nearest that is."""
    known = [declaration.name for declaration in all_declarations()]
    lines = []
    for name in given:
        # rclpy's own: the clock, QoS overrides, the type description service
        if name in known or name == 'use_sim_time' or name.startswith(('qos_overrides.', 'start_type_description')):
            continue
        near = difflib.get_close_matches(name, known, 1)
        lines.append(f'{name}: no such parameter' + (f'; did you mean {near[0]}?' if near else ''))
    return lines


def _declare(node: Node, declaration: Declaration) -> Any:
    """Declare one parameter and return its checked value.

    It is declared twice: first of any type, since rclpy would refuse a whole number for a real one and names neither
    the value nor the range; then for good, with the checked value.
    """
    from rcl_interfaces.msg import ParameterDescriptor

    name, default = declaration.name, declaration.default
    start: Any = list(default) if isinstance(default, tuple) else default
    given = node.declare_parameter(name, start, ParameterDescriptor(dynamic_typing=True)).value
    if not isinstance(given, (bool, int, float, str)) and given is not None:
        given = list(given)  # rclpy gives arrays of several types
    value = declaration.check(given)
    node.undeclare_parameter(name)
    stored: Any = list(value) if isinstance(value, tuple) else value
    node.declare_parameter(name, stored, _descriptor(declaration), ignore_override=True)
    return value


def _descriptor(declaration: Declaration) -> ParameterDescriptor:
    from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor

    text = declaration.meaning + (f' ({declaration.unit})' if declaration.unit else '')
    descriptor = ParameterDescriptor(name=declaration.name, description=text, read_only=True)
    descriptor.additional_constraints = declaration.range_text()
    low, high = declaration.low, declaration.high
    bounded = low is not None or high is not None
    if bounded and type(declaration.default) is int:
        descriptor.integer_range = [
            IntegerRange(
                from_value=-(2**63) if low is None else int(low), to_value=2**63 - 1 if high is None else int(high)
            )
        ]
    elif bounded and isinstance(declaration.default, float):
        descriptor.floating_point_range = [
            FloatingPointRange(
                from_value=-math.inf if low is None else low, to_value=math.inf if high is None else high
            )
        ]
    return descriptor


def _yaml_value(value: object) -> str:
    if isinstance(value, bool):
        return 'true' if value else 'false'
    if isinstance(value, tuple):
        return f'[{", ".join(_yaml_value(entry) for entry in value)}]'
    if isinstance(value, str):
        return f"'{value}'"
    return repr(value)


def yaml_text() -> str:
    """Return the text of ``config/beacon.yaml``."""
    lines = [
        '# Parameters of beacon_node with their defaults; above each one its meaning and range.',
        '# Written by `python -m beacon_comm.ros.parameters`; a test holds it to the declarations.',
        '/**:',
        '  ros__parameters:',
    ]
    for cls, title in ((Parameters, 'The receiver'), (NodeParameters, 'The node')):
        lines += ['', f'    # --- {title} ---']
        for declaration in declarations(cls):
            span = declaration.range_text() or declaration.unit
            comment = declaration.meaning + (f'; {span}' if span else '')
            lines += textwrap.wrap(
                comment, 116, initial_indent='    # ', subsequent_indent='    # ', break_on_hyphens=False
            )
            lines.append(f'    {declaration.name}: {_yaml_value(declaration.default)}')
    return '\n'.join(lines) + '\n'


def markdown_text() -> str:
    """Return the text of ``docs/parameters.md``."""
    lines = [
        '# Parameters of beacon_node',
        '',
        'Written by `python -m beacon_comm.ros.parameters --markdown`; a test holds it to the declarations.',
        '',
        '| Parameter | Default | Range | Meaning |',
        '|---|---|---|---|',
    ]
    for declaration in all_declarations():
        default = declaration.default
        shown = f'{default:.6g}' if isinstance(default, float) else _yaml_value(default)
        span = declaration.range_text() or declaration.unit
        cells = (f'`{declaration.name}`', f'`{shown}`', span, declaration.meaning)
        lines.append('| ' + ' | '.join(cell.replace('|', '\\|') for cell in cells) + ' |')
    return '\n'.join(lines) + '\n'


def main() -> None:
    """Print the YAML file or the page of parameters."""
    parser = argparse.ArgumentParser(description='Print config/beacon.yaml, or the table of parameters.')
    parser.add_argument('--markdown', action='store_true', help='print docs/parameters.md instead')
    print(markdown_text() if parser.parse_args().markdown else yaml_text(), end='')


if __name__ == '__main__':
    main()
