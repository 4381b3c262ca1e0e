"""The compiled chain against the one in plain numpy: every event, track, state and character."""

from dataclasses import replace

import numpy as np
import pytest
from disc_events import disc, merged, noise
from hypothesis import given, settings
from hypothesis import strategies as st

from beacon_comm.core.events import EventBatch
from beacon_comm.core.parameters import Parameters
from beacon_comm.core.receiver import Receiver
from beacon_comm.recordings.bags import open_recording
from beacon_comm.reference.detection import ReferenceDetector
from beacon_comm.reference.evt3 import ReferenceEvt3Decoder
from beacon_comm.wire.cdr import build_event_packet, parse_event_packet
from beacon_comm.wire.evt3_encoder import Evt3Encoder
from beacon_comm.wire.stream import PACKET_TYPES, EventStream

SIZE = (160, 120)
PACKET_NS = 4_000_000


def assert_same_events(one: EventBatch | None, other: EventBatch | None) -> None:
    assert (one is None) == (other is None)
    if one is not None and other is not None:
        for name in ('x', 'y', 'polarity', 't_ns'):
            np.testing.assert_array_equal(getattr(one, name), getattr(other, name), name)
        assert one.t_end_ns == other.t_end_ns


def busy_scene(seed: int, rate_per_s: float) -> EventBatch:
    """Return discs that stand, move and come and go, over noise."""
    return merged(
        disc(40.0, 30.0, duration_s=0.3, seed=seed),
        disc(60.0, 80.0, vx=200.0, duration_s=0.3, bit_rate_bps=3125.0, seed=seed + 1),
        disc(120.0, 30.0, radius_px=9.0, start_s=0.08, duration_s=0.1, seed=seed + 2),
        noise(*SIZE, rate_per_s, 0.3, seed=seed + 3),
    )


@pytest.mark.parametrize(
    ('seed', 'rate_per_s', 'parameters'),
    [
        (1, 50_000, Parameters(receiver='threshold', lost_after_s=0.05)),
        (2, 600_000, Parameters(receiver='threshold', bit_rates=(200.0, 3125.0), closing_px=4, max_area_px=400)),
        (3, 1_500_000, Parameters(receiver='sequence', bit_rates=(3125.0,), max_tracks=40)),
    ],
)
def test_from_bytes_to_characters_both_do_the_same(seed: int, rate_per_s: float, parameters: Parameters) -> None:
    parameters = replace(parameters, tracker='nearest')  # the reference chain has no other
    events = busy_scene(seed, rate_per_s)
    events = EventBatch(events.x, events.y, events.polarity, events.t_ns - events.t_ns[0], 0)
    stream, decoder, encoder = EventStream(PACKET_TYPES[0]), ReferenceEvt3Decoder(*SIZE), Evt3Encoder(*SIZE)
    receiver = Receiver(parameters, SIZE)
    reference = Receiver(parameters, SIZE, detection=ReferenceDetector(parameters, SIZE))
    seen = characters = 0
    raised = False
    for seq, end_ns in enumerate(range(PACKET_NS, int(events.t_ns[-1]) + PACKET_NS, PACKET_NS)):
        start, stop = np.searchsorted(events.t_ns, (end_ns - PACKET_NS, end_ns))
        payload = encoder.encode(events.slice(start, stop, end_ns))
        batch = stream.push(build_event_packet(0, 'camera', *SIZE, seq, 0, 'evt3', payload)).batch
        assert batch is not None
        assert_same_events(batch, decoder.decode(np.frombuffer(payload, np.uint8)))
        output = receiver.push(batch)
        assert output == reference.push(batch)
        assert receiver.beacons() == reference.beacons()
        assert receiver.index_threshold == reference.index_threshold
        raised |= receiver.index_threshold > parameters.index_threshold
        seen = max(seen, len(receiver.beacons()))
        characters += len(output.characters)
    assert receiver.flush() == reference.flush()
    assert seen >= 3 and raised == (rate_per_s > 1_000_000)  # by more tracks than may begin at once


@pytest.mark.parametrize('name', ['evt3_static', 'evt3_trigger_hd'])
def test_real_words_are_the_same_events(data_folder, name: str) -> None:
    with open_recording(data_folder / name) as bag:
        topic = bag.event_topic()
        messages = [cdr for _, cdr in bag.messages(topic)]
    first = parse_event_packet(messages[0])
    stream, decoder = EventStream(topic.type), ReferenceEvt3Decoder(first.width, first.height)
    for cdr in messages:
        assert_same_events(stream.push(cdr).batch, decoder.decode(parse_event_packet(cdr).payload))
    assert stream.counts['events'] > 80_000


WORDS = st.one_of(
    st.integers(0, 255).map(lambda v: 0 << 12 | v),
    st.integers(0, 0xFFF).map(lambda v: 2 << 12 | v),
    st.tuples(st.booleans(), st.integers(0, 200)).map(lambda v: 3 << 12 | v[0] << 11 | v[1]),
    st.integers(0, 0xFFF).map(lambda v: 4 << 12 | v),
    st.integers(0, 0xFF).map(lambda v: 5 << 12 | v),
    st.integers(0, 0xFFF).map(lambda v: 6 << 12 | v),
    st.integers(0, 40).map(lambda v: 8 << 12 | v),  # forwards, and back by less than a second
    st.sampled_from([0x7000, 0xA101, 0xE000, 0xF000, 0x9000]),
)


@settings(max_examples=100, deadline=None)
@given(st.lists(st.lists(WORDS, max_size=40), min_size=1, max_size=6))
def test_any_words_are_the_same_events(packets: list[list[int]]) -> None:
    stream, decoder = EventStream(PACKET_TYPES[0]), ReferenceEvt3Decoder(180, 200)
    for seq, words in enumerate(packets):
        payload = np.array(words, '<u2').tobytes()
        batch = stream.push(build_event_packet(0, 'camera', 180, 200, seq, 0, 'evt3', payload)).batch
        assert_same_events(batch, decoder.decode(np.frombuffer(payload, np.uint8)))
