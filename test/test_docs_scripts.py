"""The scripts in ``docs/`` that measure receivers: their parts on small cases, without a timing assertion."""

from pathlib import Path

import numpy as np
import pytest
from docs_script import load

from beacon_comm.core.parameters import Parameters

THRESHOLD = Parameters(receiver='threshold', bit_rates=(504.0, 1000.0, 3125.0))


benchmark = load('benchmark_demodulators')
calibrate = load('calibrate_simulator')
reliability = load('reliability')


@pytest.mark.parametrize('packet_ns', [None, 7, 10, 1000])
def test_packets_hold_every_event_once(packet_ns: int | None) -> None:
    t_ns = np.array([5, 5, 9, 25, 26, 60], np.int64)
    polarity = np.array([1, -1, 1, -1, 1, -1], np.int8)
    packets = benchmark.packets((t_ns, polarity), packet_ns, start=1)
    assert np.concatenate([packet[0] for packet in packets]).tolist() == t_ns[1:].tolist()
    assert np.concatenate([packet[1] for packet in packets]).tolist() == polarity[1:].tolist()
    begin_ns = 0
    for times, _, end_ns in packets:
        assert np.all((times >= begin_ns) & (times < end_ns))
        begin_ns = end_ns
    assert begin_ns == 61


def test_a_run_of_the_benchmark_gives_every_character() -> None:
    waveform = reliability.simulated(3125.0, np.random.default_rng(1))
    for packet_ns in (10_000_000, None):
        timing = benchmark.run((waveform.t_ns, waveform.polarity), THRESHOLD, packet_ns)
        assert timing.included_events == len(waveform.t_ns) > timing.excluded_events > 0
        assert 0.0 < timing.lock_s < 0.5
        assert abs(timing.characters - len(reliability.CODES)) < 5


@pytest.mark.parametrize('stress', list(reliability.STRESSES))
def test_what_was_sent_stays_known_under_every_stress(stress: str) -> None:
    random = np.random.default_rng(2)
    waveform = reliability.simulated(3125.0, random)
    stressed = reliability.STRESSES[stress](waveform, random)
    (due,) = stressed.sendings
    assert due.codes is reliability.CODES
    assert np.all(np.diff(due.t_ns) > 0)
    assert abs(int(stressed.t_ns[0]) - int(due.t_ns[0]) + 100_000_000) < 20_000_000  # 0.1 s of idle line before


def test_a_clock_that_is_off_is_judged_by_its_own_time() -> None:
    job = reliability.Job('simulated, 3125 bps', 'clock up to 2 % off', 1, {'threshold': THRESHOLD})
    found, _ = job.run()
    assert len(found) > 500
    assert found.right.mean() > 0.9


def test_the_page_counts_characters_and_errors() -> None:
    count = 40
    found = reliability.Judged(
        np.linspace(0.5, 1.0, count),
        np.arange(count) % 4 > 0,
        np.zeros(count, np.int8),
        np.full(count, 'threshold'),
        np.full(count, 'clock drifting'),
        np.full(count, 'simulated, 504 bps'),
        np.arange(count) % 3,
    )
    page = reliability.page({'threshold': found}, 7, ['simulated, 504 bps'], ['--write'], True)
    assert '| threshold | 40 | 10 | 75.00 % | 75.00 % |' in page
    assert '| OK | 40 | 10 |' in page and '| clock drifting | 40 | 10 |' in page
    assert '7 outside every sending' in page


@pytest.mark.parametrize(
    ('share', 'text'), [(0.0, '0.00 %'), (0.5, '50.00 %'), (0.99995, '99.9950 %'), (1.0, '100.00 %')]
)
def test_percent_shows_what_is_missing_to_one(share: float, text: str) -> None:
    assert reliability.percent(share) == text


def test_a_simulated_recording_is_measured_against_itself() -> None:
    name = '3125hz_30m'
    scene = calibrate.described(name)
    signals = [calibrate.simulated_signal(name, scene, 40, seed) for seed in (1, 2)]
    assert calibrate.misfit(signals[0], signals[0]) == 0.0
    other = calibrate.simulated_signal(name, calibrate.described('504hz_30m'), 40, 1)
    assert 0.0 < calibrate.misfit(*signals) < calibrate.misfit(signals[0], other)
    found = calibrate.numbers(signals[0])
    assert found.rise[0] > 0 and found.burst_us == pytest.approx(scene.sensor.scan_us, rel=0.1)
    errors = calibrate.errors(signals[0], name, 'sequence')
    assert errors.due == 40 and errors.wrong <= 2
    few, many = ({'sequence': calibrate.Errors(40, wrong)} for wrong in (0, 4))
    compared = calibrate.Compared(name, signals[0], signals[1:], few, many)
    assert '| 3125hz_30m | sequence | 0 of 40: 1.0000' in calibrate.page([compared], (2,))
    assert '| -10.0 |' in calibrate.page([compared], (2,))


@pytest.mark.parametrize(('name', 'characters', 'most'), [('504hz_30m', 30, 9.0), ('3125hz_30m', 120, 6.0)])
def test_the_simulated_scenes_are_near_the_recordings(name: str, characters: int, most: float, data_folder: Path) -> None:
    """The margins themselves are held by ``calibrate_simulator.py --check``, which takes a minute."""
    real = calibrate.real_signal(name)
    simulated = calibrate.simulated_signal(name, calibrate.described(name), characters, 9)
    theirs, ours = calibrate.numbers(real), calibrate.numbers(simulated)
    assert ours.a_bit == pytest.approx(theirs.a_bit, rel=0.1)
    assert ours.on_to_off == pytest.approx(theirs.on_to_off, rel=0.15)
    assert ours.burst_us == pytest.approx(theirs.burst_us, rel=0.1)
    assert ours.fall[0] == pytest.approx(theirs.fall[0], rel=0.15)
    assert calibrate.misfit(real, simulated) < most
