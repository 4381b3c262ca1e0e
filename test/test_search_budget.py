"""What candidates may spend on looking for their bit rates."""

import numpy as np
import pytest

from beacon_comm.core.candidates import CandidateSlots
from beacon_comm.core.demodulator import make_demodulator
from beacon_comm.core.parameters import Parameters
from beacon_comm.core.routing import Routed
from beacon_comm.core.search_budget import BIT_COST_S, BURST_S, EVENT_COST_S, SearchBudget
from beacon_comm.core.tracks import Track
from beacon_comm.simulation.led import noise

NS = 1_000_000_000


def test_a_full_bucket_waits_for_nothing_and_an_empty_one_for_its_debt() -> None:
    budget = SearchBudget(0.5)
    assert budget.ready_at(7.0) == 7.0
    budget.spend((0.5 * BURST_S + 0.1) / BIT_COST_S, 0)
    assert budget.ready_at(7.0) == pytest.approx(7.0 + 0.2 * NS)
    assert budget.ready_at(0.3 * NS) == 0.3 * NS
    budget.spend(0.0, int(0.15 / EVENT_COST_S))
    budget.set_load(0.1, 0.3 * NS)  # the debt is paid back more slowly
    late = budget.ready_at(0.3 * NS)
    budget.set_load(1.0, 0.4 * NS)
    assert 0.4 * NS < budget.ready_at(0.4 * NS) < late


def test_the_bucket_holds_no_more_than_a_burst() -> None:
    budget = SearchBudget(0.5)
    budget.ready_at(100.0 * NS)
    budget.spend((0.5 * BURST_S + 0.1) / BIT_COST_S, 0)
    assert budget.ready_at(100.0 * NS) == pytest.approx(100.2 * NS)


def test_whoever_shares_the_load_has_a_smaller_bucket() -> None:
    budget = SearchBudget(0.5)
    budget.set_load(0.05, 0.0)
    budget.spend((0.05 * BURST_S + 0.05) / BIT_COST_S, 0)
    assert budget.ready_at(0.0) == pytest.approx(1.0 * NS)


def clutter(parameters: Parameters, monkeypatch: pytest.MonkeyPatch, tracks: int, seconds: float) -> float:
    """Return the nominal computing time that the slots spend on blobs of noise (s)."""
    spent = [0.0]
    spend = SearchBudget.spend

    def counted(self: SearchBudget, bits: float, events: int) -> None:
        spent[0] += BIT_COST_S * bits + EVENT_COST_S * events
        spend(self, bits, events)

    monkeypatch.setattr(SearchBudget, 'spend', counted)
    slots = CandidateSlots(parameters, make_demodulator)
    seen = {k: Track(k, 10.0 * k, 10.0, 0, 4.0, 1.0, 0, 0) for k in range(tracks)}
    events = {k: noise(20_000.0, seconds, seed=k) for k in seen}
    nothing = np.empty(0, np.int64), np.empty(0, np.int8)
    for t_ns in range(0, round(seconds * NS), 10_000_000):
        slots.assign(seen, t_ns, lambda _: nothing)
        routed = []
        for k, (times, polarity) in events.items():
            part = slice(*np.searchsorted(times, (t_ns, t_ns + 10_000_000)))
            routed.append(Routed(k, times[part], polarity[part]))
        assert slots.demodulate(routed, t_ns + 10_000_000) == []
    return spent[0]


@pytest.mark.parametrize('tracks', [1, 8])
def test_many_candidates_spend_no_more_than_one(tracks: int, monkeypatch: pytest.MonkeyPatch) -> None:
    parameters, seconds = Parameters(search_load=0.05), 3.0
    spent = clutter(parameters, monkeypatch, tracks, seconds)
    turns = 2  # each begins with a full bucket, and may go into debt by a look or two
    assert 0.05 < spent < 0.05 * (seconds + turns * BURST_S) + 2 * 2 * turns * tracks * 0.025
    assert clutter(Parameters(search_load=100.0), monkeypatch, tracks, seconds) > 2.0 * spent
