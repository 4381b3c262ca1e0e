"""What a driver, a network and a recording do to a stream: losses, disorder, sizes, clocks.

Other faults have their tests where they are dealt with: docs/robustness.md lists them all.
"""

from __future__ import annotations

from collections import Counter
from pathlib import Path

import numpy as np
import pytest
from live_session import (
    BIT_RATE,
    MS,
    PACKET_NS,
    STAMP_NS,
    START_NS,
    TEXT,
    TYPE,
    Heard,
    Session,
    beacon_events,
    packets,
    spared,
)

from beacon_comm.cli.offline import Options, evaluate_recording
from beacon_comm.core.events import EventBatch
from beacon_comm.core.parameters import Parameters
from beacon_comm.recordings.bag_writer import BagWriter
from beacon_comm.recordings.disc import Disc
from beacon_comm.simulation.led import simulate_text
from beacon_comm.wire.cdr import build_event_packet

SHARE = 0.05
LOCKED = 60
"""Packets at the beginning that are left whole: what is lost before the lock is another question."""
SEQUENCE, THRESHOLD = 'sequence', 'threshold'
RECEIVERS = [SEQUENCE, THRESHOLD]


def simulated(text: str, bit_rate: float, seed: int) -> EventBatch:
    """Return the events of a simulated LED that begins to send ``text`` at ``START_NS``."""
    t_ns, polarity = simulate_text(text, bit_rate, t0_ns=START_NS, seed=seed)
    x, y = Disc(30.0, 24.0, 4.0, 0.0, 0.0, 64, 48).pixels(t_ns, seed)
    return EventBatch(x, y, polarity, t_ns, int(t_ns[-1]))


class Run:
    """A text whose packets go wrong, beside the same without a fault.

    Args:
        receiver, bit_rate: which receiver, and how fast the beacon is (bit/s).
        seed: of the signal and of the packets.
    """

    def __init__(self, receiver: str, bit_rate: float, seed: int) -> None:
        self.text = (6 if bit_rate == BIT_RATE else 2) * TEXT
        self._bit_rate, self._receiver = bit_rate, receiver
        events = simulated(self.text, bit_rate, seed)
        self._first_ns = int(events.t_ns[0])
        self.stream = packets(events)
        random = np.random.default_rng(seed)
        self.chosen = [k for k in range(LOCKED, len(self.stream) - 3, 2) if random.random() < 2 * SHARE]
        self._whole, _ = self._heard(self.stream)

    def check(self, stream: list[bytes], gone: list[int]) -> Counter[str]:
        """Hear the faulty stream, of which packets are gone; return the counts.

        Only characters that overlap a gap, and two behind it, may be missing, and none may be wrong and ok that was
        not so before.
        """
        heard, session = self._heard(stream)
        gaps = [(self._first_ns + k * PACKET_NS, self._first_ns + (k + 1) * PACKET_NS) for k in gone]
        assert Counter(heard.wrong_ok) <= Counter(self._whole.wrong_ok)
        assert spared(gaps, len(self.text), self._bit_rate) & self._whole.right <= heard.right
        assert session.live.counts['restarts'] == 0 and len(session.track_ids()) == 1
        return session.live.counts

    def _heard(self, stream: list[bytes]) -> tuple[Heard, Session]:
        session = Session(bit_rates=(self._bit_rate,), receiver=self._receiver)
        session.push(stream)
        session.wait(1.0)
        return Heard(session.characters(), self.text, self._bit_rate), session


@pytest.mark.parametrize('seed', range(3))
@pytest.mark.parametrize('bit_rate', [BIT_RATE, 504.0])
@pytest.mark.parametrize('receiver', RECEIVERS)
def test_five_percent_lost(receiver: str, bit_rate: float, seed: int) -> None:
    run = Run(receiver, bit_rate, seed)
    counts = run.check([message for k, message in enumerate(run.stream) if k not in run.chosen], run.chosen)
    assert counts['lost_packets'] == len(run.chosen) > 5


@pytest.mark.parametrize('receiver', RECEIVERS)
def test_a_lossy_bag_is_read_as_it_was_live(receiver: str, tmp_path: Path) -> None:
    """Lost from the beginning on, some next to one another, and once many."""
    events = simulated(3 * TEXT, BIT_RATE, 5)
    random = np.random.default_rng(5)
    stream = [message for k, message in enumerate(packets(events)) if not 80 <= k < 92 and random.random() >= SHARE]
    session = Session(receiver=receiver)
    session.push(stream)
    session.steps.append(session.live.flush(session.now_ns))
    with BagWriter(tmp_path / 'bag') as writer:
        writer.add_topic('/events', TYPE)
        for k, message in enumerate(stream):
            writer.write('/events', STAMP_NS + k * PACKET_NS, message)
    parameters = Parameters(bit_rates=(BIT_RATE,), receiver=receiver)
    (beacon,) = evaluate_recording(str(tmp_path / 'bag'), Options(parameters)).beacons
    first_ns = int(events.t_ns[0])
    heard = [(one.at.sensor_ns - first_ns, one.character.code, one.character.status) for one in session.characters()]
    assert len(heard) > len(3 * TEXT) // 2
    assert [(one.t_ns, one.code, one.status) for one in beacon.characters] == heard


@pytest.mark.parametrize('receiver', [SEQUENCE, THRESHOLD])
def test_five_percent_twice(receiver: str) -> None:
    run = Run(receiver, BIT_RATE, 3)
    counts = run.check([message for k, message in enumerate(run.stream) for _ in range(1 + (k in run.chosen))], [])
    assert counts['repeated_packets'] == len(run.chosen) > 5
    assert counts['lost_packets'] == counts['clamped_times'] == 0


@pytest.mark.parametrize('bit_rate', [BIT_RATE, 504.0])
@pytest.mark.parametrize('receiver', RECEIVERS)
def test_five_percent_swapped(receiver: str, bit_rate: float) -> None:
    """What comes too late is not read: the packet that overtook it has moved time on."""
    run = Run(receiver, bit_rate, 4)
    stream = run.stream.copy()
    for k in run.chosen:
        stream[k], stream[k + 1] = stream[k + 1], stream[k]
    counts = run.check(stream, run.chosen)
    assert counts['overtaken_packets'] == counts['lost_packets'] == len(run.chosen) > 5


def test_packets_of_nothing_and_of_8_megabytes() -> None:
    """Between them a beacon is read; the large ones are noise, at its own times and everywhere."""
    stream = packets(beacon_events())
    events = np.random.default_rng(1).integers(0, 1 << 16, 4 << 20).astype('<u2')
    events = events[(events >> 12 != 6) & (events >> 12 != 8)]  # of no time of their own
    session = Session()
    half = len(stream) // 2
    session.push(stream[:half])
    before = session.live.counts['events']
    for payload in (b'', events.tobytes().ljust(8 << 20, b'\0'), b'', b'\xff' * (8 << 20)):
        session.push([build_event_packet(STAMP_NS + half * 5 * MS, 'cam', 64, 48, half - 1, 0, 'evt3', payload)])
    assert session.live.counts['events'] > before and session.live.counts['empty_packets'] == 2
    session.push(stream[half:])
    session.wait(0.2)
    assert session.text().startswith(TEXT[:20]) and session.text().endswith(TEXT[-20:])
