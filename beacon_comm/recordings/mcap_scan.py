"""MCAP read from its beginning, without its index, which is at the end and missing where a recorder was killed.

    magic | opcode8 length64 content | opcode8 length64 content | … | magic

    1 header   3 schema   4 channel   5 message   6 chunk (records again, compressed)   2 footer, 15 data end

Schemas are taken for their name only, never parsed.  Source: mcap.dev/spec.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO
from zlib import crc32

from beacon_comm.recordings.compression import decompress

MAGIC = b'\x89MCAP0\r\n'
_SCHEMA, _CHANNEL, _MESSAGE, _CHUNK, _DATA_END = 3, 4, 5, 6, 15
_MAX_RECORD_BYTES = 1 << 32  # a length beyond this is damage, not data


@dataclass(frozen=True, slots=True)
class ScannedMessage:
    """One message: topic, type, recorded time (ns) and its bytes."""

    topic: str
    type: str
    recorded_ns: int
    content: bytes


def scan(path: Path) -> Iterator[ScannedMessage]:
    """Yield the messages of all topics in the order of the file.

    Raises:
        ValueError: the file is damaged from here on, or, at its end, chunks had to be left out; the text says how.
    """
    types: dict[int, str] = {}
    channels: dict[int, tuple[str, str]] = {}
    damage: ValueError | None = None
    with path.open('rb') as file:
        if file.read(len(MAGIC)) != MAGIC:
            raise ValueError('not an MCAP file')
        for opcode, content in _records(file):
            try:
                for inner_opcode, inner in _split(_decompressed(content)) if opcode == _CHUNK else [(opcode, content)]:
                    yield from _message(inner_opcode, inner, types, channels)
            except ValueError as error:  # the next record is where this one's length says
                damage = damage or error
    if damage is not None:
        raise damage


def _records(file: BinaryIO) -> Iterator[tuple[int, bytes]]:
    while True:
        head = file.read(9)
        if len(head) < 9:
            raise ValueError('the file ends before its data does')
        opcode, length = struct.unpack('<BQ', head)
        content = file.read(length) if length <= _MAX_RECORD_BYTES else b''
        if len(content) < length:
            raise ValueError('the file ends in the middle of a record')
        if opcode == _DATA_END:
            return
        yield opcode, content


def _split(chunk: bytes) -> Iterator[tuple[int, bytes]]:
    at = 0
    while at < len(chunk):
        opcode, length = _unpack('<BQ', chunk, at)
        at += 9
        if at + length > len(chunk):
            raise ValueError('a record reaches beyond its chunk')
        yield opcode, chunk[at : at + length]
        at += length


def _message(
    opcode: int, content: bytes, types: dict[int, str], channels: dict[int, tuple[str, str]]
) -> Iterator[ScannedMessage]:
    if opcode == _SCHEMA:
        (key,) = _unpack('<H', content, 0)
        types[key] = _text(content, 2)[0]
    elif opcode == _CHANNEL:
        key, schema = _unpack('<HH', content, 0)
        channels[key] = (_text(content, 4)[0], types.get(schema, ''))
    elif opcode == _MESSAGE:
        channel, _, recorded_ns, _ = _unpack('<HIQQ', content, 0)
        if channel not in channels:
            raise ValueError(f'a message of channel {channel}, which is not declared')
        topic, message_type = channels[channel]
        yield ScannedMessage(topic, message_type, recorded_ns, content[22:])


def _decompressed(content: bytes) -> bytes:
    _, _, size, checksum = _unpack('<QQQI', content, 0)
    compression, at = _text(content, 28)
    records = content[at + 8 :]
    if compression not in ('', 'zstd', 'lz4'):
        raise ValueError(f'chunk compression {compression!r} is not known')
    records = decompress(compression, records)
    if len(records) != size or (checksum and crc32(records) != checksum):
        raise ValueError('a chunk fails its checksum')
    return records


def _text(content: bytes, at: int) -> tuple[str, int]:
    (length,) = _unpack('<I', content, at)
    return content[at + 4 : at + 4 + length].decode('utf-8', 'replace'), at + 4 + length


def _unpack(layout: str, content: bytes, at: int) -> tuple[int, ...]:
    try:
        return struct.unpack_from(layout, content, at)
    except struct.error as error:
        raise ValueError(f'a record is too short ({error})') from error
