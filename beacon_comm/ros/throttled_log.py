"""A log that says the same kind of thing at most once a period, and how often it kept quiet."""

from __future__ import annotations

from collections.abc import Callable


class ThrottledLog:
    """A line of each kind at most once a period.

    Args:
        write: takes the line.
        period_ns: shortest time between two lines of one kind (ns).
        counting: say how many were left out.
    """

    def __init__(self, write: Callable[[str], object], period_ns: int, counting: bool = True) -> None:
        self._write = write
        self._period_ns = period_ns
        self._counting = counting
        self._written_ns: dict[str, int] = {}
        self._suppressed: dict[str, int] = {}

    def __call__(self, kind: str, text: str, now_ns: int) -> None:
        """Write ``text``, unless one of its kind was written less than a period before ``now_ns`` (ns)."""
        written_ns = self._written_ns.get(kind)
        if written_ns is not None and now_ns - written_ns < self._period_ns:
            self._suppressed[kind] = self._suppressed.get(kind, 0) + 1
            return
        self._written_ns[kind] = now_ns
        more = self._suppressed.pop(kind, 0)
        self._write(text + (f' (and {more} more since the last such line)' if more and self._counting else ''))
