"""The keys of a scene file: declared once, as fields of frozen dataclasses, with unit, default, range and meaning.

From the declarations come the reader's checks and the table of ``docs/scenes_format.md``.  An error names the key by its
path in the file: ``beacons[2].path.speed_px_per_s = -1: must lie in [0, 20000]``.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import MISSING, Field, field, fields
from typing import Any, TypeVar

from beacon_comm.core.errors import ParameterError, quoted

T = TypeVar('T')
Reader = Callable[[Any, str], Any]


def key(
    read: Reader,
    unit: str,
    meaning: str,
    default: Any = MISSING,
    *,
    low: float = -math.inf,
    high: float = math.inf,
    source: str = '',
) -> Any:
    """Return a dataclass field that is a key of the file.

    Args:
        read: turns what the file holds into the value; raises ParameterError with the path it is given.
        unit: of the value, '' for none.
        meaning: one line.
        default: the value without the key; without one, the key must be there.
        low, high: range of every number in the value.
        source: where the model behind it comes from.
    """
    metadata = {'read': read, 'unit': unit, 'meaning': meaning, 'low': low, 'high': high, 'source': source}
    if isinstance(default, (list, dict)):
        raise TypeError('a default must be immutable')
    return field(metadata=metadata) if default is MISSING else field(default=default, metadata=metadata)


def wrong(path: str, value: object, must: str) -> ParameterError:
    """Return the error for a value at a path."""
    return ParameterError(f'{path} = {quoted(value)}: must be {must}')


def number(value: Any, path: str) -> float:
    """Read a finite number; YAML reads ``1e6`` as text, which is one, too."""
    if isinstance(value, str):
        try:
            value = float(value)
        except ValueError:
            raise wrong(path, value, 'a number') from None
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not math.isfinite(value):
        raise wrong(path, value, 'a number')
    return float(value)


def whole(value: Any, path: str) -> int:
    """Read a whole number."""
    read = number(value, path)
    if read != int(read):
        raise wrong(path, value, 'a whole number')
    return int(read)


def words(value: Any, path: str) -> str:
    """Read a text; a bare number or yes / no is not silently turned into one."""
    if not isinstance(value, str) or not value:
        raise wrong(path, value, 'a text (in quotes)')
    return value


def numbers(count: int | None, at_least: int = 1) -> Reader:
    """Return a reader of a list of ``count`` numbers; None: of any length."""

    def read(value: Any, path: str) -> tuple[float, ...]:
        if not isinstance(value, (list, tuple)) or (len(value) != count if count is not None else len(value) < at_least):
            raise wrong(path, value, f'a list of {count if count is not None else "one or more"} numbers')
        return tuple(number(one, f'{path}[{index}]') for index, one in enumerate(value))

    return read


def number_or_list(count: int | None) -> Reader:
    """Return a reader of one number, or of a list of ``count`` of them: always a tuple."""

    def read(value: Any, path: str) -> tuple[float, ...]:
        return numbers(count)(value, path) if isinstance(value, (list, tuple)) else (number(value, path),)

    return read


def rows(width: int, what: str, *, spans: bool = False) -> Reader:
    """Return a reader of a list of lists of ``width`` numbers.

    Args:
        width: of each row.
        what: what a row is called in an error.
        spans: each row is a begin and a later end.
    """

    def read(value: Any, path: str) -> tuple[tuple[float, ...], ...]:
        if not isinstance(value, (list, tuple)):
            raise wrong(path, value, f'a list of {what}')
        found = []
        for index, row in enumerate(value):
            one = numbers(width)(row, f'{path}[{index}]')
            if spans and one[1] <= one[0]:
                raise wrong(f'{path}[{index}]', row, 'a begin and a later end')
            found.append(one)
        return tuple(found)

    return read


def choice(*names: str) -> Reader:
    """Return a reader of one of several words."""

    def read(value: Any, path: str) -> str:
        if value not in names:
            raise wrong(path, value, 'one of ' + ', '.join(names))
        return str(value)

    return read


def part(kind: type[T]) -> Reader:
    """Return a reader of a mapping with the keys of a dataclass."""

    def read(value: Any, path: str) -> T:
        return read_part(kind, value, path)

    read.kinds = {'': kind}  # type: ignore[attr-defined]
    return read


def part_of_kind(kinds: Mapping[str, type]) -> Reader:
    """Return a reader of a mapping whose key ``kind`` says which dataclass's keys it has."""

    def read(value: Any, path: str) -> Any:
        if not isinstance(value, Mapping):
            raise wrong(path, value, f'a mapping with kind: {" | ".join(kinds)}')
        name = choice(*kinds)(value.get('kind'), f'{path}.kind')
        return read_part(kinds[name], {k: v for k, v in value.items() if k != 'kind'}, path)

    read.kinds = dict(kinds)  # type: ignore[attr-defined]
    return read


def list_of(one: Reader) -> Reader:
    """Return a reader of a list, each of its entries read by ``one``."""

    def read(value: Any, path: str) -> tuple[Any, ...]:
        if not isinstance(value, (list, tuple)):
            raise wrong(path, value, 'a list')
        return tuple(one(entry, f'{path}[{index}]') for index, entry in enumerate(value))

    read.kinds = getattr(one, 'kinds', {})  # type: ignore[attr-defined]
    return read


def read_part(kind: type[T], value: Any, path: str = '') -> T:
    """Return a dataclass from a mapping of the file.

    Raises:
        ParameterError: no mapping, a key that is unknown or missing, or a value of a wrong type or out of range.
    """
    if not isinstance(value, Mapping):
        raise wrong(path or 'the file', value, 'a mapping of keys')
    declared: dict[str, Field[Any]] = {one.name: one for one in fields(kind) if 'read' in one.metadata}  # type: ignore[arg-type]
    prefix = f'{path}.' if path else ''
    for name in value:
        if name not in declared:
            raise ParameterError(f'{prefix}{name}: no such key; there are {", ".join(declared)}')
    content = {}
    for name, one in declared.items():
        if name in value:
            content[name] = read_value(one, value[name], f'{prefix}{name}')
        elif one.default is MISSING:
            raise ParameterError(f'{prefix}{name}: missing')
    try:
        return kind(**content)
    except ParameterError as error:
        raise ParameterError(f'{prefix}{error}') from error


def read_value(one: Field[Any], value: Any, path: str) -> Any:
    """Return a key's value, read and held against its range.

    Raises:
        ParameterError: of a wrong type or out of range.
    """
    read = one.metadata['read'](value, path)
    low, high = one.metadata['low'], one.metadata['high']
    for single in flat(read):
        if isinstance(single, (int, float)) and not low <= single <= high:
            raise ParameterError(f'{path} = {quoted(value)}: must lie in [{low:g}, {high:g}]')
    return read


def flat(value: Any) -> list[Any]:
    """Return the single values of nested tuples."""
    return [single for entry in value for single in flat(entry)] if isinstance(value, tuple) else [value]
