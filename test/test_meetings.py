"""Who is who after a meeting: signatures tell beacons, labels are exchanged, and nothing is where nobody can tell."""

import numpy as np
import pytest
from line_events import text_bits
from sequence_lines import NS, beacon_events

from beacon_comm.core.demodulator import Recognising, ThresholdDemodulator, make_demodulator
from beacon_comm.core.meetings import Meetings
from beacon_comm.core.parameters import Parameters
from beacon_comm.core.tracks import Track

TEXTS = ("Shall I compare thee to a summer's day? " * 3, 'And summers lease hath all too short a date: ' * 3)
RATE_BPS = 1000.0
HOP_NS = 10_000_000
MEETS_NS, APART_NS = 600 * HOP_NS // 10, 620 * HOP_NS // 10
FAR_PX, RADIUS_PX = 40.0, 5.0


def beacon(number, start_ns=0, text=None):
    return beacon_events(text_bits(TEXTS[number] if text is None else text), RATE_BPS, t0_ns=start_ns, lead_s=0.0, seed=number)


def signature_of(events, to_ns):
    demodulator = make_demodulator(Parameters(bit_rates=(RATE_BPS,)))
    stop = int(np.searchsorted(events[0], to_ns))
    demodulator.push(events[0][:stop], events[1][:stop], to_ns)
    assert isinstance(demodulator, Recognising)
    return demodulator.signature()


def between(events, start_ns, stop_ns):
    a, b = np.searchsorted(events[0], [start_ns, stop_ns])
    return events[0][a:b], events[1][a:b]


class Scene:
    """Tracks that meet at MEETS_NS and are apart again at APART_NS, and what each one has the events of."""

    def __init__(self, *beacons):
        self.beacons = beacons
        self.signatures = [signature_of(events, MEETS_NS) for events in beacons]
        self.has = dict(enumerate(beacons, 1))  # by label, after the meeting
        self.quiet = set()
        self.began_ns = dict.fromkeys(self.has, 0)
        self.rates = dict.fromkeys(self.has, RATE_BPS)

    def tracks_at(self, t_ns):
        tracks = {}
        for label in self.has:
            if self.began_ns[label] <= t_ns:
                x_px = 100.0 + (label - 1.5) * (FAR_PX if t_ns < MEETS_NS or t_ns >= APART_NS else 1.0)
                tracks[label] = Track(
                    label, x_px, 100.0, t_ns, RADIUS_PX, 1.0, self.began_ns[label], t_ns,
                    quiet=label in self.quiet and t_ns >= APART_NS, bit_rate_bps=self.rates[label],
                )  # fmt: skip
        return tracks

    def exchanged(self, to_ns=MEETS_NS + 600_000_000):
        meetings, found = Meetings(HOP_NS / NS), []
        for t_ns in range(MEETS_NS - 2 * HOP_NS, to_ns, HOP_NS):
            exchanges = meetings.exchanged(
                self.tracks_at(t_ns),
                lambda label: self.signatures[label - 1],
                lambda label, t_ns=t_ns: between(self.has[label], APART_NS, t_ns),
                t_ns,
            )
            for one, other in exchanges:
                self.has[one], self.has[other] = self.has[other], self.has[one]
            found += exchanges
        return found


@pytest.mark.parametrize('late_ns', [2_300_000, 500_000, 5_300_000])
def test_a_signature_explains_its_own_beacon_best(late_ns):
    one, other = beacon(0), beacon(1, late_ns)
    first, second = signature_of(one, MEETS_NS), signature_of(other, MEETS_NS)
    assert first is not None and second is not None
    span = APART_NS, APART_NS + 50_000_000
    fits = [[signature.explain(*between(events, *span), *span) for events in (one, other)] for signature in (first, second)]
    assert fits[0][0] > 0.8 * fits[0][1] and fits[1][1] > 0.8 * fits[1][0]
    assert first.character_ns == pytest.approx(11 * NS / RATE_BPS, rel=1e-3)
    # To explain changes nothing: the same again.
    assert first.explain(*between(one, *span), *span) == fits[0][0]


def test_a_clock_that_is_not_sure_any_more_says_nothing():
    events = beacon(0)
    signature = signature_of(events, MEETS_NS)
    late = APART_NS + 3600 * NS
    assert signature.explain(events[0] + 3600 * NS, events[1], late, late + 50_000_000) is None


def test_there_is_no_signature_before_the_beacon_is_read():
    assert make_demodulator(Parameters()).signature() is None
    assert not isinstance(ThresholdDemodulator(RATE_BPS, Parameters(bit_rates=(RATE_BPS,))), Recognising)


def test_beacons_that_have_their_own_tracks_keep_their_labels():
    assert Scene(beacon(0), beacon(1, 2_300_000)).exchanged() == []


def test_beacons_that_have_one_anothers_tracks_get_their_labels_back():
    scene = Scene(beacon(0), beacon(1, 2_300_000))
    scene.has = {1: scene.beacons[1], 2: scene.beacons[0]}
    assert scene.exchanged() == [(1, 2)]


def test_three_that_meet_get_their_labels_back():
    beacons = beacon(0), beacon(1, 2_300_000), beacon(0, 5_600_000)
    scene = Scene(*beacons)
    scene.has = {1: beacons[1], 2: beacons[2], 3: beacons[0]}
    scene.exchanged()
    assert [scene.has[label] is events for label, events in enumerate(beacons, 1)] == [True] * 3


def test_a_meeting_between_two_hops_is_one():
    scene = Scene(beacon(0), beacon(1, 2_300_000))
    scene.has = {1: scene.beacons[1], 2: scene.beacons[0]}

    def fast_at(t_ns, apart=lambda t_ns: 4_000.0 * (t_ns - MEETS_NS - HOP_NS // 2) / NS):
        return {
            label: Track(
                label, 300.0 + sign * apart(t_ns), 100.0, t_ns, RADIUS_PX, 1.0, 0, t_ns,
                vx_px_per_s=sign * 4_000.0, bit_rate_bps=RATE_BPS,
            )
            for label, sign in ((1, 1.0), (2, -1.0))
        }  # fmt: skip

    scene.tracks_at = fast_at
    assert scene.exchanged(MEETS_NS + 120_000_000) == [(1, 2)]


def test_beacons_whose_bits_lie_alike_keep_what_they_have():
    scene = Scene(beacon(0), beacon(1))
    scene.has = {1: scene.beacons[1], 2: scene.beacons[0]}
    assert scene.exchanged() == []


@pytest.mark.parametrize('rate_bps', [None, RATE_BPS])
@pytest.mark.parametrize(('seen', 'expected'), [(0, [(2, 3)]), (1, [(1, 3), (2, 3)])])
def test_a_beacon_whose_track_was_thrown_off_is_found_in_a_new_one(seen, expected, rate_bps):
    scene = Scene(beacon(0), beacon(1, 2_300_000))
    scene.quiet = {2}
    scene.has = {1: scene.beacons[seen], 2: scene.beacons[1 - seen], 3: scene.beacons[1 - seen]}
    scene.began_ns[3], scene.rates[3] = APART_NS, rate_bps
    assert scene.exchanged() == expected


def test_other_light_does_not_get_the_label_of_a_beacon_that_was_thrown_off():
    scene = Scene(beacon(0), beacon(1, 2_300_000))
    random = np.random.default_rng(0)
    t_ns = np.sort(random.integers(0, 2 * NS, 200_000))
    scene.quiet = {2}
    scene.has = {1: scene.beacons[0], 2: scene.beacons[1], 3: (t_ns, random.choice(np.array([-1, 1], np.int8), len(t_ns)))}
    scene.began_ns[3], scene.rates[3] = APART_NS, None
    assert scene.exchanged() == []


def test_what_is_not_read_yet_has_no_meeting():
    scene = Scene(beacon(0), beacon(1, 2_300_000))
    scene.signatures[1] = None
    scene.has = {1: scene.beacons[1], 2: scene.beacons[0]}
    assert scene.exchanged() == []
