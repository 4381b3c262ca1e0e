"""The scripts of ``docs/`` as modules, for the tests of what they measure with."""

import importlib.util
import sys
from pathlib import Path
from types import ModuleType

DOCS = Path(__file__).resolve().parents[1] / 'docs'


def load(name: str) -> ModuleType:
    """Return ``docs/<name>.py`` as a module."""
    spec = importlib.util.spec_from_file_location(name, DOCS / f'{name}.py')
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module
