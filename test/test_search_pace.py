"""What candidates may spend on looking for their bit rates."""

import numpy as np
import pytest

from beacon_comm.core.candidates import CandidateSlots
from beacon_comm.core.demodulator import make_demodulator
from beacon_comm.core.parameters import Parameters
from beacon_comm.core.routing import Routed, RoutedEvents
from beacon_comm.core.search_pace import BIT_COST_S, BURST_S, EVENT_COST_S, WORK_LOAD, SearchPace
from beacon_comm.core.tracks import Track
from beacon_comm.simulation.led import noise

NS = 1_000_000_000


def bits(cost_s: float) -> float:
    return cost_s / BIT_COST_S


def test_a_small_look_is_done_at_once_and_a_large_one_a_little_later() -> None:
    pace = SearchPace(0.5)
    pace.begin(1.0 * NS, bits(BURST_S), 0)
    assert pace.done_at == pace.ready_at == 1.0 * NS
    pace.begin(1.0 * NS, bits(0.06), int(0.04 / EVENT_COST_S))
    assert pace.done_at == pace.ready_at == pytest.approx(1.2 * NS)
    assert [pace.done_by(t * NS) for t in (0.5, 1.0, 1.05, 1.2, 9.0)] == pytest.approx([0.0, 0.0, 0.25, 1.0, 1.0], abs=1e-6)
    assert pace.when(0.25) == pytest.approx(1.05 * NS)
    pace.begin(9.0 * NS, bits(BURST_S + 0.1), 0)  # the bucket holds no more than that
    assert pace.done_at == pytest.approx(9.2 * NS)


def test_a_look_counts_before_its_debt_is_paid_and_the_next_one_waits_for_that() -> None:
    pace = SearchPace(0.05)
    pace.begin(1.0 * NS, bits(BURST_S + 0.1), 0)
    assert pace.done_at == pytest.approx((1.0 + 0.1 / WORK_LOAD) * NS)
    assert pace.ready_at == pytest.approx(3.0 * NS)
    pace.set_load(0.5, 2.0 * NS)  # half of it is left
    assert pace.done_at == pytest.approx((1.0 + 0.1 / WORK_LOAD) * NS)
    assert pace.ready_at == pytest.approx(2.1 * NS)


def test_nothing_is_looked_at_before_the_load_is_given() -> None:
    pace = SearchPace(0.5)
    pace.set_load(0.1, 3.0 * NS)
    assert pace.ready_at == 3.0 * NS
    pace.begin(pace.ready_at, bits(BURST_S + 0.1), 0)
    assert pace.ready_at == pytest.approx(4.0 * NS)


def clutter(parameters: Parameters, monkeypatch: pytest.MonkeyPatch, tracks: int, seconds: float) -> float:
    """Return the nominal computing time that the slots spend on blobs of noise (s)."""
    spent = [0.0]
    begin = SearchPace.begin

    def counted(self: SearchPace, t: float, bits: float, events: int) -> None:
        spent[0] += BIT_COST_S * bits + EVENT_COST_S * events
        begin(self, t, bits, events)

    monkeypatch.setattr(SearchPace, 'begin', counted)
    slots = CandidateSlots(parameters, make_demodulator)
    seen = {k: Track(k, 10.0 * k, 10.0, 0, 4.0, 1.0, 0, 0) for k in range(tracks)}
    events = {k: noise(20_000.0, seconds, seed=k) for k in seen}
    nothing = np.empty(0, np.int64), np.empty(0, np.int8)
    for t_ns in range(0, round(seconds * NS), 10_000_000):
        slots.assign(seen, t_ns, lambda _: nothing)
        routed = {}
        for k, (times, polarity) in events.items():
            part = slice(*np.searchsorted(times, (t_ns, t_ns + 10_000_000)))
            routed[k] = Routed(times[part], polarity[part])
        assert slots.demodulate(RoutedEvents.of(routed), t_ns + 10_000_000) == []
    return spent[0]


@pytest.mark.parametrize('tracks', [1, 8])
def test_many_candidates_spend_no_more_than_one(tracks: int, monkeypatch: pytest.MonkeyPatch) -> None:
    parameters, seconds = Parameters(search_load=0.05), 3.0
    spent = clutter(parameters, monkeypatch, tracks, seconds)
    left = 2 * tracks * (BURST_S + 0.025)  # of each kind of search a look that has begun
    assert 0.05 < spent < 0.05 * seconds + left
    assert clutter(Parameters(search_load=100.0), monkeypatch, tracks, seconds) > 2.0 * spent
