"""What bags compress with, undone within bounds: a few damaged bytes may announce any size."""

from __future__ import annotations

import bz2
import sys
from typing import Protocol

from lz4.frame import LZ4FrameDecompressor  # type: ignore[import-untyped]

if sys.version_info >= (3, 14):
    from compression import zstd
else:
    from backports import zstd

MOST_BYTES = 1 << 30
"""More than this is in no chunk and no message."""

_DECOMPRESSORS = {'zstd': zstd.ZstdDecompressor, 'lz4': LZ4FrameDecompressor, 'bz2': bz2.BZ2Decompressor}


class _Decompressor(Protocol):
    @property
    def eof(self) -> bool: ...
    @property
    def unused_data(self) -> bytes | None: ...
    def decompress(self, data: bytes, max_length: int = -1) -> bytes: ...


def decompress(compression: str, data: bytes) -> bytes:
    """Return what was compressed: ``zstd``, ``lz4`` or ``bz2``, of one or more frames; other names: as it is.

    Raises:
        ValueError: it is not such data, ends before its end, or is larger than ``MOST_BYTES``.
    """
    if compression not in _DECOMPRESSORS:
        return data
    parts: list[bytes] = []
    left = MOST_BYTES
    rest: bytes | None = data
    while rest or not parts:
        decompressor: _Decompressor = _DECOMPRESSORS[compression]()
        try:
            parts.append(decompressor.decompress(rest or b'', max_length=left))
        except (zstd.ZstdError, RuntimeError, OSError, EOFError) as error:
            raise ValueError(f'what is compressed by {compression} cannot be decompressed ({error})') from error
        left -= len(parts[-1])
        if not decompressor.eof:
            reason = 'is too large' if left <= 0 else 'ends before its end'
            raise ValueError(f'what is compressed by {compression} {reason}')
        rest = decompressor.unused_data
    return parts[0] if len(parts) == 1 else b''.join(parts)
