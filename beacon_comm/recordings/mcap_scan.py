"""MCAP read from its beginning, without its summary, which is at the end and missing where a recorder was killed.

    magic | opcode8 length64 content | opcode8 length64 content | … | magic

    1 header   3 schema   4 channel   5 message   6 chunk (records again, compressed)   15 data end
    then the summary: 3 schema   4 channel   8 chunk index   2 footer, the last record

Once something is damaged, the summary, if there is one, says what there is: where a record cannot be followed, reading goes on
at the next chunk that it names.

Schemas are taken for their name only, never parsed.  Source: mcap.dev/spec.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from dataclasses import dataclass
from os import SEEK_END
from pathlib import Path
from typing import BinaryIO
from zlib import crc32

from beacon_comm.recordings.compression import decompress

MAGIC = b'\x89MCAP0\r\n'
_FOOTER, _SCHEMA, _CHANNEL, _MESSAGE, _CHUNK, _CHUNK_INDEX, _DATA_END = 2, 3, 4, 5, 6, 8, 15
_HEAD_BYTES, _FOOTER_BYTES = 9, 9 + 20 + len(MAGIC)
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
        ValueError: at the end of what could be read, if something could not; the text says how the damage begins.
    """
    types: dict[int, str] = {}
    channels: dict[int, tuple[str, str]] = {}
    chunks: list[tuple[int, int]] = []
    tried: set[tuple[int, int]] = set()
    damage: ValueError | None = None
    with path.open('rb') as file:
        if file.read(len(MAGIC)) != MAGIC:
            raise ValueError('not an MCAP file')
        read_to = file.tell()
        length: int | None = None
        while True:
            start, stop = file.tell(), None
            try:
                opcode, content = _record(file, length)
                stop = file.tell()
                if opcode == _DATA_END:
                    break
                if opcode == _CHUNK:
                    tried.add((start, len(content)))
                for inner_opcode, inner in _split(_decompressed(content)) if opcode == _CHUNK else [(opcode, content)]:
                    yield from _message(inner_opcode, inner, types, channels)
                if opcode in (_CHUNK, _MESSAGE):
                    read_to = stop
            except ValueError as error:
                if damage is None:
                    damage, chunks = error, _summary(file, types, channels)
            length = None
            if stop is None:  # it cannot be followed: perhaps a length before it was wrong
                left = [chunk for chunk in chunks if chunk[0] >= read_to and chunk not in tried]
                if not left:
                    break
                stop, length = left[0]
                tried.add(left[0])
            file.seek(stop)
    if damage is not None:
        raise damage


def _record(file: BinaryIO, known_length: int | None) -> tuple[int, bytes]:
    """Read the record that begins here; ``known_length`` replaces the length that it says it has."""
    head = file.read(_HEAD_BYTES)
    if len(head) < _HEAD_BYTES:
        raise ValueError('the file ends before its data does')
    opcode, length = struct.unpack('<BQ', head)
    length = length if known_length is None else known_length
    content = file.read(length) if length <= _MAX_RECORD_BYTES else b''
    if len(content) < length:
        raise ValueError('the file ends in the middle of a record')
    return opcode, content


def _summary(file: BinaryIO, types: dict[int, str], channels: dict[int, tuple[str, str]]) -> list[tuple[int, int]]:
    """Return where the chunks are and how long their contents, in order; take the types and channels.  Nothing without one."""
    chunks: list[tuple[int, int]] = []
    try:
        end = file.seek(0, SEEK_END) - _FOOTER_BYTES
        file.seek(max(0, end))
        footer = file.read(_FOOTER_BYTES)
        opcode, _, begin = _unpack('<BQQ', footer, 0)
        if opcode != _FOOTER or not footer.endswith(MAGIC) or not 0 < begin <= end:
            return []
        file.seek(begin)
        for opcode, content in _split(file.read(end - begin)):
            if opcode == _CHUNK_INDEX:
                _, _, at, size = _unpack('<QQQQ', content, 0)
                if size > _HEAD_BYTES and at + size <= begin:
                    chunks.append((at, size - _HEAD_BYTES))
            elif opcode in (_SCHEMA, _CHANNEL):
                list(_message(opcode, content, types, channels))
    except ValueError:
        pass  # it is damaged, too: what it says up to there
    return sorted(chunks)


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
