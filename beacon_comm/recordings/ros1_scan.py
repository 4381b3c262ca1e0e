"""ROS 1 bags read from their beginning, without their index, which is at the end and missing where a recorder was killed.

    #ROSBAG V2.0\\n | header data | header data | …             header: length, then fields "length name=value"
                                                                data:   length, then bytes

    op 2 message (in chunks)   3 bag header   4 index   5 chunk (records again, compressed)   6 chunk info   7 connection

A file that was not closed lacks its last chunks' ends and the index, often (``.bag.active``) all connections outside
of chunks; in every chunk stand the connections of its messages.  Source: wiki.ros.org/Bags/Format/2.0.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO

from beacon_comm.recordings.compression import decompress
from beacon_comm.recordings.mcap_scan import ScannedMessage

MAGIC = b'#ROSBAG V2.0\n'
_MESSAGE, _CHUNK, _CONNECTION = 2, 5, 7
_MAX_RECORD_BYTES = 1 << 31

Fields = dict[bytes, bytes]


def scan(path: Path) -> Iterator[ScannedMessage]:
    """Yield the messages of all connections in the order of the file; their content is ROS 1's.

    Raises:
        ValueError: the file is damaged from here on, or, at its end, chunks had to be left out; the text says how.
    """
    connections: dict[int, tuple[str, str]] = {}
    damage: ValueError | None = None
    with path.open('rb') as file:
        if file.read(len(MAGIC)) != MAGIC:
            raise ValueError('not a ROS 1 bag')
        for header, data in _records(file):
            try:
                if _op(header) == _CHUNK:
                    for inner_header, inner in _split(_decompressed(header, data)):
                        yield from _message(inner_header, inner, connections)
                else:
                    yield from _message(header, data, connections)
            except ValueError as error:  # the next record is where this one's length says
                damage = damage or error
    if damage is not None:
        raise damage


def _records(file: BinaryIO) -> Iterator[tuple[Fields, bytes]]:
    while length := file.read(4):
        header = _take(file, length)
        yield _fields(header), _take(file, file.read(4))


def _take(file: BinaryIO, length: bytes) -> bytes:
    if len(length) < 4:
        raise ValueError('the file ends in the middle of a record')
    (count,) = struct.unpack('<I', length)
    content = file.read(count) if count <= _MAX_RECORD_BYTES else b''
    if len(content) < count:
        raise ValueError('the file ends in the middle of a record')
    return content


def _split(chunk: bytes) -> Iterator[tuple[Fields, bytes]]:
    at = 0
    while at < len(chunk):
        header, at = _sized(chunk, at)
        data, at = _sized(chunk, at)
        yield _fields(header), data


def _sized(content: bytes, at: int) -> tuple[bytes, int]:
    """Return the bytes behind their length at ``at``, and the place behind them."""
    if at + 4 > len(content):
        raise ValueError('a record is too short')
    (length,) = struct.unpack_from('<I', content, at)
    stop = at + 4 + length
    if stop > len(content):
        raise ValueError('a record reaches beyond what holds it')
    return content[at + 4 : stop], stop


def _fields(header: bytes) -> Fields:
    fields: Fields = {}
    at = 0
    while at < len(header):
        entry, at = _sized(header, at)
        name, _, value = entry.partition(b'=')
        fields[name] = value
    return fields


def _number(fields: Fields, name: bytes, layout: str = '<I') -> int:
    value = fields.get(name, b'')
    if len(value) != struct.calcsize(layout):
        raise ValueError(f'a record without a sound {name.decode()}')
    number: int = struct.unpack(layout, value)[0]
    return number


def _op(fields: Fields) -> int:
    return _number(fields, b'op', '<B')


def _text(fields: Fields, name: bytes) -> str:
    return fields.get(name, b'').decode('utf-8', 'replace')


def _message(header: Fields, data: bytes, connections: dict[int, tuple[str, str]]) -> Iterator[ScannedMessage]:
    op = _op(header)
    if op == _CONNECTION:
        package, _, name = _text(_fields(data), b'type').partition('/')
        message_type = f'{package}/msg/{name.removeprefix("msg/")}'
        connections[_number(header, b'conn')] = (_text(header, b'topic'), message_type)
    elif op == _MESSAGE:
        key = _number(header, b'conn')
        if key not in connections:
            raise ValueError(f'a message of connection {key}, which is not declared')
        time = _number(header, b'time', '<Q')
        recorded_ns = (time & 0xFFFF_FFFF) * 1_000_000_000 + (time >> 32)
        yield ScannedMessage(*connections[key], recorded_ns, data)


def _decompressed(header: Fields, data: bytes) -> bytes:
    compression = _text(header, b'compression')
    if compression not in ('none', 'bz2', 'lz4'):
        raise ValueError(f'chunk compression {compression!r} is not known')
    return decompress(compression, data)
