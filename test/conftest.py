"""Shared fixtures: the folder of real recordings, by ``BEACON_COMM_DATA`` or beside the project."""

import os
from pathlib import Path

import pytest

from beacon_comm.compiling.cache import ensure_compiler_cache, save_one_at_a_time
from beacon_comm.recordings.folder import recordings_folder

ensure_compiler_cache()  # before anything imports numba
save_one_at_a_time()



@pytest.fixture(scope='session')
def data_folder() -> Path:
    """Return the folder of real recordings; skip without it, fail without it on CI."""
    folder = recordings_folder()
    if folder.is_dir():
        return folder
    if os.environ.get('CI', '').lower() == 'true':
        pytest.fail(f'the recordings are missing on CI: {folder}')
    pytest.skip(f'no recordings at {folder}; set BEACON_COMM_DATA')
