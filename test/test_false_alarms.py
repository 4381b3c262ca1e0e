"""The candidates of ``docs/false_alarms.py``: a tiny sample of every family, and nothing of it is confirmed."""

from pathlib import Path

import numpy as np
import pytest
from docs_script import load

from beacon_comm.core.parameters import Parameters
from beacon_comm.evaluation.receivers import declared_receivers

false_alarms = load('false_alarms')
SIMULATED = list(false_alarms.SIMULATED)


def check(events: tuple[np.ndarray, np.ndarray]) -> None:
    t_ns, polarity = events
    assert t_ns.dtype == np.int64 and polarity.dtype == np.int8
    assert len(t_ns) == len(polarity) > 0
    assert np.all(np.diff(t_ns) >= 0)
    assert np.all(np.abs(polarity) == 1)


@pytest.mark.parametrize('name', SIMULATED)
def test_no_candidate_is_confirmed(name: str) -> None:
    events = false_alarms.candidate(false_alarms.SIMULATED[name], name, 0)
    check(events)
    again = false_alarms.candidate(false_alarms.SIMULATED[name], name, 0)
    assert all(np.array_equal(one, other) for one, other in zip(events, again, strict=True))
    for receiver, parameters in declared_receivers().items():
        assert not false_alarms.try_candidate(name, 0, events, parameters).confirmed, receiver


@pytest.mark.parametrize('bag', false_alarms.BAGS)
def test_no_patch_of_a_bag_is_confirmed(data_folder: Path, bag: str) -> None:
    name = f'patch of {bag}'
    make = false_alarms.families(data_folder)[name]
    for number in range(2):
        events = false_alarms.candidate(make, name, number)
        check(events)
        assert len(events[0]) >= false_alarms.LEAST_EVENTS
        for receiver, parameters in declared_receivers().items():
            assert not false_alarms.try_candidate(name, number, events, parameters).confirmed, receiver


def test_a_beacon_on_the_same_path_is_confirmed() -> None:
    job = false_alarms.Job(false_alarms.CONTROL, range(2), 0, {'threshold': Parameters()}, None)
    outcomes = job.run()['threshold']
    assert [outcome.confirmed for outcome in outcomes] == [True, True]
    assert all(outcome.ok > 15 and outcome.characters >= outcome.ok for outcome in outcomes)


def test_a_candidate_without_events_gives_nothing() -> None:
    nothing = (np.empty(0, np.int64), np.empty(0, np.int8))
    outcome = false_alarms.try_candidate('nothing', 0, nothing, Parameters())
    assert (outcome.confirmed, outcome.characters, outcome.seconds) == (False, 0, 0.0)


def test_the_page_counts_every_candidate_and_leaves_the_control_out_of_the_sum() -> None:
    outcome = false_alarms.Outcome
    outcomes = [outcome('lamp', k, 2.0, k == 3, 10, 4, 1) for k in range(8)]
    outcomes += [outcome(false_alarms.CONTROL, 0, 2.0, True, 10, 10, 0)]
    page = false_alarms.text_of({'threshold': outcomes}, ['--count', '8'])
    assert '| **all** | 8 | 1 | 12.5 % (2.24 to 47.1) | 8 | 8 | 100 % (67.6 to 100) | 80 | 32 | 8 | 16 |' in page
    assert 'Confirmed: lamp 3.' in page
    assert 'false_alarms.py --count 8' in page


def test_receivers_are_all_that_are_declared() -> None:
    receivers = declared_receivers(bit_rates=(504.0,))
    assert receivers['threshold'].receiver == 'threshold'
    assert all(parameters.bit_rates == (504.0,) for parameters in receivers.values())


def test_a_lock_that_is_lost_in_what_was_said_before_it_is_not_found_for_ever() -> None:
    # Regular edges that resemble a beacon for a while: read back, each lock is lost at the same place.
    name = 'moving edges, regular'
    events = false_alarms.candidate(false_alarms.SIMULATED[name], name, 333)
    assert not false_alarms.try_candidate(name, 333, events, Parameters()).confirmed
