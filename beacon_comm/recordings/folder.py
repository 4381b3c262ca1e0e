"""Where the real recordings are, which are no part of this project."""

from __future__ import annotations

import os
from pathlib import Path

PROJECT = Path(__file__).resolve().parents[2]


def recordings_folder() -> Path:
    """Return the folder of the real recordings: ``BEACON_COMM_DATA``, by default ``../shared/data`` beside the project."""
    return Path(os.environ.get('BEACON_COMM_DATA', PROJECT.parent / 'shared' / 'data'))
