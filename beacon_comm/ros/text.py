"""What each beacon has said: the last codes of its text, and the text made printable."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, field

from beacon_comm.ros.stamped import Instant, StampedCharacter

_ESCAPES = {ord('\n'): '\\n', ord('\r'): '\\r', ord('\t'): '\\t', ord('\\'): '\\\\'}
_PRINTABLE = [_ESCAPES.get(code, chr(code) if 0x20 <= code < 0x7F else f'\\x{code:02x}') for code in range(256)]


def printable(codes: bytes) -> str:
    r"""Return codes as printable ASCII: ``\n``, ``\r``, ``\t``, ``\\``, and ``\xNN`` for what cannot be printed."""
    return ''.join([_PRINTABLE[code] for code in codes])


@dataclass(frozen=True, slots=True)
class BeaconText:
    """The last characters of one beacon's text.

    Attributes:
        track_id: label of the track.
        at: instant of the last character's start edge.
        first_index: index of ``codes[0]`` in the whole text.
        codes: the last codes, one byte each.
        statuses: the status of each, one byte each.
    """

    track_id: int
    at: Instant
    first_index: int
    codes: bytes
    statuses: bytes


@dataclass(slots=True)
class _Growing:
    """What one beacon has said so far: the last codes and statuses, and how many there were in all."""

    at: Instant
    codes: bytearray = field(default_factory=bytearray)
    statuses: bytearray = field(default_factory=bytearray)
    count: int = 0


class Texts:
    """Keeps the last ``kept`` characters of every beacon."""

    def __init__(self, kept: int) -> None:
        self._kept = kept
        self._growing: dict[int, _Growing] = {}
        self._changed: dict[int, None] = {}

    def add(self, stamped: StampedCharacter) -> None:
        """Append a character to its beacon's text."""
        text = self._growing.get(stamped.track_id)
        if text is None:
            text = self._growing[stamped.track_id] = _Growing(stamped.at)
        text.at = stamped.at
        text.codes.append(stamped.character.code)
        text.statuses.append(stamped.character.status)
        del text.codes[: -self._kept], text.statuses[: -self._kept]
        text.count += 1
        self._changed[stamped.track_id] = None

    def take_changed(self) -> list[BeaconText]:
        """Return the texts that have grown since the last call."""
        texts = [self._text(track_id) for track_id in self._changed]
        self._changed.clear()
        return texts

    def keep(self, track_ids: Collection[int]) -> None:
        """Drop the texts of all other beacons: they are lost."""
        for texts in (self._growing, self._changed):
            for track_id in [track_id for track_id in texts if track_id not in track_ids]:
                del texts[track_id]

    def _text(self, track_id: int) -> BeaconText:
        text = self._growing[track_id]
        return BeaconText(track_id, text.at, text.count - len(text.codes), bytes(text.codes), bytes(text.statuses))
