"""Waveforms made harder to read: every stress does what it says, and beacon_evaluate --stress measures with them."""

import json
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from beacon_comm.cli import stress as stress_command
from beacon_comm.cli.evaluate import main
from beacon_comm.core.character import Character, Status
from beacon_comm.core.errors import ParameterError, RecordingError
from beacon_comm.core.framing import CharacterFrame
from beacon_comm.core.parameters import Parameters
from beacon_comm.evaluation.receivers import declared_receivers
from beacon_comm.evaluation.scoring import not_found, score_at
from beacon_comm.evaluation.stress_report import StressCount, StressedWaveform, StressResults, markdown, stress_figure
from beacon_comm.evaluation.truth import SONNET18
from beacon_comm.simulation.led import simulate_text
from beacon_comm.simulation.stress import (
    clock_warp,
    drift_warp,
    from_another_time,
    jitter_warp,
    looped,
    thinned,
    with_background,
    with_clock,
    with_drifting_clock,
    with_fading,
    with_gaps,
    with_jitter,
    with_leak,
)

TEXT = 'A beacon of one line. '
SECOND = 1_000_000_000
BIT_RATE_BPS = 500.0
THRESHOLD = Parameters(receiver='threshold')
BIT_NS = 2_000_000


def steady(count: int = 10_000, duration_s: float = 2.0, begin_ns: int = 5 * SECOND):
    """Return evenly spaced events, one in four OFF."""
    t_ns = begin_ns + np.linspace(0, duration_s * 1e6, count).astype(np.int64) * 1000
    return t_ns, np.where(np.arange(count) % 4 == 0, -1, 1).astype(np.int8)


OTHER = simulate_text('b', 3125.0, seed=4)
EVERY_STRESS = {
    'thinned': lambda t, p, seed: thinned(t, p, 0.3, seed),
    'clock': lambda t, p, seed: with_clock(t, p, 1.02),
    'drift': lambda t, p, seed: with_drifting_clock(t, p, 0.02),
    'jitter': lambda t, p, seed: with_jitter(t, p, BIT_RATE_BPS, 0.2, seed=seed),
    'background': lambda t, p, seed: with_background(t, p, 1.0, seed),
    'gaps': lambda t, p, seed: with_gaps(t, p, BIT_RATE_BPS, 5.0, 50.0, seed)[:2],
    'fading': lambda t, p, seed: with_fading(t, p, 10.0, seed=seed),
    'leak': lambda t, p, seed: with_leak(t, p, *OTHER, 0.2, seed),
}
WITHOUT_CHANCE = {'clock', 'drift'}


@pytest.mark.parametrize('name', EVERY_STRESS)
def test_events_stay_events(name) -> None:
    """In order, whole microseconds, the right types; the same for the same seed, and the input is left alone."""
    t_ns, polarity = steady()
    before = t_ns.copy(), polarity.copy()
    made_ns, made = EVERY_STRESS[name](t_ns, polarity, 1)
    assert made_ns.dtype == np.int64
    assert made.dtype == np.int8
    assert len(made_ns) == len(made)
    assert np.all(np.diff(made_ns) >= 0)
    assert np.all(made_ns % 1000 == 0)
    assert set(np.unique(made)) == {-1, 1}
    again_ns, again = EVERY_STRESS[name](t_ns, polarity, 1)
    assert np.array_equal(made_ns, again_ns)
    assert np.array_equal(made, again)
    others_ns, _ = EVERY_STRESS[name](t_ns, polarity, 2)
    assert np.array_equal(made_ns, others_ns) == (name in WITHOUT_CHANCE)
    assert np.array_equal(t_ns, before[0])
    assert np.array_equal(polarity, before[1])


@pytest.mark.parametrize('name', EVERY_STRESS)
def test_no_events_are_no_trouble(name) -> None:
    t_ns, polarity = EVERY_STRESS[name](np.empty(0, np.int64), np.empty(0, np.int8), 1)
    assert len(t_ns) == len(polarity) == 0


def test_no_stress_changes_nothing() -> None:
    t_ns, polarity = steady()
    for made_ns, made in (
        thinned(t_ns, polarity, 1.0),
        with_clock(t_ns, polarity, 1.0),
        with_drifting_clock(t_ns, polarity, 0.0),
        with_jitter(t_ns, polarity, BIT_RATE_BPS, 0.0),
        with_background(t_ns, polarity, 0.0),
        with_gaps(t_ns, polarity, BIT_RATE_BPS, 0.0, 50.0)[:2],
        with_fading(t_ns, polarity, 1.0),
        with_leak(t_ns, polarity, *OTHER, 0.0),
    ):
        assert np.array_equal(made_ns, t_ns)
        assert np.array_equal(made, polarity)


def test_thinning_keeps_a_share_of_either_polarity_everywhere() -> None:
    t_ns, polarity = steady()
    made_ns, made = thinned(t_ns, polarity, 0.25, seed=3)
    assert len(made_ns) == pytest.approx(2500, abs=150)
    assert np.isin(made_ns, t_ns).all()
    assert np.mean(made < 0) == pytest.approx(0.25, abs=0.03)
    assert np.sum(made_ns < t_ns[5000]) == pytest.approx(1250, abs=110)


def test_a_fast_clock_sends_its_bits_in_less_time() -> None:
    t_ns, polarity = steady()
    made_ns, _ = with_clock(t_ns, polarity, 1.02)
    assert made_ns[0] == t_ns[0]
    assert made_ns[-1] - made_ns[0] == pytest.approx(2 * SECOND / 1.02, abs=2000)


def test_a_drifting_clock_swings_within_its_time_and_comes_back() -> None:
    t_ns, polarity = steady(20_000, 4.0)
    made_ns, _ = with_drifting_clock(t_ns, polarity, 0.02, within_s=0.5)
    rate = 1000 * np.diff(t_ns[::100]) / np.diff(made_ns[::100]) / 1000
    assert rate.max() == pytest.approx(1.02, abs=1e-3)
    assert rate.min() == pytest.approx(0.98, abs=1e-3)
    # 50 pieces of 20 ms a period of 1 s: fastest at a quarter, slowest at three quarters.
    assert np.argmax(rate[:50]) == pytest.approx(12, abs=2)
    assert np.argmin(rate[:50]) == pytest.approx(37, abs=2)
    assert made_ns[-1] - made_ns[0] == pytest.approx(4 * SECOND, rel=1e-3)


@given(st.floats(-0.02, 0.02), st.floats(0.0, 0.1), st.floats(0.0, 0.2))
@settings(max_examples=30, deadline=None)
def test_warps_lead_back(off: float, swing: float, jitter: float) -> None:
    t_ns, _ = steady(500)
    for warp, allowed_ns in (
        (clock_warp(t_ns, 1.0 + off), 2000),
        (drift_warp(t_ns, swing), 2000),
        # Where an edge caught up with the bit before it, what was squeezed is found again within its part of the bit.
        (jitter_warp(t_ns, BIT_RATE_BPS, jitter, seed=1), 2 * BIT_NS),
    ):
        assert np.abs(warp.undo(warp.apply(t_ns)) - t_ns).max() <= allowed_ns


def test_jitter_moves_each_edge_with_its_events_by_its_own_amount() -> None:
    edges_ns = SECOND + np.arange(1000) * BIT_NS
    burst_ns = np.array([0, 100_000, 300_000])
    t_ns = (edges_ns[:, None] + burst_ns).ravel()
    polarity = np.ones(len(t_ns), np.int8)
    made_ns, _ = with_jitter(t_ns, polarity, BIT_RATE_BPS, 0.1, start_ns=SECOND, seed=5)
    shifts = (made_ns - t_ns).reshape(-1, 3)
    assert np.std(shifts[:, 0]) == pytest.approx(0.1 * BIT_NS, rel=0.1)
    assert abs(np.mean(shifts[:, 0])) < 0.015 * BIT_NS
    assert abs(np.corrcoef(shifts[:-1, 0], shifts[1:, 0])[0, 1]) < 0.1
    assert np.mean(np.ptp(shifts, axis=1) <= 1000) > 0.99  # a burst moves as one


def test_jitter_counts_bits_anew_from_every_start() -> None:
    starts = np.array([SECOND, 2 * SECOND + BIT_NS // 3])
    edges_ns = np.concatenate([start + np.arange(200) * BIT_NS for start in starts])
    warp = jitter_warp(edges_ns, BIT_RATE_BPS, 0.1, starts, seed=5)
    heads, ends = warp.apply(edges_ns), warp.apply(edges_ns + int(0.35 * BIT_NS))
    assert np.mean(np.abs(ends - heads - int(0.35 * BIT_NS)) <= 1000) > 0.99


def test_background_is_as_many_events_as_asked_for_evenly() -> None:
    t_ns, polarity = steady()
    made_ns, made = with_background(t_ns, polarity, 0.5, seed=2)
    assert len(made_ns) == pytest.approx(15_000, abs=300)
    assert np.mean(made > 0) == pytest.approx(0.75, abs=0.02)
    assert np.sum(made_ns < t_ns[5000]) == pytest.approx(7500, abs=250)
    assert t_ns[0] <= made_ns[0]
    assert made_ns[-1] <= t_ns[-1]
    _, white = with_background(t_ns, polarity, 1.0, seed=2, on_share=0.0)
    assert np.mean(white > 0) == pytest.approx(0.375, abs=0.02)


def test_gaps_are_empty_and_the_rest_is_untouched() -> None:
    t_ns, polarity = steady(duration_s=1.99)
    made_ns, made, gaps_ns = with_gaps(t_ns, polarity, BIT_RATE_BPS, 10.0, 100.0, seed=7)
    assert gaps_ns.shape == (9, 2)  # the last hundred bits are not whole
    assert np.all(np.abs(np.diff(gaps_ns, axis=1) - 10 * BIT_NS) <= 1)
    assert np.all(gaps_ns[1:, 0] >= gaps_ns[:-1, 1])
    inside = np.zeros(len(t_ns), bool)
    for begin_ns, end_ns in gaps_ns:
        assert not np.any((made_ns >= begin_ns) & (made_ns < end_ns))
        inside |= (t_ns >= begin_ns) & (t_ns < end_ns)
    assert inside.any()
    assert np.array_equal(made_ns, t_ns[~inside])
    assert np.array_equal(made, polarity[~inside])


def test_fading_swings_from_all_to_a_tenth_within_a_second_and_back() -> None:
    t_ns, polarity = steady(40_000, 4.0)
    made_ns, _ = with_fading(t_ns, polarity, 10.0, within_s=1.0, seed=1)
    kept = np.histogram(made_ns, np.arange(41) * SECOND // 10 + t_ns[0])[0] / 1000
    assert np.mean(kept[[0, 19, 20, 39]]) > 0.95
    assert np.mean(kept[[9, 10, 29, 30]]) == pytest.approx(0.1, abs=0.03)
    assert np.all(np.diff(kept[:10]) < 0.05)


def test_a_leak_is_a_share_of_the_others_events_repeated_to_the_end() -> None:
    t_ns, polarity = steady(100)
    other_ns = 70 * SECOND + np.arange(0, SECOND // 2, 100_000)
    made_ns, made = with_leak(t_ns, polarity, other_ns, np.full(len(other_ns), -1, np.int8), 0.2, seed=6)
    more = len(made_ns) - len(t_ns)
    assert more == pytest.approx(0.2 * 4 * len(other_ns), abs=250)
    assert np.sum(made > 0) == np.sum(polarity > 0)
    assert np.isin(t_ns, made_ns).all()
    assert np.ptp(np.histogram(made_ns, 4)[0]) < 0.2 * more
    assert with_leak(t_ns, polarity, other_ns[:0], polarity[:0], 0.2)[0] is not None


def test_another_time_holds_the_same_events_in_another_order() -> None:
    t_ns, polarity = steady(1000)
    made_ns, made = from_another_time(t_ns, polarity, 0.25)
    assert made_ns[0] == t_ns[0]
    assert np.all(np.diff(made_ns) > 0)
    assert np.array_equal(made, np.roll(polarity, -250))
    looped_ns, _ = looped(t_ns, polarity, 0, 5 * SECOND)
    assert looped_ns[0] == 0
    assert looped_ns[-1] <= 5 * SECOND
    assert np.all(np.diff(looped_ns) > 0)


@pytest.mark.parametrize(
    'wrong',
    [
        lambda t, p: thinned(t, p, 1.2),
        lambda t, p: thinned(t, p, float('nan')),
        lambda t, p: with_clock(t, p, 0.0),
        lambda t, p: with_drifting_clock(t, p, 0.6),
        lambda t, p: with_drifting_clock(t, p, 0.1, 0.0),
        lambda t, p: with_jitter(t, p, 0.0, 0.1),
        lambda t, p: with_jitter(t, p, 500.0, -0.1),
        lambda t, p: with_background(t, p, -1.0),
        lambda t, p: with_background(t, p, 1.0, on_share=2.0),
        lambda t, p: with_gaps(t, p, 500.0, 60.0, 50.0),
        lambda t, p: with_fading(t, p, 0.5),
        lambda t, p: with_leak(t, p, t, p, 1.5),
    ],
)
def test_impossible_stresses_are_refused(wrong) -> None:
    with pytest.raises(ParameterError, match='must lie in'):
        wrong(*steady(10))


# Scores at known times


def test_a_sending_at_a_known_time_counts_in_full_whatever_was_decoded() -> None:
    """Nothing decoded: all missing; a character out of time: missing and inserted; one of another code: wrong."""
    frame = CharacterFrame()
    sent = replace(not_found('abcd'), start_ns=SECOND, bit_rate_bps=BIT_RATE_BPS)
    (nothing,) = score_at([], 'abcd', [sent])
    assert (nothing.characters, nothing.wrong, nothing.missing, nothing.inserted) == (4, 4, 4, 0)

    def read(k: float, code: str) -> Character:
        t_ns = round(SECOND + k * frame.length * BIT_NS)
        return Character(t_ns, ord(code), Status.OK, 1.0, frame.frame_of(ord(code)), BIT_RATE_BPS)

    (some,) = score_at([read(0, 'a'), read(1, 'x'), read(2.5, 'c'), read(3, 'd'), read(9, 'q')], 'abcd', [sent])
    assert (some.wrong, some.missing, some.inserted, some.wrong_ok) == (3, 1, 1, 1)
    assert [error.k for error in some.errors] == [1, 2]


# The command


@pytest.fixture(scope='module')
def waveform() -> stress_command.Waveform:
    return stress_command.simulated(TEXT * 3, 3125.0, Parameters())


@pytest.mark.parametrize('stress', stress_command.STRESSES, ids=lambda stress: stress.name)
def test_every_stress_starts_from_none_and_is_counted(stress, waveform) -> None:
    """At its mildest a stress changes nothing; at its hardest every character still counts."""
    assert stress.none in stress.severities
    assert stress.asked in stress.severities
    other = simulate_text(TEXT, 504.0)
    none = stress_command.apply(stress.name, stress.none, waveform, other)
    assert np.array_equal(none.t_ns, waveform.t_ns)
    assert np.array_equal(none.polarity, waveform.polarity)
    severity = max(stress.severities, key=lambda severity: abs(severity - stress.none))
    made = stress_command.apply(stress.name, severity, waveform, other)
    assert not np.array_equal(made.t_ns, waveform.t_ns)
    count = stress_command.count_of(stress, severity, waveform, made, 'threshold', THRESHOLD, TEXT * 3)
    assert count.characters == len(TEXT) * 3
    assert count.wrong >= count.missing + count.inserted
    assert 0 <= count.missing <= count.characters
    assert count.outside >= 0
    assert (count.untouched is not None) == (stress.name == 'gaps')
    if count.untouched is not None and count.untouched_wrong is not None:
        assert 0 <= count.untouched_wrong <= count.untouched < count.characters


@pytest.mark.parametrize('name', ['clock', 'drift'])
def test_what_was_sent_is_looked_up_on_the_sender_s_clock(name, waveform) -> None:
    """2 % off over a text is many characters: without the way back hardly any would be in its place."""
    (stress,) = stress_command.chosen_stresses([name])
    made = stress_command.apply(name, 2.0, waveform, OTHER)
    count = stress_command.count_of(stress, 2.0, waveform, made, 'threshold', THRESHOLD, TEXT * 3)
    assert count.wrong < 0.2 * count.characters
    lost = replace(made, warp=None)
    assert stress_command.count_of(stress, 2.0, waveform, lost, 'threshold', THRESHOLD, TEXT * 3).wrong > count.wrong


def test_the_recordings_score_as_without_stress(data_folder) -> None:
    """What is counted at no severity is what beacon_evaluate counts."""
    path = str(data_folder / '3125hz_30m.mat')
    waveform = stress_command.recorded(path, SONNET18, Parameters())
    (stress,) = stress_command.chosen_stresses(['thinned'])
    made = stress_command.apply('thinned', 100.0, waveform, OTHER)
    count = stress_command.count_of(stress, 100.0, waveform, made, 'threshold', THRESHOLD, SONNET18)
    assert count.wrong == sum(transmission.wrong for transmission in waveform.sent)
    assert count.characters == sum(transmission.characters for transmission in waveform.sent)


def test_the_command_writes_page_figures_and_data(capsys, tmp_path, monkeypatch) -> None:
    monkeypatch.setenv('BEACON_COMM_DATA', str(tmp_path / 'nothing here'))
    folder = tmp_path / 'out'
    arguments = ['--stress', str(folder), '--stress-only', 'thinned,gaps', '--stress-simulated', '3125']
    assert main([*arguments, '--truth', TEXT, '--bit-rate', '504,3125']) == 0
    captured = capsys.readouterr()
    assert 'simulated waveforms only' in captured.err
    assert 'gaps: 2 of 2' in captured.err
    receivers = list(declared_receivers())
    content = json.loads((folder / 'stress.json').read_text())
    assert sorted(content['receivers']) == sorted(receivers)
    severities = sum(len(stress['severities']) for stress in content['stresses'])
    assert len(content['counts']) == severities * len(receivers)
    page = (folder / 'stress.md').read_text()
    assert '--stress-only thinned,gaps' in page
    assert str(tmp_path) not in page
    for name in ('thinned', 'gaps'):
        assert f'figures/stress_{name}.png' in page
        assert (folder / 'figures' / f'stress_{name}.png').read_bytes().startswith(b'\x89PNG')
    assert 'no gap touched' in page
    summary = captured.out.splitlines()
    assert summary[0].startswith('| Stress | Waveform | threshold |')
    assert summary[2].startswith('| none | simulated 3125 bps |')


@pytest.mark.parametrize(
    ('arguments', 'complaint'),
    [
        ([], 'required: RECORDING'),
        (['--stress', 'DIR', '--stress-only', 'rain'], 'must be some of thinned, clock'),
        (['--stress', 'DIR', '--stress-simulated', '5'], 'must be bit rates'),
        (['--stress', 'DIR', '--stress-simulated', 'none'], 'nothing simulated'),
        (['--stress', 'DIR', '--json', 'x.json'], 'do not go together'),
        (['--stress', 'DIR', '--start', '2'], 'do not go together'),
        (['--stress', 'DIR', 'a_bag'], '.mat files of one beacon'),
        (['--stress', 'DIR', '--truth', 'smørrebrød'], 'fit'),
    ],
)
def test_wrong_arguments_are_one_line(capsys, tmp_path, monkeypatch, arguments, complaint) -> None:
    monkeypatch.setenv('BEACON_COMM_DATA', str(tmp_path / 'nothing here'))
    try:
        code = main([str(tmp_path) if argument == 'DIR' else argument for argument in arguments])
    except SystemExit as exit_:
        code = exit_.code
    assert code == 2
    last = capsys.readouterr().err.strip().splitlines()[-1]
    assert last.startswith('beacon_evaluate: ')
    assert complaint in last


def test_without_matplotlib_the_command_says_so_before_it_measures(monkeypatch) -> None:
    from beacon_comm.evaluation.stress_report import require_matplotlib

    monkeypatch.setitem(__import__('sys').modules, 'matplotlib.figure', None)
    with pytest.raises(RecordingError, match='need matplotlib'):
        require_matplotlib()


def test_several_receivers_stand_beside_one_another() -> None:
    stress = stress_command.STRESSES[0]
    names = ('threshold', 'another', 'a third')
    counts = tuple(
        StressCount(stress.name, 'w', name, severity, 10, 100, wrong, 0, 0, 0, 0, 0)
        for name, wrong in zip(names, (12, 0, 130), strict=True)
        for severity in stress.severities
    )
    results = StressResults((stress,), (StressedWaveform('w', 10, 504.0, (504.0,), 1, 100),), names, counts)
    page = markdown(results, 'a command')
    assert '| Stress | Waveform | threshold | another | a third |' in page
    assert '12.0 % (12 of 100) | 0.0 % (0 of 100) | 130 % (130 of 100)' in page
    panel, legend = stress_figure(results, stress).axes
    assert [text.get_text() for text in legend.get_legend().get_texts()] == list(names)
    assert [max(line.get_ydata()) for line in panel.get_lines()] == [0.12, 0.0, 1.0]
