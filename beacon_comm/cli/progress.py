"""Progress bar on the terminal, for work that takes longer than two seconds; none where nobody looks."""

from __future__ import annotations

import sys
from collections.abc import Iterable
from typing import TypeVar

from tqdm import tqdm

T = TypeVar('T')
SHOWN_AFTER_S = 2.0


def progress(work: Iterable[T], title: str, count: int | None) -> Iterable[T]:
    """Pass ``work`` through, with a bar on stderr if that is a terminal."""
    return tqdm(work, title, count, delay=SHOWN_AFTER_S, leave=False, file=sys.stderr, disable=not sys.stderr.isatty())
