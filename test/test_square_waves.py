"""Lamps confirm nothing: square waves through the demodulator, the rate bank and the candidate slots.

``docs/false_confirmation.py --full`` runs some 13 000 of them, ``docs/false_alarms.py --full`` more through both receivers;
here are those near rational multiples of a frame.
"""

import itertools
from dataclasses import replace

import numpy as np
import pytest

from beacon_comm.core.candidates import CandidateSlots
from beacon_comm.core.character import Character
from beacon_comm.core.confirmation import ParityRecord, Verdict
from beacon_comm.core.demodulator import make_demodulator
from beacon_comm.core.parameters import Parameters
from beacon_comm.core.routing import Routed, RoutedEvents
from beacon_comm.core.tracks import Track
from beacon_comm.simulation.led import Burst, LedModel, noise, simulate_text, square_wave

T0_NS = 2**40
RATES_BPS = (20.0, 100.0, 504.0, 1000.0, 3125.0, 10_000.0)
FREQUENCIES_HZ = (50.0, 100.0, 120.0, 240.0, 354.7, 504.0, 871.2, 1000.0)
FRAMES = (1 / 5, 1 / 4, 2 / 7, 1 / 3, 4 / 11, 2 / 5, 1 / 2, 2 / 3, 3 / 4, 1, 4 / 3, 3 / 2, 2)  # periods, in frames
DUTIES = (0.1, 0.3, 0.5, 0.6, 0.8, 0.9)
SHARP = LedModel(Burst(8, 0.3, 20e-6, 30e-6, 1e-6, 0.0), Burst(8, 0.3, 20e-6, 30e-6, 1e-6, 0.0), 0.0)
EDGES = LedModel(Burst(6, 0.0, 0.0, 1e-7, 1e-9, 0.0), Burst(6, 0.0, 0.0, 1e-7, 1e-9, 0.0), 0.0)
BLURRED = LedModel(Burst(8, 0.5, 20e-6, 400e-6, 1e-6, 0.0), Burst(8, 0.5, 20e-6, 200e-6, 1e-6, 0.0), 200.0)


def brighter(model: LedModel) -> LedModel:
    """Return a model of five times the events: the sequence receiver calls little ok that has eight an edge."""
    rise, fall = (replace(burst, events=5 * burst.events) for burst in (model.rise, model.fall))
    return replace(model, rise=rise, fall=fall)


def confirmations(characters: list[Character], parameters: Parameters) -> int:
    """Return how often a stream is confirmed when it is tried again after each verdict."""
    record, confirmed = ParityRecord(parameters), 0
    for character in characters:
        confirmed += record.push(character) is Verdict.CONFIRMED
        if record.confirmed or record.demoted:
            record = ParityRecord(parameters)
    return confirmed


def read(events: tuple[np.ndarray, np.ndarray], parameters: Parameters) -> list[Character]:
    demodulator = make_demodulator(parameters)
    return demodulator.push(*events, int(events[0][-1]) + 1) + demodulator.flush()


@pytest.mark.parametrize('bit_rate_bps', RATES_BPS)
@pytest.mark.parametrize('model', [EDGES, SHARP, BLURRED], ids=['edges', 'sharp', 'blurred'])
def test_a_lamp_read_at_any_rate_is_not_confirmed(bit_rate_bps: float, model: LedModel) -> None:
    parameters = Parameters(bit_rates=(bit_rate_bps,), receiver='threshold')
    total = 0
    rational = [f for f in (bit_rate_bps / 11 / frames for frames in FRAMES) if 50.0 <= f <= 1000.0]
    for frequency_hz, duty in itertools.product([*FREQUENCIES_HZ, *rational], DUTIES[:: 1 if bit_rate_bps > 100 else 3]):
        seconds = max(35 * 11 / bit_rate_bps, 20 / frequency_hz)
        characters = read(square_wave(frequency_hz, duty, seconds, t0_ns=T0_NS, model=model), parameters)
        total += len(characters)
        assert confirmations(characters, parameters) == 0, (frequency_hz, duty)
    assert total > 50  # characters were read, so the rules had something to refuse


@pytest.mark.parametrize('rate_search', ['listed', 'blind'])
@pytest.mark.parametrize('bit_rate_bps', [504.0, 3125.0])
@pytest.mark.parametrize('model', [EDGES, SHARP, BLURRED], ids=['edges', 'sharp', 'blurred'])
def test_the_sequence_receiver_confirms_no_lamp(rate_search: str, bit_rate_bps: float, model: LedModel) -> None:
    parameters = Parameters(bit_rates=(bit_rate_bps,), rate_search=rate_search)
    rational = [f for f in (bit_rate_bps / 11 / frames for frames in FRAMES[1::3]) if 50.0 <= f <= 1000.0]
    for k, frequency_hz in enumerate([100.0, 120.0, *rational]):
        duty = (0.3, 0.5, 0.8)[k % 3]
        events = square_wave(frequency_hz, duty, 45 * 11 / bit_rate_bps, t0_ns=T0_NS, model=brighter(model))
        assert confirmations(read(events, parameters), parameters) == 0, (frequency_hz, duty)


@pytest.mark.parametrize(('frequency_hz', 'duty'), [(100.0, 0.5), (120.0, 0.5), (240.0, 0.3), (871.2, 0.6)])
def test_a_lamp_is_not_confirmed_when_all_rates_are_tried(frequency_hz: float, duty: float) -> None:
    parameters = Parameters(bit_rates=(100.0, 504.0, 1000.0, 3125.0, 10_000.0), receiver='threshold')
    events = square_wave(frequency_hz, duty, 3.0, t0_ns=T0_NS, model=SHARP)
    assert confirmations(read(events, parameters), parameters) == 0


@pytest.mark.parametrize('receiver', ['threshold', 'sequence'])
@pytest.mark.parametrize('bit_rate_bps', [504.0, 3125.0])
@pytest.mark.parametrize('model', [EDGES, SHARP], ids=['edges', 'sharp'])
def test_a_beacon_seen_through_the_same_model_is_confirmed(bit_rate_bps: float, model: LedModel, receiver: str) -> None:
    parameters = Parameters(bit_rates=(bit_rate_bps,), receiver=receiver)
    text = "Shall I compare thee to a summer's day?\nThou art more lovely " * 2
    model = brighter(model) if receiver == 'sequence' else model
    events = simulate_text(text, bit_rate_bps, t0_ns=T0_NS, model=model)
    assert confirmations(read(events, parameters), parameters) >= 1


@pytest.mark.parametrize('events_per_bit', [1.0, 10.0, 100.0])
def test_noise_is_not_confirmed(events_per_bit: float) -> None:
    parameters = Parameters(bit_rates=(504.0,), receiver='threshold')
    events = noise(events_per_bit * 504.0, 20.0, t0_ns=T0_NS, seed=3)
    assert confirmations(read(events, parameters), parameters) == 0


def test_a_lamp_that_reads_as_valid_characters_makes_room_for_a_beacon() -> None:
    """One slot, a 120 Hz lamp that parity never fails, and a beacon of lower index."""
    parameters = Parameters(bit_rates=(504.0,), candidate_slots=1, receiver='threshold')
    streams = {
        1: square_wave(120.0, 0.5, 6.0, t0_ns=T0_NS, model=SHARP),
        2: simulate_text('It reads as 0 0000111 1 11 for ever. ' * 8, 504.0, t0_ns=T0_NS, model=SHARP),
    }
    slots = CandidateSlots(parameters, make_demodulator)
    tracks = {k: Track(k, 0, 0, T0_NS, 3, 3.0 - k, T0_NS, T0_NS) for k in streams}
    lamp_codes = set()
    for t_ns in range(T0_NS + 500_000_000, T0_NS + 6_000_000_000, 10_000_000):

        def backlog(track_id: int, t_ns: int = t_ns) -> tuple[np.ndarray, np.ndarray]:
            times, polarity = streams[track_id]
            first, end = np.searchsorted(times, [t_ns - 650_000_000, t_ns])
            return times[first:end], polarity[first:end]

        received = slots.assign(tracks, t_ns, backlog)
        routed = {}
        for track_id, (times, polarity) in streams.items():
            first, end = np.searchsorted(times, [t_ns, t_ns + 10_000_000])
            routed[track_id] = Routed(times[first:end], polarity[first:end])
        received += slots.demodulate(RoutedEvents.of(routed), t_ns + 10_000_000)
        lamp_codes |= {r.character.code for r in received if r.track_id == 1}
    assert slots.confirmed == (2,)
    assert lamp_codes  # it was read, and had right parity
