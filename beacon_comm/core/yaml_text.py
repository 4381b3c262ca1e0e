"""YAML texts that others wrote: what they hold, or one kind of error."""

from __future__ import annotations

from typing import Any

import yaml

_MOST_BITS = 64


class _Loader(yaml.SafeLoader):
    pass


def _whole_number(loader: yaml.SafeLoader, node: yaml.ScalarNode) -> int:
    number = loader.construct_yaml_int(node)
    if number.bit_length() > _MOST_BITS:
        raise ValueError(f'a whole number of more than {_MOST_BITS} bits')
    return number


_Loader.add_constructor('tag:yaml.org,2002:int', _whole_number)


def load_yaml(text: str) -> Any:
    """Return what a YAML text holds; its whole numbers have at most 64 bits.

    Raises:
        ValueError: no YAML, nested too deeply, or a value that is not what its tag says; one line.
    """
    try:
        return yaml.load(text, _Loader)
    except RecursionError:
        raise ValueError('nested too deeply') from None
    except Exception as error:  # its constructors raise whatever they stumble over
        raise ValueError(' '.join(str(error).split()) or type(error).__name__) from error
