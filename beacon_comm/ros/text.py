"""What each beacon has said: the last codes of its text, and the text made printable."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

from beacon_comm.ros.stamped import Instant, StampedCharacter

_ESCAPES = {ord('\n'): '\\n', ord('\r'): '\\r', ord('\t'): '\\t', ord('\\'): '\\\\'}


def printable(codes: bytes) -> str:
    r"""Return codes as printable ASCII: ``\n``, ``\r``, ``\t``, ``\\``, and ``\xNN`` for what cannot be printed."""
    return ''.join(
        _ESCAPES[code] if code in _ESCAPES else chr(code) if 0x20 <= code < 0x7F else f'\\x{code:02x}'
        for code in codes
    )


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


class Texts:
    """Keeps the last ``kept`` characters of every beacon."""

    def __init__(self, kept: int) -> None:
        self._kept = kept
        self._characters: dict[int, deque[StampedCharacter]] = {}
        self._counts: dict[int, int] = {}
        self._changed: dict[int, None] = {}

    def add(self, stamped: StampedCharacter) -> None:
        """Append a character to its beacon's text."""
        track_id = stamped.track_id
        if track_id not in self._characters:
            self._characters[track_id] = deque(maxlen=self._kept)
        self._characters[track_id].append(stamped)
        self._counts[track_id] = self._counts.get(track_id, 0) + 1
        self._changed[track_id] = None

    def take_changed(self) -> list[BeaconText]:
        """Return the texts that have grown since the last call."""
        texts = [self._text(track_id) for track_id in self._changed]
        self._changed.clear()
        return texts

    def forget(self, track_id: int) -> None:
        """Drop the text of a beacon that is lost."""
        self._characters.pop(track_id, None)
        self._counts.pop(track_id, None)
        self._changed.pop(track_id, None)

    def _text(self, track_id: int) -> BeaconText:
        characters = [stamped.character for stamped in self._characters[track_id]]
        return BeaconText(
            track_id,
            self._characters[track_id][-1].at,
            self._counts[track_id] - len(characters),
            bytes(character.code for character in characters),
            bytes(character.status for character in characters),
        )
