#!/usr/bin/env python3
"""Time every receiver's demodulation alone over the real 30 m recordings; print Markdown tables.

    python docs/benchmark_demodulators.py [--folder ../shared/data] [--repeats 5]            # a few minutes

Events of one beacon in, characters out: no message, no detection, no slot.  The stream is handed over in packets::

    packets    |····|····|····|····|····|····|····|····|        1, 10, 100 ms, or the whole recording at once
    lock       └───────────────┘ bit rate settled
    included   └───────────────────────────────────────┘
    excluded                    └──────────────────────┘        for the whole one: 100 ms until it has locked, then the rest

The ratio is that of the times an event to a reference loop's, which runs just before each measurement: compiled, one
multiplication and addition an event.  Figures are medians over the repeats, time is processor time.
"""

from __future__ import annotations

import argparse
import platform
import time
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numba
import numpy as np
from numpy.typing import NDArray

from beacon_comm.core.demodulator import Demodulator, make_demodulator
from beacon_comm.core.events import NS_PER_S
from beacon_comm.core.parameters import Parameters
from beacon_comm.evaluation.receivers import declared_receivers
from beacon_comm.recordings.folder import recordings_folder
from beacon_comm.recordings.mat import read_mat

RECORDINGS = {'504hz_30m.mat': 504.0, '3125hz_30m.mat': 3125.0}
SEVERAL_BPS = (100.0, 504.0, 1000.0, 3125.0, 10_000.0)
PACKETS_NS = {'1 ms': 1_000_000, '10 ms': 10_000_000, '100 ms': 100_000_000, 'whole': None}
LEAD_NS = 100_000_000

Events = tuple[NDArray[np.int64], NDArray[np.int8]]
Packet = tuple[NDArray[np.int64], NDArray[np.int8], int]


@numba.njit
def reference_loop(polarity: NDArray[np.int8]) -> float:
    """Add up the polarities with a fading memory: the least that a filter of the events can cost."""
    state = 0.0
    for k in range(len(polarity)):
        state = 0.999 * state + polarity[k]
    return state


@dataclass(frozen=True, slots=True)
class Timing:
    """One run over a recording.

    Attributes:
        included_s, included_events: processor time (s) and events of all of it.
        excluded_s, excluded_events: the same after the lock; 0 events if it never locked.
        lock_s: stream time until the bit rate was settled (s), None if it never was.
        reference_ns: what an event cost in the reference loop just before (ns).
        characters: how many were given out.
    """

    included_s: float
    included_events: int
    excluded_s: float
    excluded_events: int
    lock_s: float | None
    reference_ns: float
    characters: int


def packets(events: Events, packet_ns: int | None, start: int = 0) -> list[Packet]:
    """Cut events from ``start`` on into packets of ``packet_ns`` (ns), None: one."""
    t_ns, polarity = events
    end_ns = int(t_ns[-1]) + 1
    cuts_ns = [] if packet_ns is None else list(range(int(t_ns[start]) + packet_ns, end_ns, packet_ns))
    stops = [*(int(stop) for stop in np.searchsorted(t_ns, cuts_ns)), len(t_ns)]
    starts = [start, *stops[:-1]]
    return [(t_ns[a:b], polarity[a:b], cut) for a, b, cut in zip(starts, stops, [*cuts_ns, end_ns], strict=True)]


def reference_ns(polarity: NDArray[np.int8]) -> float:
    """Return what an event costs in the reference loop (ns)."""
    begun = time.process_time()
    reference_loop(polarity)
    return (time.process_time() - begun) * NS_PER_S / len(polarity)


def push(demodulator: Demodulator, some: Iterable[Packet]) -> int:
    """Push packets; return the number of characters."""
    return sum(len(demodulator.push(t_ns, polarity, end_ns)) for t_ns, polarity, end_ns in some)


def until_locked(demodulator: Demodulator, some: list[Packet]) -> tuple[int, int]:
    """Push packets until the rate is settled; return how many were pushed, and the characters."""
    characters = count = 0
    while demodulator.bit_rate_bps is None and count < len(some):
        characters += push(demodulator, some[count : count + 1])
        count += 1
    return count, characters


def run(events: Events, parameters: Parameters, packet_ns: int | None) -> Timing:
    """Time one run; for the whole recording at once, a second one after a lock in packets."""
    t_ns, polarity = events
    reference = reference_ns(polarity)
    cut = packets(events, LEAD_NS if packet_ns is None else packet_ns)
    begun = time.process_time()
    demodulator = make_demodulator(parameters)
    lead, characters = until_locked(demodulator, cut)
    lead_s = time.process_time() - begun
    locked = demodulator.bit_rate_bps is not None
    lead_events = sum(len(packet[0]) for packet in cut[:lead])
    rest = cut[lead:]
    if packet_ns is None and rest:
        rest = packets(events, None, lead_events)
    begun = time.process_time()
    characters += push(demodulator, rest) + len(demodulator.flush())
    excluded_s = time.process_time() - begun
    included_s = lead_s + excluded_s
    if packet_ns is None:
        whole = packets(events, None)
        begun = time.process_time()
        demodulator = make_demodulator(parameters)
        characters = push(demodulator, whole) + len(demodulator.flush())
        included_s = time.process_time() - begun
    locked_ns = cut[lead - 1][2] if lead else int(t_ns[0])
    lock_s = (locked_ns - int(t_ns[0])) / NS_PER_S if locked else None
    return Timing(included_s, len(t_ns), excluded_s, len(t_ns) - lead_events, lock_s, reference, characters)


def cases(bit_rate_bps: float) -> Iterator[tuple[str, str, Parameters]]:
    """Yield receiver, what it knows of the rate, and parameters."""
    for name, parameters in declared_receivers(bit_rates=(bit_rate_bps,)).items():
        yield name, 'none' if name.endswith('blind') else 'the one', parameters
    for name, parameters in declared_receivers(bit_rates=SEVERAL_BPS).items():
        if not name.endswith('blind'):
            yield name, f'{len(SEVERAL_BPS)} listed', parameters


def row(*cells: object) -> None:
    """Print a table's line."""
    print('| ' + ' | '.join(str(cell) for cell in cells) + ' |', flush=True)


def cost(seconds: float, events: int, reference: float) -> tuple[str, str, str]:
    """Return ns an event, million events a second, and the ratio to the reference."""
    if not events or seconds <= 0.0:
        return '–', '–', '–'
    ns = seconds * NS_PER_S / events
    return f'{ns:.1f}', f'{1e3 / ns:.1f}', f'{ns / reference:.0f}'


def print_recording(name: str, events: Events, bit_rate_bps: float, repeats: int) -> None:
    """Print the table of a recording."""
    seconds = int(events[0][-1] - events[0][0]) / NS_PER_S
    print(f'\n## {name}: {len(events[0])} events in {seconds:.2f} s\n')
    row(
        'receiver', 'rates', 'packets', 'lock included: ns an event', 'Mev/s', '× reference', 'excluded: ns an event',
        'Mev/s', '× reference', 'rate settled after (s)', 'beacons a core', 'characters',
    )  # fmt: skip
    row(*['---'] * 12)
    for receiver, rates, parameters in cases(bit_rate_bps):
        run((events[0][:20_000], events[1][:20_000]), parameters, LEAD_NS)  # compiles
        for packet_name, packet_ns in PACKETS_NS.items():
            timings = [run(events, parameters, packet_ns) for _ in range(repeats)]
            reference = float(np.median([timing.reference_ns for timing in timings]))
            included_s = float(np.median([timing.included_s for timing in timings]))
            excluded_s = float(np.median([timing.excluded_s for timing in timings]))
            one = timings[0]
            row(
                receiver,
                rates,
                packet_name,
                *cost(included_s, one.included_events, reference),
                *cost(excluded_s, one.excluded_events, reference),
                'never' if one.lock_s is None else f'{one.lock_s:.3f}',
                f'{seconds / included_s:.0f}',
                one.characters,
            )


def main() -> None:
    """Print everything."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('--folder', type=Path, default=recordings_folder(), help='folder of the recordings')
    parser.add_argument('--repeats', type=int, default=5)
    arguments = parser.parse_args()
    print('# Cost of demodulation, one core\n')
    _, warm = read_mat(Path(arguments.folder) / next(iter(RECORDINGS)))
    reference_loop(warm)
    references = [reference_ns(warm) for _ in range(20)]
    several = ', '.join(f'{bit_rate_bps:g}' for bit_rate_bps in SEVERAL_BPS)
    print(
        f'{platform.machine()}, Python {platform.python_version()}, numba {numba.__version__}; the reference loop takes'
        f' {np.median(references):.2f} ns an event. The {len(SEVERAL_BPS)} rates are {several} bps.'
        ' *Beacons a core*: how many such signals one core keeps up with, lock included.'
    )
    for name, bit_rate_bps in RECORDINGS.items():
        print_recording(name, read_mat(Path(arguments.folder) / name), bit_rate_bps, arguments.repeats)


if __name__ == '__main__':
    main()
