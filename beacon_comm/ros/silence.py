"""Why nothing comes out: the first link of the chain that does not hold.

::

    time? ─ publisher? ─ type? ─ package? ─ QoS? ─ messages? ─ readable? ─ events? ─ above the index threshold? ─ confirmed?
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum

from beacon_comm.core.candidates import BeaconState
from beacon_comm.core.receiver import BeaconSnapshot


class Cause(IntEnum):
    """Which link it is, in order of the chain."""

    OVERLOADED = 0
    NO_PUBLISHER = 1
    WRONG_TYPE = 2
    NOT_INSTALLED = 3
    INCOMPATIBLE_QOS = 4
    NO_MESSAGES = 5
    UNREADABLE = 6
    NO_EVENTS = 7
    BELOW_THRESHOLD = 8
    UNCONFIRMED = 9

    @property
    def is_fault(self) -> bool:
        """Whether something is wrong; the others are what an empty scene looks like."""
        return self < Cause.NO_EVENTS


@dataclass(frozen=True, slots=True)
class Silence:
    """A cause and its text for people."""

    cause: Cause
    text: str


@dataclass(frozen=True, slots=True)
class Situation:
    """What is known about the chain, the counts since the last look.

    Attributes:
        topic: resolved name.
        advertised: types that publishers of it advertise now.
        supported: whether one of them can be read.
        not_installed: the type whose Python package is missing, '' if none is.
        incompatible: what the publisher's QoS lacks, '' if nothing.
        similar: other topics that carry events, with their types.
        messages, events, bad_messages, shed: counted since the last look.
        problems: kinds of bad messages and how often.
        tracks: all tracks now.
        index_threshold: what the index of a blob must reach now.
    """

    topic: str
    advertised: tuple[str, ...] = ()
    supported: bool = False
    not_installed: str = ''
    incompatible: str = ''
    similar: tuple[str, ...] = ()
    messages: int = 0
    events: int = 0
    bad_messages: int = 0
    shed: int = 0
    problems: str = ''
    tracks: Sequence[BeaconSnapshot] = ()
    index_threshold: float = 0.0


def why_silent(now: Situation) -> Silence | None:
    """Return the first link that does not hold, None while a beacon is confirmed and there is time to read everything."""
    if now.shed:
        return Silence(
            Cause.OVERLOADED,
            f'overloaded: {now.shed} of {now.messages} messages on {now.topic} shed in the last second',
        )
    if any(track.state == BeaconState.CONFIRMED for track in now.tracks):
        return None
    return _why_no_events(now) or _why_no_beacon(now)


def _why_no_events(now: Situation) -> Silence | None:
    if not now.advertised:
        hint = f'; events are on {", ".join(now.similar)}: remap events:=…' if now.similar else ''
        return Silence(Cause.NO_PUBLISHER, f'no publisher on {now.topic}{hint}')
    if not now.supported:
        types = ', '.join(sorted(set(now.advertised)))
        wanted = 'event_camera_msgs/msg/EventPacket or an EventArray'
        return Silence(Cause.WRONG_TYPE, f'{now.topic} carries {types}, not {wanted}')
    if now.not_installed:
        package = now.not_installed.split('/')[0]
        return Silence(
            Cause.NOT_INSTALLED,
            f'{now.topic} carries {now.not_installed}, and the package {package} is not installed here',
        )
    if now.messages:
        if now.bad_messages == now.messages:
            return Silence(Cause.UNREADABLE, f'no message on {now.topic} can be read: {now.problems}')
        return None if now.events else Silence(Cause.NO_EVENTS, f'the messages on {now.topic} hold no events')
    if now.incompatible:
        return Silence(Cause.INCOMPATIBLE_QOS, f'QoS of {now.topic} does not match: {now.incompatible}')
    return Silence(Cause.NO_MESSAGES, f'{now.topic} has a publisher, but no messages come')


def _why_no_beacon(now: Situation) -> Silence:
    if not now.tracks:
        return Silence(
            Cause.BELOW_THRESHOLD, f'events, but nothing blinks above index_threshold = {now.index_threshold:g}'
        )
    best = max(now.tracks, key=lambda track: (track.characters_ok, track.characters, track.index))
    record = (
        f'track {best.track_id} has {best.characters_ok} of {best.characters} characters ok,'
        f' {best.parity_errors} parity and {best.framing_errors} framing errors'
        if best.characters
        else 'none has given a character'
    )
    return Silence(Cause.UNCONFIRMED, f'{len(now.tracks)} candidates, none confirmed; {record}')
