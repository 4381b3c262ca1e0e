"""Scores against a scene's truth, on tracks and characters that are made up, so that every number is known."""

import math
from dataclasses import dataclass, field, replace

import numpy as np
import pytest
from numpy.typing import NDArray

from beacon_comm.core.candidates import BeaconState
from beacon_comm.core.character import Character, Status
from beacon_comm.core.framing import CharacterFrame
from beacon_comm.evaluation.report import SUMMARY_COLUMNS, summary_rows
from beacon_comm.evaluation.result import BeaconResult, PathPoint, RecordingResult
from beacon_comm.evaluation.scene_score import SceneScore, score_scene
from beacon_comm.evaluation.scene_truth import Sight, runs_in_sight

FRAME = CharacterFrame()
BIT_RATE_BPS = 1100.0  # a character lasts 10 ms
CHARACTER_NS = 10_000_000
SECOND_NS = 1_000_000_000
SHIFT_NS = 7_000_000_000  # scene time at recording time 0
INSTANTS_NS = np.arange(0, 2 * SECOND_NS, 9_000_000, dtype=np.int64)
TEXT = 'The quick brown fox jumps over it.'


@dataclass
class Path:
    """A beacon on a straight line, hidden for a while; times are scene times."""

    name: str = 'a'
    kind: str = 'simulated'
    text: str | None = TEXT
    bit_rate_bps: float | None = BIT_RATE_BPS
    x_px: float = 100.0
    y_px: float = 100.0
    vx_px_per_s: float = 0.0
    hidden_ns: tuple[int, int] = (0, 0)
    radius: float = 4.0
    characters_ns: NDArray[np.int64] = field(default_factory=lambda: np.empty(0, np.int64))
    sendings_ns: NDArray[np.int64] = field(default_factory=lambda: SHIFT_NS + np.array([100_000_000, 700_000_000]))

    def centre(self, t_ns):
        t = np.asarray(t_ns, np.float64) - SHIFT_NS
        return self.x_px + self.vx_px_per_s * t / SECOND_NS, np.full(np.shape(t_ns), self.y_px)

    def visible(self, t_ns):
        t = np.asarray(t_ns)
        return (t < self.hidden_ns[0]) | (t >= self.hidden_ns[1])

    def radius_px(self, t_ns):
        return np.full(np.shape(t_ns), self.radius)

    def bearing(self, t_ns):
        return np.full(np.shape(t_ns), 0.1), np.full(np.shape(t_ns), -0.2)


def sent(beacon: Path, delay_ns: int = 30_000_000) -> list[tuple[Character, int]]:
    """Return all characters of a beacon, right, each given out ``delay_ns`` after its end."""
    assert beacon.text is not None
    return [
        (
            Character(begin_ns, ord(symbol), Status.OK, 1.0, FRAME.frame_of(ord(symbol)), BIT_RATE_BPS),
            begin_ns + CHARACTER_NS + delay_ns,
        )
        for start in beacon.sendings_ns
        for k, symbol in enumerate(beacon.text)
        for begin_ns in (int(start) - SHIFT_NS + k * CHARACTER_NS,)
    ]


def track(
    beacon: Path, track_id: int = 1, characters=(), confirmed_ns: int | None = 0, off_px=(0.0, 0.0), **point
) -> BeaconResult:
    """Return a track that follows a beacon, so far off it."""
    x, y = beacon.centre(INSTANTS_NS + SHIFT_NS)
    confirmed = np.zeros(len(x), bool) if confirmed_ns is None else confirmed_ns <= INSTANTS_NS
    path = tuple(
        PathPoint(int(t), float(a) + off_px[0], float(b) + off_px[1], 4.0, bool(is_confirmed), **point)
        for t, a, b, is_confirmed in zip(INSTANTS_NS, x, y, confirmed, strict=True)
    )
    return BeaconResult(
        track_id, BeaconState.CONFIRMED, confirmed_ns, BIT_RATE_BPS, None, None, path, tuple(c for c, _ in characters),
        received_ns=tuple(at for _, at in characters), confirmed_seen_ns=confirmed_ns,
    )  # fmt: skip


def scored(tracks, beacons, text=None) -> SceneScore:
    return score_scene(tracks, INSTANTS_NS, beacons, SHIFT_NS, (0, 2 * SECOND_NS), FRAME, text)


def test_all_is_right() -> None:
    beacon = Path()
    score = scored([track(beacon, 5, sent(beacon), 400_000_000, azimuth_rad=0.1, elevation_rad=-0.2)], [beacon])
    (one,) = score.beacons
    assert (one.sent.characters, one.sent.wrong, one.sent.bits) == (2 * len(TEXT), 0, 2 * 11 * len(TEXT))
    assert (one.sent.message_accuracy, one.sent.bit_accuracy) == (1.0, 1.0)
    assert 0.9 < one.sent.message_interval.low < 0.96  # Wilson, 68 of 68
    assert one.tracks == (5,)
    # The first complete character begins at 0.1 s; it ends 10 ms later, and was given out 30 ms after that.
    (lock,) = one.locks
    assert (lock.begin_ns, lock.lock_s, lock.lost) == (100_000_000, pytest.approx(0.04), 0)
    assert one.confirm_s == pytest.approx(0.3)
    assert one.position is not None and (one.position.rms_px, one.position.bearing_rms_rad) == (0.0, 0.0)
    # It is reported once it is confirmed, from 0.4 s of 2 s on.
    missed = np.count_nonzero(INSTANTS_NS < 400_000_000)
    assert (score.confirmed.misses, score.confirmed.objects) == (missed, len(INSTANTS_NS))
    assert score.tracks.mota == 1.0
    assert (score.false_confirmations, score.stray_characters) == ((), 0)
    assert score.mota_interval is None  # four half seconds are too few to tell


def test_wrong_missing_inserted() -> None:
    beacon = Path()
    characters = sent(beacon)
    wrong = replace(characters[3][0], code=ord('!'), frame=FRAME.frame_of(ord('!')))
    extra = replace(characters[6][0], t_ns=characters[6][0].t_ns + CHARACTER_NS // 2)
    characters[3] = (wrong, characters[3][1])
    characters = [*characters[:8], *characters[9:], (extra, extra.t_ns)]
    (one,) = scored([track(beacon, 1, sorted(characters, key=lambda c: c[0].t_ns))], [beacon]).beacons
    count = one.sent
    assert (count.wrong, count.missing, count.inserted, count.wrong_ok) == (3, 1, 1, 1)
    differing = (FRAME.frame_of(ord('!')) ^ FRAME.frame_of(ord(TEXT[3]))).bit_count()
    assert count.wrong_bits == 11 + differing
    assert sorted(np.unique(one.verdicts, return_counts=True)[1].tolist()) == [2, 66]


def test_what_was_hidden_was_not_to_be_read() -> None:
    """Hidden for 100 ms within the first sending: from the 11th character on, whole ones from the 21st on again."""
    beacon = Path(hidden_ns=(SHIFT_NS + 205_000_000, SHIFT_NS + 305_000_000))
    seen = [one for one in sent(beacon) if not 190_000_000 < one[0].t_ns < 330_000_000]
    (one,) = scored([track(beacon, 1, seen)], [beacon]).beacons
    runs = runs_in_sight(beacon, Sight.of(beacon, (0, 2 * SECOND_NS), SHIFT_NS), SHIFT_NS, FRAME)
    assert [(run.first, run.characters) for run in runs] == [(0, 10), (21, len(TEXT) - 21), (0, len(TEXT))]
    assert one.sent.characters == 2 * len(TEXT) - 11
    # Of the characters in sight, those due at 310, 320 and 330 ms were decoded from the third on.
    assert (one.sent.missing, one.locks[1].lost, one.locks[1].begin_ns) == (2, 2, 310_000_000)
    assert one.locks[1].lock_s == pytest.approx(0.06)


def test_what_was_cut_was_not_sent() -> None:
    """The first sending is broken off after 12 characters: the rest of the time the line is idle."""
    whole = Path()
    first, second = whole.sendings_ns
    starts_ns = np.concatenate((first + np.arange(12) * CHARACTER_NS, second + np.arange(len(TEXT)) * CHARACTER_NS))
    beacon = replace(whole, characters_ns=starts_ns)
    seen = sent(whole)[:12] + sent(whole)[len(TEXT) :]
    (one,) = scored([track(beacon, 1, seen)], [beacon]).beacons
    assert (one.sent.characters, one.sent.wrong) == (12 + len(TEXT), 0)


def test_position_lag_and_consistency() -> None:
    beacon = Path(vx_px_per_s=200.0)
    # 1 px behind at 200 px/s: 5 ms late.  Variance 0.5 px² on each axis: NEES = (1 / 0.5) / 2 = 1.
    (one,) = scored([track(beacon, off_px=(-1.0, 0.0), covariance_px2=(0.5, 0.0, 0.5))], [beacon]).beacons
    position = one.position
    assert position is not None
    assert (position.rms_px, position.median_px) == (pytest.approx(1.0), pytest.approx(1.0))
    assert position.lag_s == pytest.approx(0.005)
    assert position.speed_px_per_s == pytest.approx(200.0)
    assert position.nees == pytest.approx(1.0)
    assert position.bearing_rms_rad is None  # the track has none
    (one,) = scored([track(beacon, azimuth_rad=0.1, elevation_rad=-0.19)], [beacon]).beacons
    assert one.position is not None
    assert one.position.bearing_rms_rad == pytest.approx(0.01)
    assert one.position.bearing_nees is None
    # 0.01 rad off in elevation, with a variance of 0.00005 rad²: NEES = (0.0001 / 0.00005) / 2 = 1.
    stated = {'azimuth_rad': 0.1, 'elevation_rad': -0.19, 'covariance_rad2': (1e-6, 0.0, 5e-5)}
    (one,) = scored([track(beacon, **stated)], [beacon]).beacons
    assert one.position is not None and one.position.bearing_nees == pytest.approx(1.0)
    (one,) = scored([track(beacon, azimuth_rad=0.1, elevation_rad=-0.19)], [beacon]).beacons
    assert one.position is not None
    assert (one.position.nees, one.position.lag_s) == (None, pytest.approx(0.0))


def test_a_correlated_covariance_counts_as_such() -> None:
    beacon = Path()
    xx, xy, yy = 2.0, 0.9, 0.7
    error = np.array([1.0, -0.5])
    expected = float(error @ np.linalg.inv([[xx, xy], [xy, yy]]) @ error) / 2.0
    (one,) = scored([track(beacon, off_px=tuple(error), covariance_px2=(xx, xy, yy))], [beacon]).beacons
    assert one.position is not None and one.position.nees == pytest.approx(expected)


def test_a_confirmed_track_on_nothing_is_false() -> None:
    beacon = Path()
    lamp = replace(beacon, x_px=300.0)
    score = scored([track(beacon, 1, sent(beacon)), track(lamp, 2, sent(beacon)[:5])], [beacon])
    assert score.false_confirmations == (2,)
    assert score.stray_characters == 5
    assert score.confirmed.false_positives == len(INSTANTS_NS)
    assert score.beacons[0].sent.wrong == 0


def test_what_a_second_track_reads_once_more_counts_once() -> None:
    """The second track also reads what the first one, begun late, has not."""
    beacon = Path()
    characters = sent(beacon)
    late, twice = characters[4:], characters[:10]
    score = scored([track(beacon, 1, twice, None), track(beacon, 2, late)], [beacon])
    assert (score.beacons[0].sent.wrong, score.double_characters, score.stray_characters) == (0, 6, 0)
    assert len(score.beacons[0].characters) == len(characters)


def test_a_candidate_on_nothing_is_not() -> None:
    beacon = Path()
    score = scored([track(beacon, 1, sent(beacon)), track(replace(beacon, x_px=300.0), 2, (), None)], [beacon])
    assert score.false_confirmations == ()
    assert (score.confirmed.false_positives, score.tracks.false_positives) == (0, len(INSTANTS_NS))


def test_a_reflection_is_neither_asked_for_nor_false() -> None:
    beacon = Path()
    mirror = Path('mirror', 'reflection', None, None, x_px=300.0)
    score = scored([track(beacon, 1, sent(beacon)), track(mirror, 2)], [beacon, mirror])
    assert [one.name for one in score.beacons] == ['a']
    assert (score.false_confirmations, score.on_reflections) == ((), (2,))
    assert (score.confirmed.objects, score.confirmed.false_positives) == (len(INSTANTS_NS), 0)


def test_coasting_behind_what_hides_it_is_no_report() -> None:
    beacon = Path(hidden_ns=(SHIFT_NS + 500_000_000, SHIFT_NS + 600_000_000))
    hidden = np.count_nonzero((INSTANTS_NS >= 500_000_000) & (INSTANTS_NS < 600_000_000))
    whole = track(beacon)
    quiet = replace(
        whole, path=tuple(replace(point, quiet=500_000_000 <= point.t_ns < 600_000_000) for point in whole.path)
    )
    coasting, insisting = scored([quiet], [beacon]), scored([whole], [beacon])
    assert (coasting.confirmed.false_positives, coasting.confirmed.mota) == (0, 1.0)
    assert insisting.confirmed.false_positives == hidden
    assert coasting.confirmed.id_switches == 0


def test_two_tracks_that_change_places() -> None:
    """Their labels are swapped; the characters stay where they were read."""
    left, right = Path('left', x_px=100.0), Path('right', x_px=160.0)
    a, b = track(left, 1, sent(left)), track(right, 2, sent(right))
    half = len(INSTANTS_NS) // 2
    swapped = [
        replace(a, path=a.path[:half] + b.path[half:], characters=a.characters[:30], received_ns=a.received_ns[:30]),
        replace(b, path=b.path[:half] + a.path[half:], characters=b.characters[:30], received_ns=b.received_ns[:30]),
    ]
    score = scored(swapped, [left, right])
    assert (score.confirmed.id_switches, score.confirmed.swaps) == (2, 2)
    assert score.confirmed.mota == pytest.approx(1.0 - 2.0 / (2 * len(INSTANTS_NS)))
    assert score.confirmed.idf1 == pytest.approx(0.5, abs=0.01)
    assert [one.tracks for one in score.beacons] == [(1, 2), (2, 1)]


def test_where_it_is_not_known_when_it_was_sent_that_is_found() -> None:
    """As in a scene of .mat recordings: the truth knows the path only, the text is given."""
    known = Path()
    beacon = replace(known, text=None, bit_rate_bps=None, sendings_ns=np.empty(0, np.int64))
    (one,) = scored([track(known, 1, sent(known))], [beacon], TEXT).beacons
    assert (one.sent.characters, one.sent.wrong) == (2 * len(TEXT), 0)
    assert one.locks[0].begin_ns == pytest.approx(100_000_000, abs=1000)
    (one,) = scored([track(known, 1, sent(known))], [beacon]).beacons
    assert (one.transmissions, one.locks, one.confirm_s) == ((), (), None)
    assert math.isnan(one.sent.message_accuracy)


def test_an_empty_scene() -> None:
    score = scored([], [])
    assert (score.beacons, score.confirmed.mota, score.sent.characters) == ((), None, 0)
    (one,) = scored([], [Path()]).beacons
    assert (one.sent.missing, one.locks[0].lock_s, one.position) == (2 * len(TEXT), None, None)


def test_scenes_are_summed_up_with_intervals_from_one_to_the_next() -> None:
    beacon = Path()
    results = []
    for seed in range(6):
        off = track(beacon, 1, sent(beacon), 100_000_000 * (seed + 1), off_px=(0.1 * seed, 0.0))
        scene = scored([off], [beacon])
        results.append(RecordingResult(f'{seed}', 'sequence', 1, 1, 1.0, 0, 0, (off,), 0, scene=scene))
    (row,) = summary_rows(results)
    cells = dict(zip(SUMMARY_COLUMNS, row, strict=True))
    assert (cells['scenes'], cells['beacons'], cells['characters']) == ('6', '6 of 6', str(6 * 2 * len(TEXT)))
    assert cells['message accuracy'].startswith('1.000 [0.99')
    assert cells['confirmed'].startswith('250 [')  # the mean of 0, 100 … 500 ms
    assert cells['error rms'].startswith('0.29 [')  # of 0, 0.1 … 0.5 px over 1.9, 1.8 … 1.4 s
    assert cells['NEES'] == '-'
    assert summary_rows(results[:1]) == []
    (row,) = summary_rows(results[:2])
    assert '[' not in dict(zip(SUMMARY_COLUMNS, row, strict=True))['MOTA']  # two are too few to tell
