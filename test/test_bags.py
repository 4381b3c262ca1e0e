"""Reading and writing bags: every form of bag gives the same raw CDR, and damage is named."""

import bz2
import shutil
import sqlite3
import struct
from contextlib import closing
from pathlib import Path

import lz4.frame
import numpy as np
import pytest
from rosbags import rosbag1, rosbag2
from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from beacon_comm.core.errors import RecordingError
from beacon_comm.recordings import compression
from beacon_comm.recordings.bag_writer import BagWriter
from beacon_comm.recordings.bags import TopicInfo, open_recording
from beacon_comm.recordings.interfaces import PACKET_TYPE, definition_text, definitions
from beacon_comm.recordings.ros1 import event_message_to_cdr

TYPE_HASH = 'RIHS01_d6fa176260b1f37e5a40845305315e150a0f18191241eb64f407442aa29844aa'  # of the drivers' EventPacket
TOPIC = '/event_camera/events'
MESSAGES = [(1_000 + 4_000 * k, b'\x00\x01\x00\x00' + bytes([k]) * 1500) for k in range(20)]


def write_bag(
    folder: Path,
    plugin: rosbag2.StoragePlugin = rosbag2.StoragePlugin.MCAP,
    mode: rosbag2.CompressionMode = rosbag2.CompressionMode.NONE,
    topics: dict[str, str] | None = None,
) -> Path:
    writer = rosbag2.Writer(folder, version=8, storage_plugin=plugin)
    writer.set_compression(mode, rosbag2.CompressionFormat.ZSTD)
    with writer:
        for name, message_type in (topics or {TOPIC: PACKET_TYPE}).items():
            connection = writer.add_connection(
                name, message_type, msgdef='#include "this is no definition"', rihs01=TYPE_HASH
            )
            for t_ns, cdr in MESSAGES:
                writer.write(connection, t_ns, cdr)
    return folder


def read(path: Path) -> list[tuple[int, bytes]]:
    with open_recording(path) as bag:
        return list(bag.messages(bag.event_topic()))


FORMS = [
    (plugin, mode)
    for plugin in rosbag2.StoragePlugin
    for mode in rosbag2.CompressionMode
    if (plugin, mode) != (rosbag2.StoragePlugin.SQLITE3, rosbag2.CompressionMode.STORAGE)
]


@pytest.mark.parametrize(('plugin', 'mode'), FORMS)
def test_every_storage_and_compression(
    tmp_path: Path, plugin: rosbag2.StoragePlugin, mode: rosbag2.CompressionMode
) -> None:
    folder = write_bag(tmp_path / 'bag', plugin, mode)
    assert read(folder) == MESSAGES
    (storage,) = [file for file in folder.iterdir() if file.name != 'metadata.yaml']
    assert read(storage) == MESSAGES  # the bare file, compressed or not
    (folder / 'metadata.yaml').unlink()
    assert read(folder) == MESSAGES  # a folder without metadata


@pytest.mark.parametrize(
    'metadata', ['', ': [', 'rosbag2_bagfile_information: {relative_file_paths: [renamed_since.mcap]}', '[1, 2]']
)
def test_unusable_metadata(tmp_path: Path, metadata: str) -> None:
    folder = write_bag(tmp_path / 'bag')
    (folder / 'metadata.yaml').write_text(metadata)
    assert read(folder) == MESSAGES


def test_split_files_come_in_order(tmp_path: Path) -> None:
    folder = tmp_path / 'split'
    folder.mkdir()
    for k in (2, 10, 1):
        part = write_bag(tmp_path / f'part_{k}')
        shutil.move(part / f'part_{k}.mcap', folder / f'bag_{k}.mcap')
        (folder / f'bag_{k}.mcap').touch()
    with open_recording(folder) as bag:
        assert bag.topics() == [TopicInfo(TOPIC, PACKET_TYPE, 60)]
        assert list(bag.messages(TOPIC)) == MESSAGES * 3
        assert [file.name for file in bag._files] == ['bag_1.mcap', 'bag_2.mcap', 'bag_10.mcap']
    (folder / 'metadata.yaml').write_text(
        'rosbag2_bagfile_information: {relative_file_paths: [bag_2.mcap, bag_3.mcap]}'
    )
    with open_recording(folder) as bag:
        kept = []
        with pytest.raises(RecordingError, match=r'bag_3\.mcap: listed in metadata\.yaml, but missing'):
            kept.extend(bag.messages(TOPIC))  # extend keeps what came before the error
        assert kept == MESSAGES


def test_the_topic_is_chosen_or_the_choice_is_listed(tmp_path: Path) -> None:
    two = write_bag(tmp_path / 'two', topics={'/left': PACKET_TYPE, '/right': PACKET_TYPE, '/t': 'std_msgs/msg/Int8'})
    with open_recording(two) as bag:
        assert bag.event_topic('/right').name == '/right'
        with pytest.raises(RecordingError, match=r'several event topics, choose one .*/left .*/right'):
            bag.event_topic()
        for name in ('/absent', '/t'):
            with pytest.raises(RecordingError, match=rf'no event topic {name} \(the bag holds /left'):
                bag.event_topic(name)
    bag = open_recording(write_bag(tmp_path / 'none', topics={'/t': 'std_msgs/msg/Int8'}))
    with pytest.raises(RecordingError, match=r'no event topic \(the bag holds /t \(std_msgs/msg/Int8, 20\)\)'):
        bag.event_topic()


@pytest.mark.parametrize('size', [0.3, 0.9, 0.999])
def test_a_cut_mcap_gives_what_is_left_and_says_so(tmp_path: Path, size: float) -> None:
    folder = write_bag(tmp_path / 'bag')
    file = folder / 'bag.mcap'
    # The writer puts one chunk; messages outside of chunks are what a recorder without chunks leaves.
    whole = file.read_bytes()
    records = whole[:8] + _unchunked(whole)
    file.write_bytes(records[: int(len(records) * size)])
    with open_recording(folder) as bag:
        kept = []
        with pytest.raises(RecordingError, match=r'bag\.mcap: the file ends'):
            kept.extend(bag.messages(TOPIC))
    assert kept == MESSAGES[: len(kept)] and len(kept) >= int(20 * size) - 2


def _unchunked(mcap: bytes) -> bytes:
    out, at = b'', 8
    while at < len(mcap) - 8:
        opcode, length = struct.unpack_from('<BQ', mcap, at)
        content = mcap[at + 9 : at + 9 + length]
        at += 9 + length
        if opcode == 6:
            (name_length,) = struct.unpack_from('<I', content, 28)
            out += content[32 + name_length + 8 :]
        elif opcode in (1, 3, 4, 5):
            out += struct.pack('<BQ', opcode, length) + content
    return out


@pytest.mark.parametrize('plugin', rosbag2.StoragePlugin)
def test_damage_within_a_file_keeps_what_is_before(tmp_path: Path, plugin: rosbag2.StoragePlugin) -> None:
    folder = write_bag(tmp_path / 'bag', plugin)
    file = folder / f'bag.{"mcap" if plugin is rosbag2.StoragePlugin.MCAP else "db3"}'
    content = bytearray(file.read_bytes())
    at = content.find(MESSAGES[10][1])  # storage is in order of writing
    content[at - 400 : at + 400] = b'\xff' * 800
    file.write_bytes(content)
    with open_recording(folder) as bag:
        kept: list[tuple[int, bytes]] = []
        with pytest.raises(RecordingError, match=rf'{file.name}: '):
            kept.extend(bag.messages(TOPIC))
    assert 6 <= len(kept) < 20
    assert kept[:6] == MESSAGES[:6]


CHUNKED = [(1_000 * k, b'\x00\x01\x00\x00' + bytes([k]) * 300_000) for k in range(12)]  # 4 messages a chunk


def chunked_mcap(folder: Path) -> tuple[Path, bytearray, list[tuple[int, int]]]:
    """Return the file of an MCAP of several chunks, its bytes, and where its records are: opcode and begin."""
    with BagWriter(folder) as writer:
        writer.add_topic(TOPIC, PACKET_TYPE)
        for t_ns, cdr in CHUNKED:
            writer.write(TOPIC, t_ns, cdr)
    file = folder / f'{folder.name}.mcap'
    content = bytearray(file.read_bytes())
    records, at = [], 8
    while at < len(content) - 8:
        opcode, length = struct.unpack_from('<BQ', content, at)
        records.append((opcode, at))
        at += 9 + length
    return file, content, records


@pytest.mark.parametrize('opcode', [6, 7])
@pytest.mark.parametrize('place', range(3))
@pytest.mark.parametrize('bit', [3, 8, 19, 21, 40, 63])
def test_a_wrong_length_in_an_mcap_costs_nothing_that_its_index_names(
    opcode: int, place: int, bit: int, tmp_path: Path
) -> None:
    file, content, records = chunked_mcap(tmp_path / 'bag')
    at = [begin for code, begin in records if code == opcode][place]
    content[at + 1 + bit // 8] ^= 1 << bit % 8
    file.write_bytes(content)
    kept, complaint = partly(file)
    assert len(kept) == 12 and kept == CHUNKED
    assert str(file) in complaint and complaint.count(':') == 1


def test_without_an_index_a_wrong_length_in_an_mcap_keeps_what_is_before(tmp_path: Path) -> None:
    file, content, records = chunked_mcap(tmp_path / 'bag')
    second = [begin for opcode, begin in records if opcode == 6][1]
    content[second + 6] ^= 1
    for damaged in (content[: records[-1][1]], content[:-1], content[:-28] + bytes(8) + content[-20:]):
        file.write_bytes(damaged)
        kept, complaint = partly(file)
        assert len(kept) == 4 and kept == CHUNKED[:4] and 'in the middle of a record' in complaint


def test_a_chunk_that_declares_the_topic_may_be_lost(tmp_path: Path) -> None:
    file, content, records = chunked_mcap(tmp_path / 'bag')
    first = next(begin for opcode, begin in records if opcode == 6)
    content[first + 9 + 16] ^= 1  # its size
    file.write_bytes(content)
    kept, complaint = partly(file)
    assert len(kept) == 8 and kept == CHUNKED[4:] and 'a chunk fails its checksum' in complaint


def partly(path: Path) -> tuple[list[tuple[int, bytes]], str]:
    """Return what a damaged bag gives, and how it complains at the end."""
    kept: list[tuple[int, bytes]] = []
    with open_recording(path) as bag, pytest.raises(RecordingError) as refusal:
        kept.extend(bag.messages(bag.event_topic()))
    return kept, str(refusal.value)


@pytest.mark.parametrize(('share', 'left'), [(0.6, 5), (0.9, 16)])
def test_a_cut_db3_gives_what_is_left_and_says_so(tmp_path: Path, share: float, left: int) -> None:
    folder = write_bag(tmp_path / 'bag', rosbag2.StoragePlugin.SQLITE3)
    file = folder / 'bag.db3'
    content = file.read_bytes()
    file.write_bytes(content[: int(len(content) * share)])
    kept, complaint = partly(file)
    assert set(kept) < set(MESSAGES) and len(kept) >= left
    assert 'bag.db3: ' in complaint and 'malformed' in complaint


def test_a_bad_page_of_a_db3_is_stepped_over(tmp_path: Path) -> None:
    folder = write_bag(tmp_path / 'bag', rosbag2.StoragePlugin.SQLITE3)
    file = folder / 'bag.db3'
    content = bytearray(file.read_bytes())
    at = content.find(MESSAGES[9][1]) // 4096 * 4096
    content[at : at + 4096] = b'\xff' * 4096
    file.write_bytes(content)
    kept, complaint = partly(file)
    assert [message for message in kept if message not in MESSAGES] == []
    assert len(kept) == len(set(kept)) >= 14 and kept[0] == MESSAGES[0] and kept[-1] == MESSAGES[-1]
    assert 'malformed' in complaint


def test_what_is_no_message_in_a_db3_is_stepped_over(tmp_path: Path) -> None:
    folder = write_bag(tmp_path / 'bag', rosbag2.StoragePlugin.SQLITE3)
    with closing(sqlite3.connect(folder / 'bag.db3')) as database:
        database.execute("UPDATE messages SET data = 'text' WHERE id = 4")
        database.execute("UPDATE messages SET timestamp = 'soon' WHERE id = 9")
        database.execute("INSERT INTO topics SELECT 7, x'00', 5, serialization_format, '', '' FROM topics LIMIT 1")
        database.commit()
    kept, complaint = partly(folder)
    assert sorted(kept) == [message for k, message in enumerate(MESSAGES) if k not in (3, 8)]
    assert 'str' in complaint


def ros1_packet(k: int) -> bytes:
    raw = struct.pack('<IIII', k, 5, k, 0) + struct.pack('<II', 480, 640) + struct.pack('<QQ', k, 2)
    return raw + struct.pack('<I', 4) + b'evt3' + b'\x00' + struct.pack('<I', 900) + bytes([k]) * 900


def ros1_bag(path: Path, packing: rosbag1.Writer.CompressionFormat | None = None) -> list[tuple[int, bytes]]:
    """Write 20 messages in chunks of four or so; return what is to be read."""
    writer = rosbag1.Writer(path)
    writer.chunk_threshold = 3000
    if packing is not None:
        writer.set_compression(packing)
    with writer:
        connection = writer.add_connection(
            TOPIC, PACKET_TYPE, msgdef=definition_text(PACKET_TYPE), md5sum='0123456789abcdef0123456789abcdef'
        )
        for k in range(20):
            writer.write(connection, 3_000_000_007 + k, ros1_packet(k))
    return [(3_000_000_007 + k, event_message_to_cdr(ros1_packet(k), PACKET_TYPE)) for k in range(20)]


@pytest.mark.parametrize('packing', [None, *rosbag1.Writer.CompressionFormat])
def test_a_ros1_bag_without_its_index(tmp_path: Path, packing: rosbag1.Writer.CompressionFormat | None) -> None:
    """As a recorder that was killed leaves it: the head says that there is no index, and the last chunk is cut."""
    file = tmp_path / 'killed.bag'
    messages = ros1_bag(file, packing)
    assert read(file) == messages
    content = bytearray(file.read_bytes())
    at = content.find(b'index_pos=') + len(b'index_pos=')
    content[at : at + 8] = bytes(8)
    last = content.rfind(b'compression=')
    file.write_bytes(content[: last + 60])
    kept, complaint = partly(file)
    assert 14 <= len(kept) < 20 and kept == messages[: len(kept)]
    assert 'killed.bag: ' in complaint


def test_a_bad_chunk_of_a_ros1_bag_is_stepped_over(tmp_path: Path) -> None:
    file = tmp_path / 'one.bag'
    messages = ros1_bag(file, rosbag1.Writer.CompressionFormat.LZ4)
    content = bytearray(file.read_bytes())
    second = content.find(b'compression=', content.find(b'compression=') + 1)
    content[second + 60 : second + 100] = b'\xff' * 40
    file.write_bytes(content)
    kept, complaint = partly(file)
    assert 12 <= len(kept) < 20 and set(kept) < set(messages) and kept[-1] == messages[-1]
    assert 'cannot be decompressed' in complaint or 'record' in complaint


def test_a_compressed_message_that_cannot_be_unpacked_is_stepped_over(tmp_path: Path) -> None:
    folder = write_bag(tmp_path / 'bag', rosbag2.StoragePlugin.SQLITE3, rosbag2.CompressionMode.MESSAGE)
    with closing(sqlite3.connect(folder / 'bag.db3')) as database:
        database.execute('UPDATE messages SET data = substr(data, 1, 9) WHERE id = 5')
        database.commit()
    kept, complaint = partly(folder)
    assert kept == MESSAGES[:4] + MESSAGES[5:]
    assert 'zstd' in complaint


def test_no_more_is_unpacked_than_a_bag_can_hold(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(compression, 'MOST_BYTES', 1000)
    for name, packed in (
        ('zstd', compression.zstd.compress(bytes(2000))), ('lz4', lz4.frame.compress(bytes(2000))),
        ('bz2', bz2.compress(bytes(2000))),
    ):  # fmt: skip
        with pytest.raises(ValueError, match=f'by {name} is too large'):
            compression.decompress(name, packed)
    two = compression.zstd.compress(b'one') + compression.zstd.compress(b'two')
    assert compression.decompress('zstd', two) == b'onetwo'
    with pytest.raises(ValueError, match='ends before its end'):
        compression.decompress('zstd', two[:-4])
    assert compression.decompress('none', b'as it is') == b'as it is'


def test_a_destroyed_head_is_refused(tmp_path: Path) -> None:
    file = tmp_path / 'a.db3'
    file.write_bytes(bytes(5000))
    with pytest.raises(RecordingError, match=r'a\.db3: file is not a database'):
        open_recording(file)
    ros1 = tmp_path / 'cut.bag'
    ros1.write_bytes(b'#ROSBAG V2.0\n' + bytes(50))
    with pytest.raises(RecordingError, match=r'cut\.bag: '):
        open_recording(ros1)


def test_what_is_no_bag_is_refused(tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match='no such file or folder'):
        open_recording(tmp_path / 'absent')
    (tmp_path / 'a.txt').write_text('text')
    with pytest.raises(RecordingError, match=r'a\.txt: not a bag'):
        open_recording(tmp_path / 'a.txt')
    with pytest.raises(RecordingError, match='/dev/null: not a bag'):
        open_recording('/dev/null')
    (tmp_path / 'empty').mkdir()
    with pytest.raises(RecordingError, match=r'no \.mcap or \.db3 file'):
        open_recording(tmp_path / 'empty')
    (tmp_path / 'a.mcap').write_bytes(b'no mcap either')
    with pytest.raises(RecordingError, match=r'a\.mcap: not an MCAP file'):
        open_recording(tmp_path / 'a.mcap')
    (tmp_path / 'a.mcap.zstd').write_bytes(b'not compressed')
    with pytest.raises(RecordingError, match=r'a\.mcap\.zstd: '):
        open_recording(tmp_path / 'a.mcap.zstd')


def test_written_bags_read_back_everywhere(tmp_path: Path) -> None:
    folder = tmp_path / 'deep' / 'out'
    store = get_typestore(Stores.ROS2_JAZZY)
    for name, text in definitions(PACKET_TYPE).items():
        if name not in store.types:
            store.register(get_types_from_msg(text, name))
    header = store.types['std_msgs/msg/Header'](store.types['builtin_interfaces/msg/Time'](5, 6), 'camera')
    packet = store.types[PACKET_TYPE](header, 480, 640, 7, 0, 'evt3', False, np.arange(9, dtype=np.uint8))
    cdr = bytes(store.serialize_cdr(packet, PACKET_TYPE))
    with BagWriter(folder) as writer:
        writer.add_topic(TOPIC, PACKET_TYPE)
        writer.write(TOPIC, 123, cdr)
    assert read(folder) == [(123, cdr)]
    with AnyReader([folder]) as reader:
        ((connection, t_ns, raw),) = reader.messages()
        assert (connection.digest, t_ns) == (TYPE_HASH, 123)
        message = reader.deserialize(raw, connection.msgtype)
        assert (message.width, message.seq, message.encoding) == (640, 7, 'evt3')
    with pytest.raises(RecordingError, match='exists already, nothing is overwritten'):
        BagWriter(folder)
    with BagWriter(tmp_path / 'other') as writer, pytest.raises(RecordingError, match='no definition of std_msgs'):
        writer.add_topic('/t', 'std_msgs/msg/Int8')


@pytest.mark.parametrize('count', [0, 1, 2, 5])
@pytest.mark.parametrize('frame_id', ['', 'cam', 'four'])
def test_ros1_messages_become_cdr(count: int, frame_id: str) -> None:
    """The conversion of our own gives what rosbags' general, slower one gives."""
    for message_type in (PACKET_TYPE, 'dvs_msgs/msg/EventArray'):
        store = get_typestore(Stores.ROS1_NOETIC)
        for name, text in definitions(message_type).items():
            if name not in store.types:
                store.register(get_types_from_msg(text, name))
        types = store.types
        time = types['builtin_interfaces/msg/Time']
        header = types['std_msgs/msg/Header'](9, time(5, 6), frame_id)
        if message_type == PACKET_TYPE:
            content = np.arange(count, dtype=np.uint8)
            message = types[message_type](header, 480, 640, 7, 2**40, 'mono', False, content)
        else:
            event = types['dvs_msgs/msg/Event']
            events = [event(k, 100 + k, time(7, 8 + k), bool(k % 2)) for k in range(count)]
            message = types[message_type](header, 480, 640, events)
        raw = bytes(store.serialize_ros1(message, message_type))
        modern = get_typestore(Stores.ROS2_JAZZY)
        for name, text in definitions(message_type).items():
            if name not in modern.types:
                modern.register(get_types_from_msg(text, name))
        converted = event_message_to_cdr(raw, message_type)
        back = modern.deserialize_cdr(converted, message_type)
        assert bytes(modern.serialize_cdr(back, message_type)) == converted
        assert (back.header.stamp.sec, back.header.frame_id, back.height) == (5, frame_id, 480)
        if message_type == PACKET_TYPE:
            assert (back.seq, back.time_base, back.encoding) == (7, 2**40, 'mono')
            assert back.events.tolist() == list(range(count))
        else:
            assert [(e.x, e.y, e.ts.sec, e.ts.nanosec, e.polarity) for e in back.events] == [
                (e.x, e.y, e.ts.sec, e.ts.nanosec, e.polarity) for e in message.events
            ]
        with pytest.raises((ValueError, struct.error)):
            event_message_to_cdr(raw[:-1] if count else raw[:-4], message_type)


def test_a_ros1_bag(tmp_path: Path) -> None:
    raw = struct.pack('<IIII', 0, 5, 6, 0) + struct.pack('<II', 480, 640) + struct.pack('<QQ', 1, 2)
    raw += struct.pack('<I', 4) + b'evt3' + b'\x00' + struct.pack('<I', 3) + b'abc'
    with rosbag1.Writer(tmp_path / 'one.bag') as writer:
        connection = writer.add_connection(
            TOPIC, PACKET_TYPE, msgdef=definition_text(PACKET_TYPE), md5sum='0123456789abcdef0123456789abcdef'
        )
        writer.write(connection, 77, raw)
    with open_recording(tmp_path / 'one.bag') as bag:
        assert bag.event_topic() == TopicInfo(TOPIC, PACKET_TYPE, 1)
    assert read(tmp_path / 'one.bag') == [(77, event_message_to_cdr(raw, PACKET_TYPE))]


@pytest.mark.parametrize(
    ('name', 'message_type', 'count'),
    [
        ('evt3_static', PACKET_TYPE, 517),
        ('libcaer_grid', PACKET_TYPE, 100),
        ('evt3_trigger_hd', PACKET_TYPE, 105),
        ('mono_legacy', 'event_array_msgs/msg/EventArray', 2),
    ],
)
def test_real_bags(data_folder: Path, name: str, message_type: str, count: int) -> None:
    with open_recording(data_folder / name) as bag:
        assert bag.topics() == [TopicInfo(TOPIC, message_type, count)]
        messages = list(bag.messages(TOPIC))
    assert len(messages) == count
    assert all(cdr[:2] == b'\x00\x01' for _, cdr in messages)
    times = [t_ns for t_ns, _ in messages]
    assert times == sorted(times)
