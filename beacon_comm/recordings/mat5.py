"""Numbers out of MATLAB files of version 5 to 7; scipy's reader, made for sound files, ends the process on some damaged ones.

    128 bytes: text, version 0x0100, 'IM' (little endian) or 'MI'       then elements:

    element   type32 size32 data…, padded to 8 bytes; up to 4 bytes of data:  size16 type16 data
    type 15   compressed by zlib: one element within
    type 14   a matrix: elements flags, dimensions, name, real part (of the smallest type that holds it), …

Source: MATLAB, *MAT-File Format* (2019), chapter 1.
"""

from __future__ import annotations

import math
import struct
import zlib
from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

HEADER_BYTES = 128
MOST_BYTES = 1 << 32
_MATRIX, _COMPRESSED = 14, 15
_TYPES = {1: 'i1', 2: 'u1', 3: 'i2', 4: 'u2', 5: 'i4', 6: 'u4', 7: 'f4', 9: 'f8', 12: 'i8', 13: 'u8'}
_CLASSES = {6: 'f8', 7: 'f4', 8: 'i1', 9: 'u1', 10: 'i2', 11: 'u2', 12: 'i4', 13: 'u4', 14: 'i8', 15: 'u8'}


def is_mat5(content: bytes) -> bool:
    """Tell whether a file has the head of version 5, in either order of bytes."""
    return content[124:128] in (b'\x00\x01IM', b'\x01\x00MI')


def variables(content: bytes) -> dict[str, NDArray[np.generic] | None]:
    """Return the variables of a file by name; None for those that are no full arrays of real numbers.

    Raises:
        ValueError: the file is damaged.
    """
    order = '<' if content[126:128] == b'IM' else '>'
    found: dict[str, NDArray[np.generic] | None] = {}
    for kind, data in _elements(content[HEADER_BYTES:], order):
        for inner, matrix in _elements(_unpacked(data), order) if kind == _COMPRESSED else [(kind, data)]:
            if inner == _MATRIX:
                name, value = _matrix(matrix, order)
                found[name] = value
    return found


def _unpacked(data: bytes) -> bytes:
    decompressor = zlib.decompressobj()
    try:
        unpacked = decompressor.decompress(data, MOST_BYTES)
    except zlib.error as error:
        raise ValueError(f'a variable cannot be decompressed ({error})') from error
    if not decompressor.eof:
        raise ValueError('a compressed variable ends before its end')
    return unpacked


def _elements(content: bytes, order: str) -> Iterator[tuple[int, bytes]]:
    at = 0
    while at < len(content):
        if at + 8 > len(content):
            raise ValueError('it ends within an element')
        kind, size = struct.unpack_from(order + 'II', content, at)
        start, stop = at + 8, at + 8 + size
        at = stop if kind == _COMPRESSED else (stop + 7) & ~7
        if kind >> 16:
            start, stop = start - 4, start - 4 + (kind >> 16)
            at = start + 4
            kind &= 0xFFFF
            if stop > at:
                raise ValueError('a short element is too long')
        if stop > len(content):
            raise ValueError('an element reaches beyond the end')
        yield kind, content[start:stop]


def _matrix(content: bytes, order: str) -> tuple[str, NDArray[np.generic] | None]:
    parts = _elements(content, order)
    try:
        (_, flags), (_, shape), (_, name) = next(parts), next(parts), next(parts)
    except StopIteration as error:
        raise ValueError('a variable without a name') from error
    if len(flags) < 4 or len(shape) % 4:
        raise ValueError('a variable with unsound flags or dimensions')
    (word,) = struct.unpack_from(order + 'I', flags)
    text = name.decode('latin-1')
    if word & 0xFF not in _CLASSES or word & 0x800:  # another class, or complex
        return text, None
    dimensions = struct.unpack(f'{order}{len(shape) // 4}i', shape)
    kind, data = next(parts, (0, b''))
    if kind not in _TYPES or len(data) != math.prod(dimensions) * int(_TYPES[kind][1]) or min(dimensions, default=-1) < 0:
        raise ValueError(f'{text} has not the numbers that its {dimensions} announce')
    numbers = np.frombuffer(data, order + _TYPES[kind]).astype(_CLASSES[word & 0xFF])
    return text, numbers.reshape(dimensions, order='F')
