"""The whole receiver on simulated scenes: any batching, any clock, silence, restarts, a fair queue."""

from dataclasses import replace
from itertools import cycle, pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from beacon_comm.core.candidates import BeaconState
from beacon_comm.core.events import NS_PER_S, EventBatch
from beacon_comm.core.parameters import Parameters
from beacon_comm.core.receiver import Output, Receiver, SignalReceiver
from beacon_comm.recordings.disc import Disc
from beacon_comm.simulation.led import OUTDOOR_30_M, sensor_noise, simulate_text, square_wave

SIZE = (160, 120)
STEADY = replace(
    OUTDOOR_30_M, rise=replace(OUTDOOR_30_M.rise, variation=0.1), fall=replace(OUTDOOR_30_M.fall, variation=0.1)
)
"""An LED whose bursts vary too little to lose an edge."""
TEXT = "Shall I compare thee to a summer's day?"
Events = tuple[np.ndarray, np.ndarray]
CharacterList = list[tuple[int, int, int, int]]


def on_disc(events: Events, disc: Disc, seed: int = 0) -> EventBatch:
    t_ns, polarity = events
    x, y = disc.pixels(t_ns, seed)
    return EventBatch(x, y, polarity, t_ns, int(t_ns[-1]))


def still(x_px: float, y_px: float, radius_px: float = 4.0) -> Disc:
    return Disc(x_px, y_px, radius_px, 0.0, 0.0, *SIZE)


def merged(*parts: EventBatch) -> EventBatch:
    order = np.argsort(np.concatenate([part.t_ns for part in parts]), kind='stable')
    columns = [np.concatenate([getattr(part, name) for part in parts])[order] for name in ('x', 'y', 'polarity', 't_ns')]
    return EventBatch(*columns, max(part.t_end_ns for part in parts))


def shifted(batch: EventBatch, dt_ns: int) -> EventBatch:
    return EventBatch(batch.x, batch.y, batch.polarity, batch.t_ns + dt_ns, batch.t_end_ns + dt_ns)


def pieces(batch: EventBatch, cuts: list[int]) -> list[EventBatch]:
    """Cut at event indices; a piece ends at its last event, or at the time of the next one (alternately)."""
    parts = []
    for k, (start, stop) in enumerate(pairwise([0, *sorted(cuts), len(batch)])):
        after = int(batch.t_ns[stop]) if stop < len(batch) else batch.t_end_ns
        before = int(batch.t_ns[stop - 1]) if stop else after
        parts.append(batch.slice(start, stop, after if k % 2 else before))
    return parts


def received(outputs: list[Output]) -> CharacterList:
    """All characters as tuples, in an order that does not depend on the batches they came in."""
    return sorted(
        (r.track_id, r.character.t_ns, r.character.code, int(r.character.status)) for o in outputs for r in o.characters
    )


def text_of(outputs: list[Output], track_id: int | None = None) -> str:
    return ''.join(
        chr(r.character.code) for o in outputs for r in o.characters if track_id is None or r.track_id == track_id
    )


@pytest.fixture(scope='module')
def scene() -> EventBatch:
    """A still beacon at 3125 bps, a moving one at 504 bps, a lamp, and noise: 1 s."""
    fast = simulate_text(TEXT * 6, 3125.0, t0_ns=120_000_000, tail_s=0.05, seed=1)
    slow = simulate_text(TEXT, 504.0, t0_ns=110_000_000, tail_s=0.05, seed=2)
    lamp = square_wave(120.0, 0.5, 1.0, seed=3)
    return merged(
        on_disc(fast, still(40, 30)),
        on_disc(slow, Disc(100.0, 80.0, 4.0, 50.0, 0.0, *SIZE)),
        on_disc(lamp, still(40, 90)),
        sensor_noise(20_000, 1.0, *SIZE, seed=4),
    )


@pytest.fixture(scope='module')
def at_once(scene: EventBatch) -> tuple[Receiver, list[Output]]:
    receiver = Receiver(Parameters(), SIZE)
    return receiver, [receiver.push(scene), receiver.flush()]


def test_both_beacons_are_read_and_confirmed_and_the_lamp_is_not(at_once: tuple[Receiver, list[Output]]) -> None:
    receiver, outputs = at_once
    beacons = {b.track_id: b for b in receiver.beacons()}
    confirmed = [beacons[track_id] for track_id in receiver.confirmed]
    assert sorted(round(b.bit_rate_bps or 0) for b in confirmed) == [504, 3125]
    for beacon in confirmed:
        truth = TEXT * 6 if round(beacon.bit_rate_bps) == 3125 else TEXT
        text = text_of(outputs, beacon.track_id)
        wrong = sum(a != b for a, b in zip(text, truth, strict=True))
        assert wrong <= 0.03 * len(truth)


@settings(max_examples=8, deadline=None)
@given(data=st.data())
def test_any_batching_and_any_rest_give_the_same_output(
    data: st.DataObject, scene: EventBatch, at_once: tuple[Receiver, list[Output]]
) -> None:
    cuts = data.draw(st.lists(st.integers(0, len(scene)), max_size=60))
    rests = data.draw(st.lists(st.integers(0, 4), min_size=1, max_size=5))
    receiver = Receiver(Parameters(), SIZE)
    outputs = []
    for piece, most in zip(pieces(scene, cuts), cycle(rests), strict=False):
        outputs.append(receiver.push(piece))
        for _ in range(most):
            receiver.rest()
    outputs.append(receiver.flush())
    assert received(outputs) == received(at_once[1])
    assert receiver.beacons() == at_once[0].beacons()


@pytest.mark.parametrize('t0_ns', [2**40, 7 * NS_PER_S])
def test_the_clock_may_start_anywhere_on_the_hop_grid(
    t0_ns: int, scene: EventBatch, at_once: tuple[Receiver, list[Output]]
) -> None:
    """2⁴⁰ ns and more: int64 times lose nothing.  The grid is absolute, so the shift is a whole number of hops."""
    dt_ns = t0_ns // 10_000_000 * 10_000_000
    receiver = Receiver(Parameters(), SIZE)
    outputs = [receiver.push(shifted(scene, dt_ns)), receiver.flush()]
    assert [(i, t - dt_ns, c, s) for i, t, c, s in received(outputs)] == received(at_once[1])


def test_the_last_character_before_a_silence_comes_out_by_time_alone() -> None:
    receiver = SignalReceiver(Parameters(bit_rates=(504.0,)))
    t_ns, polarity = simulate_text('Hello, world', 504.0, t0_ns=100_000_000, tail_s=0.0, model=STEADY, seed=5)
    outputs = [receiver.push_signal(t_ns, polarity, int(t_ns[-1]))]
    assert text_of(outputs) != 'Hello, world'
    outputs.append(receiver.push(EventBatch.empty(int(t_ns[-1]) + 150_000_000)))
    assert text_of(outputs) == 'Hello, world'


@pytest.mark.parametrize(('reacquire_s', 'rate_bps', 'label'), [(0.0, 3125.0, 2), (10.0, 3125.0, 1), (10.0, 2000.0, 2)])
def test_a_silent_track_is_quiet_then_lost_and_its_label_comes_back_with_its_rate_alone(
    reacquire_s: float, rate_bps: float, label: int
) -> None:
    receiver = Receiver(Parameters(tracker='motion', lost_after_s=0.5, reacquire_s=reacquire_s), SIZE)
    beacon = on_disc(simulate_text(TEXT, 3125.0, t0_ns=0, lead_s=0.0, tail_s=0.0, seed=6), still(40, 30))
    receiver.push(beacon)
    end_ns = int(beacon.t_ns[-1])
    (first,) = receiver.beacons()
    assert first.track_id == 1 and not first.quiet
    assert receiver.push(EventBatch.empty(end_ns + 200_000_000)).lost == ()
    (still_there,) = receiver.beacons()
    assert still_there.quiet and still_there.age_s == pytest.approx(0.2, abs=0.02)
    (gone,) = receiver.push(EventBatch.empty(end_ns + 700_000_000)).lost
    assert (gone.track_id, gone.state) == (first.track_id, BeaconState.LOST)
    back = on_disc(simulate_text(TEXT * 2, rate_bps, t0_ns=NS_PER_S, lead_s=0.0, tail_s=0.0, seed=7), still(40, 30))
    outputs = [receiver.push(back)]
    (again,) = receiver.beacons()
    assert again.track_id == label and again.state is BeaconState.CONFIRMED
    assert [one.track_id for output in outputs for one in output.lost] == ([1] if rate_bps == 2000.0 else [])


def test_an_hour_of_nothing_is_one_step() -> None:
    """Else a dropped-out camera would cost 360,000 hops; the time-out of the track still comes."""
    receiver = Receiver(Parameters(), SIZE)
    receiver.push(on_disc(simulate_text(TEXT, 3125.0, seed=7), still(40, 30)))
    hops = 0
    route = receiver._detection.route

    def counted(segment: EventBatch) -> list:
        nonlocal hops
        hops += 1
        return route(segment)

    receiver._detection.route = counted  # type: ignore[method-assign]
    output = receiver.push(EventBatch.empty(3600 * NS_PER_S))
    assert len(output.lost) == 1 and hops < 400


@pytest.mark.parametrize('restart', ['reset', 'resize'])
def test_a_restart_loses_all_tracks_and_goes_on(restart: str) -> None:
    receiver = Receiver(Parameters(), SIZE)
    beacon = on_disc(simulate_text(TEXT, 3125.0, t0_ns=5 * NS_PER_S, seed=8), still(40, 30))
    receiver.push(beacon)
    (before,) = receiver.beacons()
    output = receiver.reset() if restart == 'reset' else receiver.resize((80, 60))
    assert [b.track_id for b in output.lost] == [before.track_id]
    assert receiver.beacons() == () and receiver.confirmed == ()
    again = [receiver.push(shifted(beacon, 0 if restart == 'resize' else -4 * NS_PER_S))]
    if restart == 'resize':
        again.append(receiver.push(shifted(beacon, NS_PER_S)))
    (after,) = receiver.beacons()
    assert after.track_id > before.track_id
    assert 'compare' in text_of(again)


def test_a_beacon_gets_a_slot_among_many_lamps() -> None:
    """Two slots, six lamps brighter than the beacon: within three rounds of the queue it is confirmed."""
    parameters = Parameters(candidate_slots=2, bit_rates=(3125.0,))
    lamps = [
        on_disc(square_wave(90.0 + 17.0 * k, 0.5, 8.0, seed=10 + k), still(20 + 22 * k, 20, 3.0), seed=k)
        for k in range(6)
    ]
    beacon = on_disc(simulate_text(TEXT * 56, 3125.0, t0_ns=100_000_000, seed=20), still(80, 80))
    receiver = Receiver(parameters, SIZE)
    scene = merged(*lamps, beacon)
    receiver.push(scene.slice(0, 0, 0))
    turns: dict[int, int] = {}
    demodulating: set[int] = set()
    confirmed_turns: list[int] = []
    for t_hop in range(0, 8 * NS_PER_S, 10_000_000):
        start, stop = np.searchsorted(scene.t_ns, [t_hop, t_hop + 10_000_000])
        receiver.push(scene.slice(int(start), int(stop), t_hop + 10_000_000))
        now = {b.track_id for b in receiver.beacons() if b.state is BeaconState.DEMODULATING}
        for track_id in now - demodulating:
            turns[track_id] = turns.get(track_id, 0) + 1
        demodulating = now
        if receiver.confirmed:
            confirmed_turns = [turn for track_id, turn in turns.items() if track_id not in receiver.confirmed]
            break
    assert len(receiver.confirmed) == 1
    (beacon_now,) = (b for b in receiver.beacons() if b.track_id == receiver.confirmed[0])
    assert abs(beacon_now.x_px - 80) < 2 and abs(beacon_now.y_px - 80) < 2
    assert max(confirmed_turns, default=0) <= 3


def test_noise_confirms_nothing() -> None:
    receiver = Receiver(Parameters(index_threshold=0.1, min_area_px=1), SIZE)
    outputs = [receiver.push(sensor_noise(400_000, 3.0, *SIZE, seed=9))]
    assert receiver.confirmed == () and not any(o.confirmed_changed for o in outputs)


def test_a_line_that_is_held_says_nothing() -> None:
    """ON events for 10 s, then OFF events for 10 s: no character."""
    receiver = SignalReceiver(Parameters())
    t_ns = np.arange(0, 20 * NS_PER_S, 200_000, dtype=np.int64)
    polarity = np.where(t_ns < 10 * NS_PER_S, 1, -1).astype(np.int8)
    outputs = [receiver.push_signal(t_ns, polarity, 20 * NS_PER_S), receiver.flush()]
    assert received(outputs) == []


def test_a_time_far_ahead_costs_nothing() -> None:
    """A damaged message may hold events of any time; hop by hop the way there would take for ever."""
    text = on_disc(simulate_text(TEXT, 3125.0, t0_ns=NS_PER_S, model=STEADY), still(80, 60))
    far_ns = 1 << 61
    ahead = EventBatch(
        np.array([5, 6], np.uint16), np.array([5, 6], np.uint16), np.ones(2, np.int8), np.array([far_ns, 2 * far_ns - 1]),
        2 * far_ns - 1,
    )  # fmt: skip
    receiver = Receiver(Parameters(bit_rates=(3125.0,)), SIZE)
    outputs = [receiver.push(merged(text, ahead))]
    assert ''.join(chr(code) for _, _, code, _ in sorted(received(outputs), key=lambda c: c[1])).endswith(TEXT)
    assert receiver.t_ns == 2 * far_ns - 1 and receiver.beacons() == ()


def test_a_beacon_among_more_lamps_than_tracks_has_its_turn() -> None:
    lamps = [on_disc(square_wave(120.0, 0.5, 2.2, seed=k), still(20 + 30 * (k % 5), 20 + 40 * (k // 5)), k) for k in range(7)]
    beacon = on_disc(simulate_text(TEXT * 9, 3125.0, t0_ns=500_000_000, model=STEADY, seed=1), still(80, 100))
    parameters = Parameters(bit_rates=(3125.0,), rate_search='listed', max_tracks=4, candidate_slots=2, starved_after_s=0.2)
    receiver = Receiver(parameters, SIZE)
    events = merged(*lamps, beacon)
    outputs = [receiver.push(part) for part in pieces(events, list(range(0, len(events), 50_000)))]
    assert TEXT in text_of(outputs)
    (confirmed,) = [one for one in receiver.beacons() if one.state is BeaconState.CONFIRMED]
    assert (confirmed.x_px, confirmed.y_px) == pytest.approx((80.0, 100.0), abs=2.0)
    lost = [one.track_id for output in outputs for one in output.lost]
    assert len(lost) == len(set(lost)) > 0 and len(receiver.beacons()) <= 4
