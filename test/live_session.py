"""A beacon's packets, and a live receiver that takes them by a clock of the test's own, without DDS."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from beacon_comm.core.bearing import CameraModel
from beacon_comm.core.character import Status
from beacon_comm.core.events import NS_PER_S, EventBatch
from beacon_comm.core.framing import CharacterFrame, transitions
from beacon_comm.core.parameters import Parameters
from beacon_comm.ros.live import LiveReceiver, Step
from beacon_comm.ros.stamped import StampedCharacter
from beacon_comm.wire.cdr import build_event_packet
from beacon_comm.wire.evt3_encoder import Evt3Encoder

TYPE = 'event_camera_msgs/msg/EventPacket'
STAMP_NS = 1_700_000_000 * NS_PER_S
START_NS = 3 * NS_PER_S
MS = 1_000_000
PACKET_NS = 5 * MS
LAG_NS = 100 * MS
BIT_RATE = 3125.0
TEXT = 2 * "Shall I compare thee to a summer's day?\n"


def beacon_events(text: str = TEXT, start_ns: int = START_NS, bit_rate: float = BIT_RATE) -> EventBatch:
    """Return the events of a beacon that covers a square of pixels."""
    columns, rows = (grid.ravel() for grid in np.meshgrid(np.arange(20, 27), np.arange(10, 17)))
    return pixel_events(text, start_ns, bit_rate, columns, rows)


def pixel_events(
    text: str, start_ns: int, bit_rate: float, columns: NDArray[np.int64], rows: NDArray[np.int64]
) -> EventBatch:
    """Return a beacon's events: at every edge each of its pixels fires once; time ends with the last of them."""
    edges_ns, levels = transitions(CharacterFrame().encode_bits(text), bit_rate, start_ns)
    pixels = len(columns)
    t_ns = (edges_ns[:, None] + np.linspace(20_000, 120_000, pixels)).astype(np.int64) // 1000 * 1000
    return EventBatch(
        np.tile(columns, len(edges_ns)).astype(np.uint16),
        np.tile(rows, len(edges_ns)).astype(np.uint16),
        np.repeat(np.where(levels > 0, 1, -1), pixels).astype(np.int8),
        t_ns.ravel(),
        int(t_ns[-1, -1]),
    )


def packets(
    events: EventBatch,
    size: tuple[int, int] = (64, 48),
    offset_ns: int = STAMP_NS - START_NS,
    frame_id: str = 'cam',
    first_seq: int = 0,
) -> list[bytes]:
    """Cut events into packets that hold all time; a stamp is its packet's first event's plus ``offset_ns``, or 0 below."""
    encoder = Evt3Encoder(*size)
    borders_ns = np.arange(events.t_ns[0], events.t_end_ns + PACKET_NS, PACKET_NS)
    borders_ns[-1] = events.t_end_ns
    cuts = np.searchsorted(events.t_ns, borders_ns)
    cuts[-1] = len(events)
    made = []
    for k, (start, stop) in enumerate(pairwise(cuts.tolist())):
        part = events.slice(start, stop, int(borders_ns[k + 1]))
        begin_ns = int(part.t_ns[0] if len(part) else borders_ns[k])
        stamp_ns = max(0, begin_ns + offset_ns)
        made.append(build_event_packet(stamp_ns, frame_id, *size, first_seq + k, 0, 'evt3', encoder.encode(part)))
    return made


class Session:
    """A live receiver, its clock and everything it gave."""

    def __init__(
        self, camera: CameraModel | None = None, bit_rates: tuple[float, ...] = (BIT_RATE,), receiver: str = 'sequence'
    ) -> None:
        self.live = LiveReceiver(Parameters(bit_rates=bit_rates, receiver=receiver), 50 * MS, LAG_NS, camera)
        self.now_ns = STAMP_NS
        self.steps: list[Step] = [self.live.open(TYPE, self.now_ns)]

    def push(self, stream: list[bytes]) -> None:
        for message in stream:
            self.steps.append(self.live.push(message, self.now_ns))
            self.now_ns += PACKET_NS

    def wait(self, seconds: float) -> None:
        for _ in range(round(seconds / 0.025)):
            self.now_ns += 25 * MS
            step = self.live.tick(self.now_ns, 25 * MS)
            if step is not None:
                self.steps.append(step)

    def characters(self) -> list[StampedCharacter]:
        return [stamped for step in self.steps for stamped in step.characters]

    def text(self, first_step: int = 0) -> str:
        return ''.join(chr(stamped.character.code) for step in self.steps[first_step:] for stamped in step.characters)

    def track_ids(self, first_step: int = 0) -> set[int]:
        return {stamped.track_id for step in self.steps[first_step:] for stamped in step.characters}


class Heard:
    """Which characters of a text that is sent from ``START_NS`` on were heard.

    Attributes:
        right: places in the text of the characters that are as sent, whatever their status.
        wrong_ok: codes of those that are not, and yet OK.
    """

    def __init__(self, characters: list[StampedCharacter], text: str, bit_rate: float = BIT_RATE) -> None:
        self.right: set[int] = set()
        self.wrong_ok: list[int] = []
        for stamped in characters:
            place = (stamped.at.sensor_ns - START_NS) * bit_rate / NS_PER_S / CharacterFrame().length
            k = round(place)
            if abs(place - k) < 0.15 and 0 <= k < len(text) and ord(text[k]) == stamped.character.code:
                self.right.add(k)
            elif stamped.character.status is Status.OK:
                self.wrong_ok.append(stamped.character.code)


def spared(gaps: list[tuple[int, int]], count: int, bit_rate: float = BIT_RATE, relock: int = 2) -> set[int]:
    """Return the places of those of ``count`` characters that overlap no gap (ns, stream), nor are the next ``relock``."""
    length_ns = CharacterFrame().duration_ns(bit_rate)
    hit: set[int] = set()
    for start_ns, stop_ns in gaps:
        # A start edge's events lag behind it, and a character's end with them.
        first, last = int((start_ns - START_NS) / length_ns - 0.05), int((stop_ns - START_NS) / length_ns)
        hit.update(range(first, last + 1 + relock))
    return set(range(count)) - hit
