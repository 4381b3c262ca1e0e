"""The node's own measure of its latency: which characters count, from which packet on, over which window."""

from __future__ import annotations

import pytest
from live_session import MS, PACKET_NS, TEXT, Session, beacon_events, packets

from beacon_comm.core.demodulator import decision_delay_bits
from beacon_comm.core.events import NS_PER_S
from beacon_comm.core.parameters import Parameters
from beacon_comm.ros.latency import LOOKS, MOST_CHARACTERS, MOST_PACKETS, CharacterLatency, percentile_ms

HOST_NS = 1_700_000_000 * NS_PER_S
BIT_NS = NS_PER_S / 3125.0


def values(latency: CharacterLatency) -> tuple[object, ...]:
    return tuple(latency.look().values())


@pytest.mark.parametrize(
    ('due_ms', 'latency_ms'),
    [
        (10.0, '12.000'),  # the packet that ends there holds it
        (10.5, '7.000'),
        (19.0, '7.000'),
        (30.0, '2.000'),
        (31.0, '2.000'),  # decided a moment early: with the packet at hand
        (1.0, '12.000'),  # older than what is kept
    ],
)
def test_it_counts_from_the_arrival_of_the_packet_that_holds_the_due_time(due_ms: float, latency_ms: str) -> None:
    latency = CharacterLatency()
    for end_ms, arrival_ms in ((10, 0), (20, 5), (30, 10)):
        latency.arrived(end_ms * MS, HOST_NS + arrival_ms * MS)
    latency.published([round(due_ms * MS)], HOST_NS + 12 * MS)
    assert values(latency) == (latency_ms, latency_ms, 1)


def test_a_restarted_sensor_has_arrivals_of_its_own() -> None:
    latency = CharacterLatency()
    latency.arrived(900 * MS, HOST_NS)
    latency.arrived(20 * MS, HOST_NS + 50 * MS)
    latency.published([20 * MS], HOST_NS + 51 * MS)
    assert values(latency) == ('1.000', '1.000', 1)


def test_a_clock_that_is_set_back_gives_no_negative_time() -> None:
    latency = CharacterLatency()
    latency.arrived(20 * MS, HOST_NS)
    latency.published([20 * MS], HOST_NS - NS_PER_S)
    assert values(latency) == ('0.000', '0.000', 1)


def test_percentiles_are_values_that_occurred() -> None:
    milliseconds = [k * MS for k in range(1, 101)]
    assert [percentile_ms(milliseconds, share) for share in (0.0, 0.5, 0.985, 0.99, 1.0)] == [
        '1.000', '50.000', '99.000', '99.000', '100.000'
    ]  # fmt: skip
    assert percentile_ms([], 0.5) == 'nan'


def test_the_window_is_of_the_last_looks_and_memory_is_bounded() -> None:
    latency = CharacterLatency()
    assert values(latency) == ('nan', 'nan', 0)
    for k in range(LOOKS + 2):
        latency.arrived(k * MS, HOST_NS)
        latency.published([k * MS] * 10, HOST_NS + k * MS)
        count = values(latency)[2]
        assert count == 10 * min(k + 1, LOOKS)
    assert values(latency) == ('4.000', '6.000', 10 * (LOOKS - 1))
    for _ in range(LOOKS):
        latency.published([0] * (MOST_CHARACTERS + 5), HOST_NS)
        latency.look()
    for k in range(MOST_PACKETS + 5):
        latency.arrived(NS_PER_S + k, HOST_NS)
    assert values(latency)[2] == (LOOKS - 1) * MOST_CHARACTERS
    assert len(latency._arrivals) == MOST_PACKETS


@pytest.mark.parametrize(
    ('receiver', 'bit_rates', 'read_back'),
    [('sequence', (3125.0,), 3), ('threshold', (504.0, 3125.0), 10), ('threshold', (3125.0,), 0)],
)
def test_characters_count_that_fell_due_while_they_were_read(
    receiver: str, bit_rates: tuple[float, ...], read_back: int
) -> None:
    """What is read back when the beacon is found does not; of the others each is due its delay after its end."""
    session = Session(receiver=receiver, bit_rates=bit_rates)
    session.push(packets(beacon_events(4 * TEXT)))
    delay_bits = decision_delay_bits(Parameters(receiver=receiver))
    assert delay_bits == (22.0 if receiver == 'sequence' else 0.5)
    counted: list[int] = []
    for step in session.steps:
        for due_ns in step.due_ns:
            assert step.end_ns is not None
            assert step.end_ns - PACKET_NS - BIT_NS < due_ns < step.end_ns + BIT_NS, 'decided when it is due'
        counted += step.due_ns
    (beacon,) = session.live.beacons()
    settled_ns = session.live.settled_ns(beacon.track_id)
    assert settled_ns is not None
    due_ns = [stamped.character.t_ns + (11 + delay_bits) * BIT_NS for stamped in session.characters()]
    assert counted == pytest.approx([due for due in due_ns if due > settled_ns], abs=0.1 * BIT_NS)
    assert len(due_ns) - 30 < len(counted) <= len(due_ns) - read_back


def test_what_a_silence_or_the_end_decides_does_not_count() -> None:
    session = Session()
    session.push(packets(beacon_events()))
    before = len(session.steps)
    session.wait(0.2)
    session.steps.append(session.live.flush(session.now_ns))
    assert session.characters()[-1].character.code == ord('\n')
    assert any(step.characters for step in session.steps[before:])
    assert all(step.due_ns == () for step in session.steps[before:])
