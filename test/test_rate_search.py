"""When and where rates are looked for, and which periods a blind search names."""

import numpy as np
import pytest
from line_events import text_bits
from sequence_lines import NS, beacon_events

from beacon_comm.core.framing import CharacterFrame
from beacon_comm.core.parameters import Parameters
from beacon_comm.core.rate_search import (
    BLIND_DEMANDS,
    BLIND_OCTAVES,
    LISTED_DEMANDS,
    LISTED_SPREAD,
    NAMED_SPREAD,
    PERIOD_STEP,
    SHORT_WINDOW,
    ListedSearch,
    OctaveSearch,
    make_searches,
    periods_around,
)

TEXT = "Rough winds do shake the darling buds of May,\nAnd summer's lease"
FRAME = CharacterFrame()
CHARACTER = 11e6  # of a bit rate of 1000 bps (ns)


def octave_of(bit_rate_bps):
    """Return the search of the octave of a rate."""
    return OctaveSearch(max(slowest for slowest in BLIND_OCTAVES if slowest <= bit_rate_bps), FRAME)


def window_of(text, bit_rate_bps, gap_bits=0, characters=25, seed=0):
    t_ns, polarity = beacon_events(text_bits(text, gap_bits=gap_bits)[4:], bit_rate_bps, lead_s=0.0, tail_s=0.0, seed=seed)
    seen = t_ns < t_ns[0] + characters * 11 * NS / bit_rate_bps
    return t_ns[seen].astype(np.float64), polarity[seen]


# --- which rates --------------------------------------------------------------------------------------------------


def test_the_parameters_say_what_is_looked_for():
    listed = make_searches(Parameters(bit_rates=(504.0, 3125.0, 504.0), rate_search='listed'), FRAME)
    assert [type(search) for search in listed] == [ListedSearch] * 2  # each once
    assert [search.period for search in listed] == [NS / 504.0, NS / 3125.0]
    assert {search.demands for search in listed} == {LISTED_DEMANDS}
    blind = make_searches(Parameters(bit_rates=(504.0,), rate_search='blind'), FRAME)
    assert [type(search) for search in blind] == [OctaveSearch] * len(BLIND_OCTAVES)
    assert {search.demands for search in blind} == {BLIND_DEMANDS}
    both = make_searches(Parameters(bit_rates=(504.0,), rate_search='both'), FRAME)
    assert [type(search) for search in both] == [ListedSearch] + [OctaveSearch] * len(BLIND_OCTAVES)


def test_the_octaves_leave_no_rate_out():
    assert list(BLIND_OCTAVES) == sorted(BLIND_OCTAVES, reverse=True)
    assert BLIND_OCTAVES[-1] == 100.0 and 2.0 * BLIND_OCTAVES[0] >= 10_000.0
    assert all(slower * 2.0 >= faster for faster, slower in zip(BLIND_OCTAVES[:-1], BLIND_OCTAVES[1:], strict=True))


# --- which periods ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize('bits', [55, 275, 1100])
def test_periods_lie_close_enough_for_the_window(bits):
    periods = periods_around(1e6, 0.025, bits)
    assert periods[0] == pytest.approx(0.975e6) and periods[-1] == pytest.approx(1.025e6)
    assert len(periods) % 2 == 1 and periods[len(periods) // 2] == 1e6
    assert np.diff(periods).max() * bits <= 1.0001 * PERIOD_STEP * 1e6


def test_a_listed_rate_is_tried_as_it_is_and_around():
    tried = np.concatenate(list(ListedSearch(1000.0, FRAME).periods(*window_of(TEXT, 1000.0))))
    assert np.abs(tried - 1e6).min() == 0.0
    assert tried.min() <= 1e6 * (1.0 - LISTED_SPREAD) and tried.max() >= 1e6 * (1.0 + LISTED_SPREAD)


@pytest.mark.parametrize('bit_rate_bps', [100.0, 130.0, 240.0, 504.0, 1000.0, 2300.0, 3125.0, 4800.0, 5200.0, 8000.0])
def test_a_blind_search_names_the_true_period(bit_rate_bps):
    for seed in range(3):
        groups = list(octave_of(bit_rate_bps).periods(*window_of(TEXT, bit_rate_bps, seed=seed)))
        off = [np.abs(periods * bit_rate_bps / NS - 1.0).min() for periods in groups]
        assert min(off) < 0.1 * NAMED_SPREAD
        centres = [periods[len(periods) // 2] for periods in groups]
        assert len(groups) <= 6  # each of them costs
        assert all(abs(a / b - 1.0) > NAMED_SPREAD for k, a in enumerate(centres) for b in centres[:k])


@pytest.mark.parametrize('bit_rate_bps', [250.0, 1000.0, 3125.0])
@pytest.mark.parametrize('gap_bits', [3, 10, 30])
def test_a_blind_search_names_the_period_of_characters_that_stand_alone(bit_rate_bps, gap_bits):
    groups = octave_of(bit_rate_bps).periods(*window_of(TEXT, bit_rate_bps, gap_bits))
    assert min(np.abs(periods * bit_rate_bps / NS - 1.0).min() for periods in groups) < NAMED_SPREAD


def test_another_octave_does_not_name_the_period():
    t, polarity = window_of(TEXT, 1000.0)
    for slowest in BLIND_OCTAVES:
        tried = np.concatenate([[0.0], *OctaveSearch(slowest, FRAME).periods(t, polarity)])[1:]
        assert (tried > 0.9 * NS / (2.0 * slowest)).all() and (tried < 1.1 * NS / slowest).all()


@pytest.mark.parametrize('polarity', [1, -1])
def test_one_event_and_one_polarity_are_borne(polarity):
    for t in (np.zeros(1), np.zeros(50), np.arange(0.0, 300e6, 1e5)):
        for slowest in BLIND_OCTAVES:
            for periods in OctaveSearch(slowest, FRAME).periods(t, np.full(len(t), polarity, np.int8)):
                assert np.isfinite(periods).all() and (periods > 0.0).all()


# --- when ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize('search', [ListedSearch(1000.0, FRAME), OctaveSearch(1000.0, FRAME)])
def test_attempts_follow_one_another_on_a_grid(search):
    search.restart(7e6)
    dues = []
    for _ in range(40):
        dues.append(search.due)
        search.failed()
    assert (np.diff(dues) > 0.0).all()
    assert np.diff(dues[20:]).min() > np.diff(dues[:5]).min()  # rarer
    assert (dues[0] - 7e6) % CHARACTER == 0.0 and dues[0] - 7e6 >= search.demands.needed * CHARACTER
    assert search.exhausted
    search.restart(1e9)
    assert not search.exhausted and search.due - 1e9 == pytest.approx(dues[0] - 7e6)


def test_attempts_never_leave_more_out_than_can_be_read_back():
    # A beacon that begins after an hour of something else is found before its first characters are forgotten.
    search = ListedSearch(1000.0, FRAME)
    due = search.due
    while due < 3600 * NS:
        search.failed()
        assert search.due - due <= 60 * CHARACTER
        due = search.due


def test_a_window_holds_what_is_new_and_nothing_before_the_first():
    search = ListedSearch(1000.0, FRAME)
    t = np.arange(0.0, 5e9, 1e5)
    for _ in range(15):
        now = search.due
        stop = int(np.searchsorted(t, now))
        window = search.window(t, now, 0, stop)
        assert window.stop == stop
        assert SHORT_WINDOW * CHARACTER * 0.5 <= now - t[window.start] <= 90.01 * CHARACTER
        assert search.window(t, now, stop - 10, stop) == slice(stop - 10, stop)
        search.failed()


def test_no_window_without_events_of_late():
    search = ListedSearch(1000.0, FRAME)
    t = np.arange(0.0, 10e6, 1e5)
    now = search.due
    assert search.window(t, now, 0, len(t)) is not None  # 5 characters: still
    assert search.window(t, 10.0 * now, 0, len(t)) is None
    assert search.window(t, now, len(t), len(t)) is None
    assert search.window(t[:0], now, 0, 0) is None


def test_a_search_has_had_its_chance_after_its_first_attempt():
    search = OctaveSearch(1000.0, FRAME)
    search.restart(5e6)
    assert not search.had_a_chance(search.due)
    assert search.had_a_chance(search.due + 1.01 * CHARACTER)
