"""What was never meant to be read, a few thousand times, and beacons that come and go: short runs of docs/fuzz.py and
docs/endurance.py."""

from __future__ import annotations

import os
import pickle
import subprocess
import sys
from pathlib import Path

import pytest
from docs_script import DOCS, load

fuzz = load('fuzz')
endurance = load('endurance')


@pytest.fixture(scope='module')
def corpus(tmp_path_factory: pytest.TempPathFactory) -> list[tuple[str, bytes]]:
    """Search for paths through the decoders, which are plain Python there and see no index outside an array."""
    file = tmp_path_factory.mktemp('fuzz') / 'corpus'
    arguments = ['--guided', '2000', '--seed', '5', '--write-corpus', str(file)]
    done = subprocess.run(
        [sys.executable, '-P', str(DOCS / 'fuzz.py'), *arguments],
        env={**os.environ, 'NUMBA_DISABLE_JIT': '1'}, capture_output=True, text=True,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr[-2000:]
    found: list[tuple[str, bytes]] = pickle.loads(file.read_bytes())
    return found


def test_messages(corpus: list[tuple[str, bytes]]) -> None:
    assert len(corpus) > len(fuzz.samples()) + 10, 'nothing new was found on the way'
    readers, _ = fuzz.hammer(4000, 6, corpus, quiet=True)
    assert sum(counts['packets'] for counts in readers.counts.values()) == 4000
    assert all(counts['events'] and counts['bad_messages'] for counts in readers.counts.values())


def test_messages_through_the_receiver(corpus: list[tuple[str, bytes]]) -> None:
    counts = fuzz.through_the_receiver(300, 7, corpus, quiet=True)
    assert sum(counts.values()) == 300 and counts['read'] > 100 and counts['bad_messages'] > 50


def test_files(tmp_path: Path) -> None:
    counts = fuzz.read_files(150, 8, quiet=True)
    assert sum(sum(tally.values()) for tally in counts.values()) == 150
    assert set(counts) == {'.db3', '.mcap', '.mcap.zstd', '.bag', '.mat'}
    assert all(tally['read'] + tally['refused'] + tally['read in part'] for tally in counts.values())


def test_memory_that_grows_is_a_broken_promise() -> None:
    assert endurance.growth([657, 670, 660, 672, 676, 675, 667, 683, 680, 661, 671, 674]) == []
    assert endurance.growth([600.0 + 10.0 * k for k in range(12)]) and not endurance.growth([1.0, 2.0, 3.0])


def test_beacons_come_and_go() -> None:
    tally = endurance.run(0.4, 3, quiet=True)
    assert tally.problems == []
    assert len(tally.read) >= tally.counts['beacons'] - 1 > 3
    assert tally.counts['right'] > 1000 > 100 * tally.counts['wrong']
