"""Merging: clips, looped backgrounds and scenes keep every event, in order of time, whatever is cut or encoded."""

from itertools import islice
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from beacon_comm.core.errors import ParameterError, RecordingError
from beacon_comm.core.events import NS_PER_S, EventBatch
from beacon_comm.recordings.bag_writer import BagWriter
from beacon_comm.recordings.bags import open_recording
from beacon_comm.recordings.disc import Disc
from beacon_comm.recordings.interfaces import PACKET_TYPE
from beacon_comm.recordings.scene import STAMP_START_NS, Scene
from beacon_comm.recordings.sources import Background, Beacon, Clip, mat_beacon
from beacon_comm.recordings.truth import read_truth, write_truth
from beacon_comm.simulation.led import noise, sensor_noise
from beacon_comm.wire.cdr import parse_event_packet
from beacon_comm.wire.stream import EventStream

WIDTH, HEIGHT = 64, 48
TOPIC = '/event_camera/events'


def beacon(seed: int, duration_s: float, disc: str = '20,20,4,50,-30', rate_per_s: float = 5000.0) -> Beacon:
    t_ns, polarity = noise(rate_per_s, duration_s, seed=seed)
    return Beacon(f'noise {seed}', 'simulated', t_ns, polarity, round(duration_s * NS_PER_S), Disc.parse(disc, WIDTH, HEIGHT))


def joined(batches: list[EventBatch]) -> np.ndarray:
    columns = ('t_ns', 'x', 'y', 'polarity')
    return np.stack([np.concatenate([getattr(b, name) for b in batches]).astype(np.int64) for name in columns])


def decoded(packets: list[tuple[int, bytes]]) -> list[EventBatch]:
    stream = EventStream(PACKET_TYPE)
    batches = []
    for _, cdr in packets:
        read = stream.push(cdr)
        assert read.batch is not None and not read.restarted
        batches.append(read.batch)
    troubles = {kind: n for kind, n in stream.counts.items() if n and kind not in ('packets', 'events')}
    assert troubles == {}
    return batches


@pytest.fixture(scope='module')
def background_bag(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Half a second of noise, starting late on its clock, as a bag."""
    folder = tmp_path_factory.mktemp('merge') / 'background'
    events = sensor_noise(8000.0, 0.5, WIDTH, HEIGHT, t0_ns=3 * NS_PER_S, seed=11)
    events = EventBatch(events.x, events.y, events.polarity, events.t_ns - 3 * NS_PER_S, events.t_end_ns - 3 * NS_PER_S)
    source = Beacon('b', 'simulated', events.t_ns, events.polarity, NS_PER_S // 2, Disc(31, 23, 20, 0, 0, WIDTH, HEIGHT))
    with BagWriter(folder) as writer:
        writer.add_topic(TOPIC, PACKET_TYPE)
        for t_ns, cdr in Scene((source,), WIDTH, HEIGHT).packets():
            writer.write(TOPIC, t_ns, cdr)
    return folder


def test_clip_parse() -> None:
    assert Clip.parse('0') == Clip()
    assert Clip.parse('12.3,5') == Clip(12.3, 5.0)
    assert Clip.parse('1,,3') == Clip(1.0, None, 3)
    for text in ('', 'a', '1,2,3,4', '-1', '1,0', '1,-2', '1,2,0', 'inf', '0,nan', '1e300', '0,1e300'):
        with pytest.raises(ParameterError, match='clip'):
            Clip.parse(text)


def test_clip_places_the_part_at_scene_time_0() -> None:
    t_ns = 2**40 + np.array([0, 1, 2, 3, 4, 5], np.int64) * NS_PER_S
    polarity = np.array([1, -1, 1, -1, 1, -1], np.int8)
    times, its_polarity, end_ns = Clip(1.5, 2.0).apply(t_ns, polarity)
    assert times.tolist() == [NS_PER_S // 2, 3 * NS_PER_S // 2]
    assert its_polarity.tolist() == [1, -1] and end_ns == 2 * NS_PER_S
    times, its_polarity, end_ns = Clip(4.0, None, 2).apply(t_ns, polarity)
    period = NS_PER_S + 1_000_000  # the last event, rounded up to the next millisecond
    assert times.tolist() == [0, NS_PER_S, period, period + NS_PER_S]
    assert its_polarity.tolist() == [1, -1, 1, -1] and end_ns == 2 * period
    assert len(Clip(10.0).apply(t_ns, polarity)[0]) == 0


@pytest.mark.parametrize('clip', [Clip(0.0, 1.0, 86_401), Clip(0.0, 1e-9, 1 << 29), Clip(0.0, 1e-10, 10**30)])
def test_a_clip_is_not_repeated_without_end(clip: Clip) -> None:
    with pytest.raises(ParameterError, match=f'clip count {clip.count}: more than a day'):
        clip.apply(np.array([0, 1000], np.int64), np.array([1, -1], np.int8))


def test_background_loops_without_a_step_back(background_bag: Path) -> None:
    background = Background(background_bag)
    assert (background.width, background.height, background.topic) == (WIDTH, HEIGHT, TOPIC)
    batches = list(islice(background.batches(), 400))  # more than three passes
    t_ns = np.concatenate([batch.t_ns for batch in batches])
    assert t_ns[0] == 0
    assert np.all(np.diff(t_ns) >= 0)
    once = len(decoded_bag(background_bag))
    second = t_ns[once : 2 * once] - t_ns[once]
    assert np.array_equal(second, t_ns[:once])  # each pass is the same …
    assert 0 < t_ns[once] - t_ns[once - 1] < 20_000_000  # … and follows closely, but not at the same instant


def decoded_bag(path: Path) -> np.ndarray:
    with open_recording(path) as bag:
        return joined(decoded(list(bag.messages(TOPIC)))).T


def test_background_without_events_is_refused(tmp_path: Path) -> None:
    with BagWriter(tmp_path / 'empty') as writer:
        writer.add_topic(TOPIC, PACKET_TYPE)
    with pytest.raises(RecordingError, match='no events could be decoded'):
        Background(tmp_path / 'empty')


def test_scene_holds_every_event_once_in_order(background_bag: Path) -> None:
    one, two = beacon(1, 1.2), beacon(2, 0.7, '40,30')
    scene = Scene((one, two), WIDTH, HEIGHT, Background(background_bag))
    together = joined(list(scene.batches()))
    assert np.all(np.diff(together[0]) >= 0)
    background = joined(list(islice(Background(background_bag).batches(), 400)))
    background = background[:, background[0] < 1.2 * NS_PER_S]
    parts = [background]
    for index, source in enumerate((one, two)):
        x, y = source.disc.pixels(source.t_ns, [0, index])
        parts.append(np.stack([source.t_ns, x, y, source.polarity]))
    expected = np.concatenate(parts, axis=1)
    assert np.array_equal(together[:, np.lexsort(together[::-1])], expected[:, np.lexsort(expected[::-1])])


def test_packets_carry_the_scene_exactly(background_bag: Path) -> None:
    scene = Scene((beacon(1, 0.5),), WIDTH, HEIGHT, Background(background_bag))
    packets = list(scene.packets())
    assert len(packets) == scene.packet_count() == 125
    batches = list(scene.batches())
    assert np.array_equal(joined(decoded(packets)), joined(batches))
    for k, ((recorded_ns, cdr), batch, read) in enumerate(zip(packets, batches, decoded(packets), strict=True)):
        packet = parse_event_packet(cdr)
        assert (packet.seq, packet.encoding, packet.width, packet.height) == (k, 'evt3', WIDTH, HEIGHT)
        assert packet.stamp_ns == STAMP_START_NS + int(batch.t_ns[0])
        assert recorded_ns == STAMP_START_NS + (k + 1) * 4_000_000
        assert read.t_end_ns == batch.t_end_ns == (k + 1) * 4_000_000


def test_time_goes_on_where_there_are_no_events() -> None:
    empty = Beacon('b', 'simulated', np.array([0, 10**9]), np.array([1, -1], np.int8), 2 * 10**9, Disc.parse('20,20', 64, 48))
    packets = list(Scene((empty,), WIDTH, HEIGHT).packets())
    assert [batch.t_end_ns for batch in decoded(packets)] == [4_000_000 * (k + 1) for k in range(500)]
    assert parse_event_packet(packets[3][1]).stamp_ns == STAMP_START_NS + 12_000_000


@settings(max_examples=20, deadline=None)
@given(start_ms=st.integers(0, 900), duration_ms=st.integers(1, 700), period_us=st.integers(1000, 50_000))
def test_a_part_of_the_scene_is_that_part_of_the_whole(start_ms: int, duration_ms: int, period_us: int) -> None:
    scene = Scene((beacon(1, 0.6), beacon(2, 1.0, '40,30')), WIDTH, HEIGHT)
    whole = joined(list(scene.batches()))
    other = Scene(scene.beacons, WIDTH, HEIGHT, packet_period_ns=period_us * 1000)
    part = joined(list(other.batches(start_ms / 1000, duration_ms / 1000)))
    kept = (whole[0] >= start_ms * 1_000_000) & (whole[0] < (start_ms + duration_ms) * 1_000_000)
    assert np.array_equal(part, whole[:, kept])


def test_a_looped_scene_runs_on_across_the_24_bit_wrap(background_bag: Path) -> None:
    scene = Scene((beacon(1, 3.0, rate_per_s=300.0),), WIDTH, HEIGHT, Background(background_bag), packet_period_ns=20_000_000)
    packets = list(islice(scene.packets(loop=True), 1000))  # 20 s, the wrap is at 16.777 s
    batches = decoded(packets)
    t_ns = joined(batches)[0]
    assert np.all(np.diff(t_ns) >= 0) and t_ns[-1] > 19.9 * NS_PER_S
    once = joined(list(scene.batches()))
    assert np.array_equal(t_ns[: once.shape[1]], once[0])
    assert np.array_equal(t_ns[once.shape[1] : 2 * once.shape[1]], once[0] + 3 * NS_PER_S)
    assert [parse_event_packet(cdr).seq for _, cdr in packets] == list(range(1000))


def test_the_same_scene_gives_the_same_bytes_and_another_seed_other_pixels() -> None:
    sources = (beacon(1, 0.1),)
    first = list(Scene(sources, WIDTH, HEIGHT).packets())
    assert first == list(Scene(sources, WIDTH, HEIGHT).packets())
    assert first != list(Scene(sources, WIDTH, HEIGHT, seed=1).packets())


def test_a_scene_that_does_not_fit_is_refused(background_bag: Path) -> None:
    with pytest.raises(ParameterError, match='at least one beacon'):
        Scene((), WIDTH, HEIGHT)
    with pytest.raises(ParameterError, match='640×480: a part of the scene is of 64×48'):
        Scene((beacon(1, 0.1),), 640, 480)
    with pytest.raises(ParameterError, match='packet period'):
        Scene((beacon(1, 0.1),), WIDTH, HEIGHT, packet_period_ns=10)
    far = Beacon('b', 'mat', np.array([0]), np.array([1], np.int8), 1, Disc.parse('100,100', 640, 480))
    with pytest.raises(ParameterError, match='64×48'):
        Scene((far,), 640, 480, Background(background_bag))


def test_truth_reads_back(tmp_path: Path) -> None:
    scene = Scene((beacon(1, 0.5), beacon(2, 1.0, '40,30')), WIDTH, HEIGHT)
    write_truth(tmp_path / 'truth.json', scene, 0.25)
    truth = read_truth(tmp_path)
    assert (truth.width, truth.height, truth.start_s, truth.duration_s) == (WIDTH, HEIGHT, 0.25, 0.75)
    assert truth.stamp_start_ns == STAMP_START_NS
    t_ns = np.arange(0, NS_PER_S, 1_000_000)
    for read, put in zip(truth.beacons, scene.beacons, strict=True):
        assert np.allclose(read.centre(t_ns), put.disc.centre(t_ns / NS_PER_S), atol=1e-6)
        assert np.all(read.radius_px(t_ns) == put.disc.radius_px)
        assert np.array_equal(read.visible(t_ns), (t_ns >= put.t_ns[0]) & (t_ns < put.end_ns))
        assert read.bearing(t_ns) is None and not len(read.sendings_ns)
    assert truth.beacons[0].events == len(scene.beacons[0].t_ns)
    (tmp_path / 'truth.json').write_text('{"schema": 3}')
    with pytest.raises(RecordingError, match='schema 3'):
        read_truth(tmp_path)
    (tmp_path / 'truth.json').write_text('[]')
    with pytest.raises(RecordingError, match='not the truth of a scene'):
        read_truth(tmp_path)


def test_real_recordings_over_every_real_background(data_folder: Path) -> None:
    for name in ('evt3_static', 'libcaer_grid', 'evt3_trigger_hd'):
        background = Background(data_folder / name)
        disc = Disc.parse('100,100', background.width, background.height)
        scene = Scene((mat_beacon(data_folder / '3125hz_30m.mat', disc, Clip(0, 0.1)),), disc.width, disc.height, background)
        packets = list(scene.packets(duration_s=2.5))
        assert len(packets) == 625
        t_ns = joined(decoded(packets))[0]
        assert np.all(np.diff(t_ns) >= 0) and t_ns[-1] > 2.49 * NS_PER_S
    with pytest.raises(RecordingError, match='no events in the clip from 5 s'):
        mat_beacon(data_folder / '3125hz_30m.mat', disc, Clip(5.0))
