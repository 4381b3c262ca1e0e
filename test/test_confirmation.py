"""Confirmation: texts are confirmed, noise and lamps are not, and beacons that fall silent or break are demoted."""

from collections.abc import Iterable, Iterator
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from beacon_comm.core.character import Character, Status
from beacon_comm.core.confirmation import ParityRecord, Verdict, comb_share, equal_share, regular_share, repeats
from beacon_comm.core.framing import CharacterFrame
from beacon_comm.core.parameters import Parameters

T0_NS = 2**40
RATE_BPS = 504.0
FRAME = CharacterFrame()
FRAME_NS = round(FRAME.duration_ns(RATE_BPS))
OK, PARITY, FRAMING, REPAIRED = Status.OK, Status.PARITY_ERROR, Status.FRAMING_ERROR, Status.REPAIRED
TEXT = "Shall I compare thee to a summer's day?\nThou art more lovely and more temperate:\nRough winds do shake the"


def characters(
    text: Iterable[str], statuses: Iterable[Status] | None = None, first: int = 0, confidence: float = 1.0
) -> Iterator[Character]:
    """Yield a text's characters a frame apart, the ``first`` at T0 + first frames."""
    text = list(text)
    for k, (letter, status) in enumerate(zip(text, statuses or [OK] * len(text), strict=True)):
        t_ns = T0_NS + (first + k) * FRAME_NS
        yield Character(t_ns, ord(letter), status, confidence, FRAME.frame_of(ord(letter)), RATE_BPS)


def verdicts(record: ParityRecord, stream: Iterable[Character]) -> dict[int, Verdict]:
    """Push a stream; return what happened, by the count of characters at which it did."""
    happened = {}
    for character in stream:
        verdict = record.push(character)
        if verdict is not Verdict.NONE:
            happened[record.characters] = verdict
    return happened


def test_a_text_is_confirmed_at_its_fifteenth_character() -> None:
    record = ParityRecord(Parameters())
    assert verdicts(record, characters(TEXT)) == {15: Verdict.CONFIRMED}
    assert record.confirmed and not record.demoted
    assert record.confirmed_at_ns == T0_NS + 15 * FRAME_NS
    assert (record.characters, record.ok) == (len(TEXT), len(TEXT))


def test_every_status_is_counted() -> None:
    record = ParityRecord(Parameters())
    verdicts(record, characters('abcdefg', [OK, OK, PARITY, FRAMING, FRAMING, FRAMING, REPAIRED]))
    counts = record.characters, record.ok, record.parity_errors, record.framing_errors, record.repaired
    assert counts == (7, 2, 1, 3, 1)


@pytest.mark.parametrize(
    ('last', 'happened'),
    [
        ([OK, OK, OK, OK, PARITY], {}),
        ([FRAMING, FRAMING, PARITY, FRAMING, FRAMING], {}),  # a framing error has the right parity
        ([OK, OK, OK, PARITY, PARITY], {15: Verdict.REJECTED}),
        ([OK, OK, OK, OK, OK], {}),
        ([OK, OK, OK, REPAIRED, REPAIRED], {15: Verdict.REJECTED}),  # what was rescued is no evidence
    ],
)
def test_a_candidate_is_judged_by_its_last_five_parities(last: list[Status], happened: dict[int, Verdict]) -> None:
    record = ParityRecord(Parameters())
    assert verdicts(record, characters(TEXT[:15], [PARITY] * 10 + last)) == happened
    assert record.demoted == bool(happened)


@pytest.mark.parametrize(
    ('flipped', 'confidence', 'happened'),
    [
        ((), 0.5, {}),
        ((), 0.95, {15: Verdict.CONFIRMED}),  # evidence that could have failed
        ((8,), 0.5, {15: Verdict.REJECTED}),
        ((8,), 0.95, {15: Verdict.REJECTED}),
    ],
)
def test_a_repaired_character_counts_as_right_if_the_bits_say_so_without_the_frame_and_vouches_if_sure(
    flipped: tuple[int, ...], confidence: float, happened: dict[int, Verdict]
) -> None:
    record = ParityRecord(Parameters())
    sent = list(characters(TEXT[:15], [REPAIRED] * 15, confidence=confidence))
    for k, character in enumerate(sent):
        bits = [character.frame >> shift & 1 for shift in range(FRAME.length - 1, -1, -1)]
        sent[k] = replace(character, bit_llr=tuple(2.0 * (bit ^ (place in flipped)) - 1.0 for place, bit in enumerate(bits)))
    assert sent[0].read_freely == (not flipped)
    assert verdicts(record, sent) == happened
    assert record.confirmed == (Verdict.CONFIRMED in happened.values())


def test_a_candidate_is_judged_again_every_fifteen() -> None:
    record = ParityRecord(Parameters())
    statuses = [PARITY] * 11 + [OK] * 4 + [PARITY] * 11 + [OK] * 4 + [PARITY] * 20
    assert verdicts(record, characters(TEXT[:50], statuses)) == {45: Verdict.REJECTED}


def test_rejection_goes_before_confirmation() -> None:
    record = ParityRecord(Parameters(confirm_ok=10))
    assert verdicts(record, characters(TEXT[:15], [OK] * 12 + [PARITY] * 3)) == {15: Verdict.REJECTED}


@pytest.mark.parametrize(('ok', 'confirmed'), [(12, True), (11, False)])
def test_twelve_of_the_last_fifteen_must_be_ok(ok: int, confirmed: bool) -> None:
    statuses = [FRAMING] * (15 - ok) + [OK] * ok
    record = ParityRecord(Parameters())
    verdicts(record, characters(TEXT[:15], statuses))
    assert record.confirmed is confirmed


def test_the_window_rolls() -> None:
    record = ParityRecord(Parameters())
    assert verdicts(record, characters(TEXT[:40], [FRAMING] * 20 + [OK] * 20)) == {32: Verdict.CONFIRMED}


def test_characters_that_slipped_in_do_not_vouch() -> None:
    def slipping(bits: float) -> list[Character]:
        step = round(bits / FRAME.length * FRAME_NS)
        return [
            Character(T0_NS + k * step, c.code, OK, 1.0, c.frame, RATE_BPS) for k, c in enumerate(characters(TEXT))
        ]

    for bits, confirmed in ((9.0, False), (10.4, False), (10.6, True), (11.0, True), (11.4, True), (30.0, True)):
        record = ParityRecord(Parameters())
        verdicts(record, slipping(bits))
        assert record.confirmed is confirmed, bits


@pytest.mark.parametrize('text', ['a', 'ab', 'abc', '\x07', 'U', 'xyz'])
def test_a_short_period_is_refused_and_can_be_allowed(text: str) -> None:
    record = ParityRecord(Parameters())
    assert verdicts(record, characters(text * 60)) == {}
    allowed = ParityRecord(Parameters(allow_periodic=True, confirm_distinct_codes=1))
    assert verdicts(allowed, characters(text * 60)) == {15: Verdict.CONFIRMED}


@pytest.mark.parametrize('identity', ['BCN1', 'ID:7\n', 'beacon 12\n'])
def test_an_identity_of_four_characters_or_more_is_confirmed(identity: str) -> None:
    record = ParityRecord(Parameters())
    assert verdicts(record, characters(identity * 20)) == {15: Verdict.CONFIRMED}


@pytest.mark.parametrize('text', ['00:00:07\n', 'MMSI 211000000\n', '0x0000001F\n', '000042\n', 'SOS SOS\n'])
def test_a_text_with_runs_only_delays(text: str) -> None:
    record = ParityRecord(Parameters())
    ((at, verdict),) = verdicts(record, characters(text * 20)).items()
    assert verdict is Verdict.CONFIRMED and at <= 30


@settings(max_examples=200, deadline=None)
@given(
    period=st.integers(1, 3),
    letters=st.lists(st.integers(0, 127), min_size=3, max_size=3),
    wrong=st.lists(st.tuples(st.integers(0, 199), st.integers(0, 127)), max_size=14),
    slips=st.lists(st.integers(0, 199), max_size=6),
)
def test_a_period_with_errors_and_slips_is_refused(
    period: int, letters: list[int], wrong: list[tuple[int, int]], slips: list[int]
) -> None:
    """Every 28th code wrong, its parity right, and every 33rd character lost, at most, leave a period a period."""
    codes = [letters[k % period] for k in range(231)]
    for place, code in {place // 28: (place // 28 * 28, code) for place, code in wrong}.values():
        codes[place] = code
    for place in sorted({slip // 33 * 33 + 16 for slip in slips}, reverse=True):
        del codes[place]
    record = ParityRecord(Parameters())
    assert verdicts(record, characters(map(chr, codes))) == {}


def test_a_run_of_one_letter_only_delays() -> None:
    record = ParityRecord(Parameters())
    happened = verdicts(record, characters('a' * 30 + TEXT))
    assert list(happened.values()) == [Verdict.CONFIRMED]
    assert 30 < min(happened) <= 45


def test_regular_falls_are_refused() -> None:
    """A lamp of 2.75 to 3.67 bits with edges that jitter about bit centres: many codes, all of one lamp."""
    rng = np.random.default_rng(5)
    frames = [f for f in map(FRAME.frame_of, range(128)) if regular_share([f], FRAME.length) == 1.0]
    lamp = [f for f in frames if all(run in (3, 4) for run in fall_spacings(f))]
    assert len(lamp) >= 4
    codes = [FRAME.decode_frame(int(f))[0] for f in rng.choice(lamp, 300)]
    record = ParityRecord(Parameters(confirm_period=0))
    assert verdicts(record, characters(map(chr, codes))) == {}
    without_rule = ParityRecord(Parameters(confirm_period=0, confirm_regular=1.0))
    assert verdicts(without_rule, characters(map(chr, codes))) != {}


def fall_spacings(frame: int) -> list[int]:
    return [len(run) for run in f'{frame:011b}'.replace('10', '1|0').split('|')]


def test_edges_at_the_middles_of_bits_are_refused() -> None:
    for confidence, confirmed in ((0.19, False), (0.21, True)):
        record = ParityRecord(Parameters())
        verdicts(record, characters(TEXT, confidence=confidence))
        assert record.confirmed is confirmed


def test_one_blurred_character_does_not_matter() -> None:
    record = ParityRecord(Parameters())
    stream = list(characters(TEXT[:15]))
    stream[3:9] = list(characters(TEXT[:15], confidence=0.0))[3:9]
    assert verdicts(record, stream) == {15: Verdict.CONFIRMED}


def test_a_lamp_with_missed_edges_is_refused_unless_sharp() -> None:
    """Three periods a frame: falls at 3 2/3 and 7 1/3 bits, some of them missed; seen with blurred edges only."""
    lamp = '00110110011', '01111111111', '00000110011', '00110000011', '00110111111', '01111110011', '00000000011'
    codes = [chr(FRAME.decode_frame(int(frame, 2))[0]) for frame in lamp]
    assert comb_share([FRAME.frame_of(ord(code)) for code in codes], FRAME.length) == 1.0
    stream = [codes[k] for k in np.random.default_rng(6).integers(len(codes), size=200)]
    for confidence, confirmed in ((0.35, False), (0.6, True)):
        record = ParityRecord(Parameters())
        verdicts(record, characters(stream, confidence=confidence))
        assert record.confirmed is confirmed
    assert comb_share([FRAME.frame_of(ord(letter)) for letter in TEXT[:15]], FRAME.length) < 0.9
    assert comb_share([], FRAME.length) == 0.0


def test_regular_share_tells_a_lamp_from_a_text() -> None:
    sonnet = [FRAME.frame_of(ord(letter)) for letter in TEXT[:15]]
    assert regular_share(sonnet, FRAME.length) < 0.5
    assert regular_share([0b00001111111] * 15, FRAME.length) == 1.0
    assert regular_share([0b00110011011] * 15, FRAME.length) == 1.0
    assert regular_share([], FRAME.length) == 0.0


def test_repeats_asks_only_pairs_that_vouch() -> None:
    assert repeats([1, None, 1, None, 1], 2, 0.5)
    assert not repeats([1, None, 2, None, 3], 2, 0.5)
    assert not repeats([None] * 5, 1, 0.5)


def test_random_parity_confirms_nothing() -> None:
    """Random frames: ok one time in five, as a line that changes at random gives them."""
    rng = np.random.default_rng(11)
    record = ParityRecord(Parameters())
    for start in range(0, 30_000, 15):
        statuses = [Status(s) for s in rng.choice([0, 2, 3], 15, p=[0.2, 0.5, 0.3])]
        letters = map(chr, rng.integers(0, 128, 15))
        assert Verdict.CONFIRMED not in verdicts(record, characters(letters, statuses, start)).values()
        if record.demoted:
            record = ParityRecord(Parameters())


def test_random_parity_passes_the_papers_rule_as_often_as_it_says() -> None:
    rng = np.random.default_rng(3)
    passed = 0
    for _ in range(2000):
        record = ParityRecord(Parameters())
        statuses = [PARITY if wrong else FRAMING for wrong in rng.random(15) < 0.5]
        passed += not verdicts(record, characters('x' * 15, statuses))
    assert passed / 2000 == pytest.approx(6 / 32, abs=0.03)


# Confirmed beacons


def confirmed_record(parameters: Parameters | None = None) -> ParityRecord:
    record = ParityRecord(parameters or Parameters())
    verdicts(record, characters(TEXT[:15]))
    assert record.confirmed
    return record


def test_a_confirmed_beacon_is_demoted_after_fifteen_failures_in_a_row() -> None:
    record = confirmed_record()
    happened = verdicts(record, characters('#' * 40, [PARITY] * 40, 15))
    assert happened == {15 + 1 + 15: Verdict.DEMOTED}  # at the second wrong parity 3 of 5 are right: the first failure
    assert record.demoted and not record.confirmed


def test_four_right_of_five_forgive() -> None:
    record = confirmed_record()
    statuses = ([PARITY] * 12 + [OK] * 4) * 20
    assert verdicts(record, characters('#' * len(statuses), statuses, 15)) == {}


def test_a_slip_of_ten_characters_costs_no_confirmation() -> None:
    record = confirmed_record()
    assert verdicts(record, characters('#' * 30, [PARITY] * 10 + [OK] * 20, 15)) == {}
    assert record.confirmed


def test_random_parity_demotes_a_confirmed_beacon_within_seconds() -> None:
    rng = np.random.default_rng(8)
    needed = []
    for _ in range(40):
        record = confirmed_record()
        statuses = [PARITY if wrong else FRAMING for wrong in rng.random(1000) < 0.5]
        needed.append(min(verdicts(record, characters('#' * 1000, statuses, 15))) - 15)
    assert np.mean(needed) < 150


def test_a_lamp_in_the_beacons_place_keeps_its_parity() -> None:
    """What vouched stays vouched for while parity is right; only parity demotes."""
    record = confirmed_record()
    assert verdicts(record, characters('\x07' * 100, None, 15)) == {}


# Starving


def advance(record: ParityRecord, seconds: float, quiet: bool = False, start_s: float = 0.0) -> Verdict:
    for t_ns in range(T0_NS + round(start_s * 1e9), T0_NS + round((start_s + seconds) * 1e9) + 1, 10_000_000):
        verdict = record.advance(t_ns, quiet)
        if verdict is not Verdict.NONE:
            return verdict
    return Verdict.NONE


def test_a_candidate_without_characters_starves() -> None:
    record = ParityRecord(Parameters())
    assert advance(record, 1.99) is Verdict.NONE
    assert advance(record, 0.02, start_s=1.99) is Verdict.STARVED
    assert record.demoted


def test_silence_stops_the_clock() -> None:
    record = ParityRecord(Parameters())
    assert advance(record, 1.9) is Verdict.NONE
    assert advance(record, 60.0, quiet=True, start_s=1.9) is Verdict.NONE
    assert advance(record, 0.2, start_s=61.9) is Verdict.STARVED


def test_a_few_characters_do_not_feed_a_candidate_but_fifteen_do() -> None:
    record = ParityRecord(Parameters())
    advance(record, 1.9)
    verdicts(record, characters(TEXT[:14], [FRAMING] * 14))
    assert advance(record, 0.2, start_s=1.9) is Verdict.STARVED
    record = ParityRecord(Parameters())
    advance(record, 1.9)
    verdicts(record, characters(TEXT[:15], [FRAMING] * 15))
    assert advance(record, 1.9, start_s=1.9) is Verdict.NONE


def test_the_slowest_beacon_does_not_starve() -> None:
    record = ParityRecord(Parameters(bit_rates=(20.0, 3125.0)))
    assert record.starved_after_ns == round(1.5 * 15 * 11 / 20 * 1e9)
    assert advance(record, 15 * 11 / 20) is Verdict.NONE


def test_a_confirmed_beacon_may_hold_its_led_on() -> None:
    record = confirmed_record()
    assert advance(record, 600.0) is Verdict.NONE
    assert record.confirmed and not record.demoted


def test_a_window_on_a_comb_that_is_not_quite_sharp_needs_a_second_one() -> None:
    """The frames of 'BCN1' fit no comb, those of these codes do: one fall, in the middle of the frame."""
    codes = [chr(code) for code in (0b1111000, 0b1110000, 0b1111001, 0b1110011)] * 20
    for confidence, confirmed_at in ((0.3, []), (0.5, [30]), (0.7, [15])):
        record = ParityRecord(Parameters(confirm_regular=1.0))
        read = [replace(character, confidence=confidence) for character in characters(codes)]
        assert sorted(verdicts(record, read)) == confirmed_at, confidence


@pytest.mark.parametrize('codes', ['oooo{{{{\x03x', 'mmmmoooii{'])
def test_few_codes_on_a_comb_are_refused_where_edges_stray(codes: str) -> None:
    """What was once confirmed of two lamps, and of bars that pass: sure characters, but all falls on a comb."""
    read = [codes[k] for k in np.random.default_rng(1).integers(len(codes), size=200)]
    assert comb_share([FRAME.frame_of(ord(letter)) for letter in read], FRAME.length) == 1.0
    assert equal_share([ord(letter) for letter in read]) > 0.2
    for spread, confirmed in ((0.12, False), (0.02, True)):
        record = ParityRecord(Parameters())
        verdicts(record, (replace(character, edge_spread=spread) for character in characters(read)))
        assert record.confirmed is confirmed


def test_a_blurred_beacon_is_confirmed_all_the_same() -> None:
    for text in (TEXT, 'ID017 ' * 10, '0042 ' * 12, 'ID000042 ' * 8):
        record = ParityRecord(Parameters())
        verdicts(record, (replace(character, edge_spread=0.18) for character in characters(text)))
        assert record.confirmed, text


def test_edges_that_lie_anywhere_confirm_nothing() -> None:
    """What was once confirmed of half a screen had a spread of 0.24."""
    for spread, confirmed in ((0.21, True), (0.24, False)):
        record = ParityRecord(Parameters())
        verdicts(record, (replace(character, edge_spread=spread) for character in characters(TEXT * 3)))
        assert record.confirmed is confirmed


def test_equal_share_of_pairs() -> None:
    assert equal_share([1, 1, 1]) == 1.0
    assert equal_share([1, 1, 2, 2]) == pytest.approx(2 / 6)
    assert equal_share([1, 2, 3]) == 0.0
    assert equal_share([1]) == equal_share([]) == 1.0


# Other frames


def test_without_parity_ok_stands_in_for_it() -> None:
    parameters = Parameters(parity='none')
    record = ParityRecord(parameters)
    assert verdicts(record, characters(TEXT[:15], [FRAMING] * 15)) == {15: Verdict.REJECTED}
    assert record.starved_after_ns == round(2e9)


def test_a_demoted_record_counts_on_in_silence() -> None:
    record = ParityRecord(Parameters())
    assert verdicts(record, characters(TEXT[:50], [PARITY] * 15 + [OK] * 35)) == {15: Verdict.REJECTED}
    assert record.characters == 50 and record.demoted and not record.confirmed
    assert advance(record, 10.0) is Verdict.NONE
