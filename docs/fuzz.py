#!/usr/bin/env python3
"""Feed every reader what was never meant to be read; print what it was counted as.

    python docs/fuzz.py                               # a million messages, some minutes
    python docs/fuzz.py --count 20000 --seed 3
    python docs/fuzz.py --guided 20000 --count 0      # the search for paths alone

::

    samples ──► search: decoders in plain Python, a mutation that reaches a new branch is kept ──► corpus
                                                                                                     │
    corpus ──► mutations of messages, payloads and headers, and plain noise ──► compiled decoders, bounds checked

Two processes: the first has numba off, so that Python itself sees every line of the decoders and refuses an index
beyond an array, and one below it; the second has numba's bounds checks on.  Of every message it is held that nothing is
raised, that times do not step back, and that no event lies outside the sensor; of every file, that the only error is the
one that the tools show; of the process, that its memory does not grow.
"""

from __future__ import annotations

import argparse
import os
import pickle
import random
import struct
import subprocess
import sys
import tempfile
import time
import warnings
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from types import CodeType
from typing import Any

import numpy as np
from tqdm import tqdm

sys.path.insert(0, str(Path(__file__).resolve().parent))  # PYTHONSAFEPATH leaves it out

from resident_memory import growth, resident_mib  # noqa: E402

PACKET, FORMER_PACKET = 'event_camera_msgs/msg/EventPacket', 'event_array_msgs/msg/EventArray'
ARRAYS = ('dvs_msgs/msg/EventArray', 'prophesee_event_msgs/msg/EventArray', 'dv_ros2_msgs/msg/EventArray')
ENCODINGS = ('evt3', 'libcaer_cmp', 'libcaer', 'mono')
MESSAGES_OF_A_STREAM = 40
LIVE_SHARE, FILE_SHARE = 0.005, 0.005
"""So much of the count goes through the whole live receiver, and into files."""
EDGES = (0, 1, 2, 0x7F, 0x80, 0xFF, 0x7FFF, 0x8000, 0xFFFF, 0x7FFFFFFF, 0x80000000, 0xFFFFFFFF, 2**62, 2**63, 2**64 - 1)
Sample = tuple[str, bytes]


def samples() -> list[Sample]:
    """Return sound messages of every type and encoding, as ``(type, CDR)``."""
    from beacon_comm.wire.cdr import build_event_array, build_event_packet

    def packet(encoding: str, payload: bytes, seq: int, base_ns: int = 0) -> bytes:
        return build_event_packet(10**9 + seq * 10**7, 'cam', 640, 480, seq, base_ns, encoding, payload)

    found: list[Sample] = []
    for seq in range(4):
        words = [0x8000 | 100 + 3 * seq, 0x6005, 5, 0x2807, 0x3801, 0x4FFF, 0x50F3, 0xA001, 0xE123, 0x7001]
        words += [0x8065 + 3 * seq, 0x6001, 0x2003]
        found.append((PACKET, packet('evt3', struct.pack('<13H', *words), seq)))
        words = [0x2001, seq, 0x1003, 0x3801, 0x4001, 0x50FF, 0x5003, 0x7000, 0x0002, 0x3003]
        found.append((PACKET, packet('libcaer_cmp', struct.pack('<10H', *words), seq, 10**12 + seq * 10**7)))
        halves = [3 << 17 | 2, 5 + seq, 1 << 17 | 8, 6 + seq, 0, 7 + seq, 0, 2**31 + 8]
        found.append((PACKET, packet('libcaer', struct.pack('<8I', *halves), seq, 10**12 + seq * 10**7)))
        longs = [5, 1 << 63 | 3 << 48 | 2 << 32 | 7, 9]
        found.append((FORMER_PACKET, packet('mono', struct.pack('<3Q', *longs), seq, 10**12 + seq * 10**7)))
        columns = [np.array(column) for column in ([1, 2, 9], [3, 4, 9], [1, -1, 1], [0, 5, 10**8])]
        columns[3] = columns[3] + 2**40 + seq * 10**9
        found += [(name, build_event_array(9, 'cam', 346, 260, *columns)) for name in ARRAYS]
    return found


class Mutator:
    """Makes damaged messages out of samples."""

    def __init__(self, seed: int, corpus: list[Sample]) -> None:
        self._random = random.Random(seed)
        self.corpus = corpus

    def message(self) -> Sample:
        """Return one more message."""
        kind = self._random.random()
        message_type, cdr = self._random.choice(self.corpus)
        if kind < 0.45:
            return message_type, self.mutated(cdr)
        if kind < 0.85:
            return message_type, self._with_payload(message_type, cdr)
        head = self._random.choice((b'', b'\x00\x01\x00\x00', cdr[: self._random.randrange(len(cdr) + 1)]))
        return message_type, head + self._random.randbytes(self._random.randrange(200))

    def mutated(self, content: bytes) -> bytes:
        """Return content with one to six changes."""
        changed = bytearray(content)
        for _ in range(self._random.randint(1, 6)):
            self._random.choice(self._changes)(self, changed)
        return bytes(changed)

    def _with_payload(self, message_type: str, cdr: bytes) -> bytes:
        """Return a message with a sound head and a payload that is not."""
        from beacon_comm.wire.cdr import build_event_array, build_event_packet

        rnd = self._random
        if message_type in ARRAYS:
            n = rnd.randrange(20)
            columns = [[rnd.choice((rnd.randrange(1 << 16), rnd.randrange(300))) for _ in range(n)] for _ in range(2)]
            t_ns = [rnd.randrange(-(2**60), 2**60) if rnd.random() < 0.1 else 2**40 + rnd.randrange(10**6) for _ in range(n)]
            polarity = [rnd.choice((-1, 1)) for _ in range(n)]
            arrays = [np.array(column, np.int64) for column in (*columns, polarity, t_ns)]
            return build_event_array(rnd.randrange(10**9), 'cam', 346, 260, *arrays)
        encoding = rnd.choice(ENCODINGS)
        if rnd.random() < 0.5:
            payload = rnd.randbytes(rnd.randrange(120))
        else:  # words of few kinds, so that states are reached
            codes = [rnd.randrange(16) for _ in range(4)]
            low = [rnd.choice((rnd.randrange(4096), rnd.randrange(8))) for _ in range(rnd.randrange(60))]
            words = [rnd.choice(codes) << 12 | bits for bits in low]
            payload = struct.pack(f'<{len(words)}H', *words)
        stamp_ns = rnd.choice((0, 10**9 + rnd.randrange(10**8), rnd.randrange(-(2**60), 2**60)))
        size = rnd.choice(((640, 480), (64, 48), (1, 1), (4096, 4096), (1280, 720)))
        seq = rnd.choice((rnd.randrange(20), rnd.randrange(2**64)))
        return build_event_packet(stamp_ns, 'cam', *size, seq, rnd.choice((0, 10**12, 2**62)), encoding, payload)

    def _flip(self, content: bytearray) -> None:
        if content:
            content[self._random.randrange(len(content))] ^= 1 << self._random.randrange(8)

    def _set(self, content: bytearray) -> None:
        width = self._random.choice((1, 2, 4, 8))
        if len(content) >= width:
            at = self._random.randrange(len(content) - width + 1) // width * width
            content[at : at + width] = (self._random.choice(EDGES) & (1 << 8 * width) - 1).to_bytes(width, 'little')

    def _cut(self, content: bytearray) -> None:
        del content[self._random.randrange(len(content) + 1) :]

    def _grow(self, content: bytearray) -> None:
        at = self._random.randrange(len(content) + 1)
        content[at:at] = self._random.randbytes(self._random.choice((1, 2, 4, 8, 16)))

    def _repeat(self, content: bytearray) -> None:
        start = self._random.randrange(len(content) + 1)
        content[start:start] = content[start : start + self._random.randrange(1, 32)]

    def _splice(self, content: bytearray) -> None:
        _, other = self._random.choice(self.corpus)
        at = self._random.randrange(len(content) + 1)
        content[at:] = other[min(at, len(other)) :]

    _changes: tuple[Callable[[Mutator, bytearray], None], ...] = (_flip, _flip, _set, _set, _cut, _grow, _repeat, _splice)


@dataclass
class Readers:
    """One stream of each type, each renewed now and then, and what they counted.

    Attributes:
        counts: of all streams, by type.
    """

    counts: dict[str, Counter[str]] = field(default_factory=dict)
    _streams: dict[str, Any] = field(default_factory=dict)
    _ends_ns: dict[str, int | None] = field(default_factory=dict)

    def read(self, message_type: str, cdr: bytes) -> None:
        """Read a message, and hold what comes out of it to its promises.

        Raises:
            AssertionError: a promise is broken.
        """
        from beacon_comm.wire.stream import EventStream

        stream = self._streams.get(message_type)
        if stream is None or stream.counts['packets'] == MESSAGES_OF_A_STREAM:
            self.finish(message_type)
            stream = self._streams[message_type] = EventStream(message_type)
            self._ends_ns[message_type] = None
        decoded = stream.push(cdr)
        batch = decoded.batch
        assert (decoded.problem is None) == (decoded.problem_kind is None)
        if decoded.restarted:
            self._ends_ns[message_type] = None
        if batch is None:
            return
        t_ns, end_ns = batch.t_ns, self._ends_ns[message_type]
        if len(t_ns):
            assert (t_ns[1:] >= t_ns[:-1]).all() and t_ns[-1] <= batch.t_end_ns
            assert batch.x.max() < decoded.width and batch.y.max() < decoded.height
            assert end_ns is None or t_ns[0] >= end_ns
        assert end_ns is None or batch.t_end_ns >= end_ns
        self._ends_ns[message_type] = batch.t_end_ns

    def finish(self, message_type: str) -> None:
        """Add up what the present stream of a type has counted."""
        if message_type in self._streams:
            self.counts.setdefault(message_type, Counter()).update(self._streams[message_type].counts)


# --- the search for paths, with the decoders in plain Python ---


class NoNegative(np.ndarray):
    """An array that refuses the indices that Python takes from the end and compiled code from before the beginning."""

    def __getitem__(self, key: Any) -> Any:
        """Return an entry.

        Raises:
            IndexError: it lies before the first.
        """
        if isinstance(key, (int, np.integer)) and key < 0:
            raise IndexError(f'index {key}')
        return super().__getitem__(key)

    def __setitem__(self, key: Any, value: Any) -> None:
        """Set an entry.

        Raises:
            IndexError: it lies before the first.
        """
        if isinstance(key, (int, np.integer)) and key < 0:
            raise IndexError(f'index {key}')
        super().__setitem__(key, value)


def guard_the_decoders() -> None:
    """Give the decoders arrays that refuse negative indices."""
    from beacon_comm.wire import event_array, evt3, libcaer, mono, reading

    plain = reading.words_of

    def guarded(*arguments: Any) -> Any:
        return plain(*arguments).view(NoNegative)

    for module in (event_array, evt3, libcaer, mono):
        module.words_of = guarded  # type: ignore[attr-defined]


@contextmanager
def branches_seen(seen: set[tuple[CodeType, int, int]]) -> Iterator[None]:
    """Add the branches that are taken in ``beacon_comm.wire`` to a set, each of which costs only the first time."""
    monitoring = sys.monitoring
    tool = monitoring.COVERAGE_ID
    monitoring.use_tool_id(tool, 'fuzz')

    def on_branch(code: CodeType, offset: int, to: int) -> object:
        if 'beacon_comm/wire' not in code.co_filename:
            return monitoring.DISABLE
        seen.add((code, offset, to))
        return None

    monitoring.register_callback(tool, monitoring.events.BRANCH, on_branch)
    monitoring.set_events(tool, monitoring.events.BRANCH)
    try:
        yield
    finally:
        monitoring.set_events(tool, 0)
        monitoring.free_tool_id(tool)


def search(count: int, seed: int, quiet: bool = False) -> tuple[list[Sample], int]:
    """Mutate for ``count`` messages and keep what reaches new branches; return the corpus and the number of branches."""
    guard_the_decoders()
    mutator = Mutator(seed, samples())
    readers = Readers()
    seen: set[tuple[CodeType, int, int]] = set()
    with branches_seen(seen), np.errstate(all='ignore'):
        for message_type, cdr in mutator.corpus:
            readers.read(message_type, cdr)
        for _ in tqdm(range(count), 'search', disable=quiet):
            before = len(seen)
            sample = mutator.message()
            read_or_show(readers, sample)
            if len(seen) > before:
                mutator.corpus.append(sample)
    return mutator.corpus, len(seen)


# --- many messages, with the decoders compiled ---


def read_or_show(readers: Readers, sample: Sample) -> None:
    """Read a message; show the one that breaks a promise."""
    try:
        readers.read(*sample)
    except Exception:
        print(f'{sample[0]}: {sample[1].hex()}', file=sys.stderr)
        raise


def hammer(count: int, seed: int, corpus: list[Sample], quiet: bool = False) -> tuple[Readers, list[float]]:
    """Read ``count`` messages; return the readers and the process's size (MiB) at every tenth of them."""
    mutator, readers, sizes = Mutator(seed, corpus), Readers(), []
    for k in tqdm(range(count), 'messages', disable=quiet):
        read_or_show(readers, mutator.message())
        if (k + 1) % max(count // 10, 1) == 0:
            sizes.append(resident_mib())
    for message_type in (PACKET, FORMER_PACKET, *ARRAYS):
        readers.finish(message_type)
    return readers, sizes


def through_the_receiver(count: int, seed: int, corpus: list[Sample], quiet: bool = False) -> Counter[str]:
    """Push messages through live receivers, detection and all; return what they counted."""
    from beacon_comm.core.parameters import Parameters
    from beacon_comm.ros.live import LiveReceiver

    mutator, rnd = Mutator(seed, corpus), random.Random(seed)
    counts: Counter[str] = Counter()
    now_ns = 10**9
    live: dict[str, LiveReceiver] = {}
    for k in tqdm(range(count), 'live', disable=quiet):
        message_type, cdr = mutator.message()
        if message_type not in live or k % (5 * MESSAGES_OF_A_STREAM) == 0:
            live[message_type] = LiveReceiver(Parameters(), 50_000_000, 100_000_000)
            live[message_type].open(message_type, now_ns)
        one = live[message_type]
        now_ns += rnd.choice((0, 10**6, 10**7, 10**9))
        if rnd.random() < 0.1:
            one.shed(now_ns)
        step = one.push(cdr, now_ns)
        counts[step.problem_kind or 'read'] += 1
        one.tick(now_ns + 10**8, 10**8)
    return counts


# --- files ---


def sound_files(folder: Path) -> list[Path]:
    """Write a small sound file of every kind that the tools read."""
    from rosbags import rosbag1, rosbag2
    from scipy.io import savemat

    from beacon_comm.recordings.interfaces import definition_text

    messages = [cdr for message_type, cdr in samples() if message_type == PACKET]
    files = []
    for plugin, mode in (
        (rosbag2.StoragePlugin.SQLITE3, rosbag2.CompressionMode.NONE),
        (rosbag2.StoragePlugin.SQLITE3, rosbag2.CompressionMode.MESSAGE),
        (rosbag2.StoragePlugin.MCAP, rosbag2.CompressionMode.NONE),
        (rosbag2.StoragePlugin.MCAP, rosbag2.CompressionMode.STORAGE),
        (rosbag2.StoragePlugin.MCAP, rosbag2.CompressionMode.FILE),
    ):
        bag = folder / f'{plugin.name}_{mode.name}'
        writer = rosbag2.Writer(bag, version=8, storage_plugin=plugin)
        writer.set_compression(mode, rosbag2.CompressionFormat.ZSTD)
        with writer:
            connection = writer.add_connection('/events', PACKET, msgdef=definition_text(PACKET), rihs01='RIHS01_' + 64 * '0')
            for k, cdr in enumerate(messages):
                writer.write(connection, 1000 + k, cdr)
        files += [file for file in bag.iterdir() if file.name != 'metadata.yaml']
    for packing in (None, *rosbag1.Writer.CompressionFormat):
        file = folder / f'{packing.name if packing else "plain"}.bag'
        ros1 = rosbag1.Writer(file)
        if packing is not None:
            ros1.set_compression(packing)
        with ros1:
            connection1 = ros1.add_connection('/events', PACKET, msgdef=definition_text(PACKET), md5sum=32 * '0')
            raw = struct.pack('<IIII', 0, 5, 6, 0) + struct.pack('<II', 480, 640) + struct.pack('<QQ', 1, 2)
            for k in range(8):
                ros1.write(connection1, k, raw + struct.pack('<I', 4) + b'evt3' + b'\x00' + struct.pack('<I', 3) + b'abc')
        files.append(file)
    for compressed in (False, True):
        file = folder / f'signal_{compressed}.mat'
        t_s = np.arange(50)[None] * 1e-3
        savemat(file, {'event': np.ones((1, 50), np.int8), 'event_t': t_s}, do_compression=compressed)
        files.append(file)
    return files


def read_files(count: int, seed: int, quiet: bool = False) -> dict[str, Counter[str]]:
    """Read ``count`` damaged files; return by kind how they ended."""
    from beacon_comm.core.errors import RecordingError
    from beacon_comm.recordings.bags import open_recording
    from beacon_comm.recordings.mat import read_mat
    from beacon_comm.wire.stream import EventStream

    rnd = random.Random(seed)
    counts: dict[str, Counter[str]] = {}
    with tempfile.TemporaryDirectory(prefix='fuzz_') as name, warnings.catch_warnings():
        warnings.simplefilter('ignore')  # scipy's, of headers
        folder = Path(name)
        sound = [(file, file.read_bytes()) for file in sound_files(folder)]
        mutator = Mutator(seed, [('', content) for _, content in sound])
        for _ in tqdm(range(count), 'files', disable=quiet):
            file, content = rnd.choice(sound)
            damaged = folder / f'damaged{"".join(file.suffixes)}'
            damaged.write_bytes(mutator.mutated(content))
            tally = counts.setdefault(file.suffix if file.suffix != '.zstd' else '.mcap.zstd', Counter())
            read = 0
            try:
                if file.suffix == '.mat':
                    read = len(read_mat(damaged)[0])
                else:
                    with open_recording(damaged) as bag:
                        topic = bag.event_topic()
                        stream = EventStream(topic.type)
                        for _, cdr in bag.messages(topic):
                            stream.push(cdr)
                            read += 1
                tally['read'] += 1
            except RecordingError:
                tally['read in part' if read else 'refused'] += 1
            except Exception:
                kept = Path(tempfile.gettempdir()) / f'fuzz_failed{"".join(file.suffixes)}'
                kept.write_bytes(damaged.read_bytes())
                print(f'kept: {kept}', file=sys.stderr)
                raise
    return counts


# --- the command ---


def table(title: str, counts: dict[str, Counter[str]]) -> str:
    """Return counts as a Markdown table, kinds down, readers across; kinds that never came are left out."""
    kinds = dict.fromkeys(kind for counter in counts.values() for kind in counter if counter[kind])
    lines = [f'| {title} | ' + ' | '.join(counts) + ' |', '|---' * (len(counts) + 1) + '|']
    lines += [f'| {kind} | ' + ' | '.join(str(counter[kind]) for counter in counts.values()) + ' |' for kind in kinds]
    return '\n'.join(lines) + '\n'


def run_search(count: int, seed: int, corpus_file: Path) -> None:
    """Run the search in a process of its own, with numba off."""
    command = [sys.executable, '-P', __file__, '--guided', str(count), '--count', '0', '--seed', str(seed)]
    environment = {**os.environ, 'NUMBA_DISABLE_JIT': '1'}
    subprocess.run([*command, '--write-corpus', str(corpus_file)], env=environment, check=True)


def run_checked() -> None:
    """Become a process whose compiled code checks its bounds, with a cache of its own."""
    if os.environ.get('NUMBA_BOUNDSCHECK') != '1':
        folder = Path(tempfile.gettempdir()) / f'beacon_comm_bounds_{os.getuid()}'
        environment = {**os.environ, 'NUMBA_BOUNDSCHECK': '1', 'NUMBA_CACHE_DIR': str(folder)}
        os.execve(sys.executable, [sys.executable, '-P', *sys.argv], environment)


def main() -> int:
    """Search, hammer, and print the tables."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else '')
    parser.add_argument('--count', type=int, default=1_000_000, help='messages (default: %(default)s)')
    parser.add_argument('--guided', type=int, default=20_000, help='messages of the search (default: %(default)s)')
    parser.add_argument('--seed', type=int, default=1, help='of the random numbers (default: %(default)s)')
    parser.add_argument('--write-corpus', type=Path, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.write_corpus:
        corpus, branches = search(options.guided, options.seed)
        options.write_corpus.write_bytes(pickle.dumps(corpus))
        print(f'search: {branches} branches of the decoders after {options.guided} messages, {len(corpus)} messages kept')
        return 0
    run_checked()
    with tempfile.TemporaryDirectory(prefix='fuzz_') as folder:
        corpus_file = Path(folder) / 'corpus'
        run_search(options.guided, options.seed, corpus_file)
        corpus = pickle.loads(corpus_file.read_bytes())
    if options.count == 0:
        return 0
    begin_s = time.monotonic()
    readers, sizes = hammer(options.count, options.seed, corpus)
    live = through_the_receiver(round(LIVE_SHARE * options.count), options.seed, corpus)
    files = read_files(round(FILE_SHARE * options.count), options.seed)
    print(f'{options.count} messages, {sum(live.values())} of them again through the receiver,', end=' ')
    print(f'{sum(map(sum, (c.values() for c in files.values())))} files: {time.monotonic() - begin_s:.0f} s, nothing raised\n')
    print(table('messages', readers.counts))
    print(table('receiver', {'all types': live}))
    print(table('files', files))
    print(f'memory held (MiB), at every tenth of the messages: {", ".join(f"{size:.0f}" for size in sizes)}')
    problems = growth(sizes)
    for problem in problems:
        print(f'broken: {problem}')
    return 1 if problems else 0


if __name__ == '__main__':
    sys.exit(main())
