#!/usr/bin/env python3
"""Measure the speed of the chain, stage by stage and as a whole; print tables, write ``bench.json`` and a figure.

    make bench                                                  # under ten minutes
    python bench/bench.py [--only decoding chain …] [--json bench.json] [--figure docs/figures/speed.png]

One core; all times are processor time of this process, the best of several runs; but for ``live``, which is the node's
own process through DDS, by the clock (:mod:`live`).  ``bench.json`` is one flat object: each key ends with its unit.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import islice
from pathlib import Path

import numba
import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parent))  # PYTHONSAFEPATH leaves it out

from live import Phase, can_publish_arrays, measure  # noqa: E402
from measuring import ChainRun, MetricTable, best_s, mev_per_s, module_ns, run_chain  # noqa: E402
from streams import BAG, LOOP_NS, PACKET_NS, WORDS_BAG, Repeated, Stream, make_stream, messages, real_words  # noqa: E402

from beacon_comm.compiling.warm_up import warm_up  # noqa: E402
from beacon_comm.core.detection import Detector  # noqa: E402
from beacon_comm.core.parameters import Parameters  # noqa: E402
from beacon_comm.recordings.folder import recordings_folder
from beacon_comm.reference.detection import ReferenceDetector  # noqa: E402
from beacon_comm.reference.evt3 import ReferenceEvt3Decoder  # noqa: E402
from beacon_comm.wire.cdr import build_event_packet, parse_event_packet  # noqa: E402
from beacon_comm.wire.stream import EventStream  # noqa: E402

PROJECT = Path(__file__).resolve().parents[1]
PACKET_TYPE, ARRAY_TYPE = 'event_camera_msgs/msg/EventPacket', 'dvs_msgs/msg/EventArray'
HD, VGA = (1280, 720), (640, 480)
MEGABYTE = 1_000_000


def row(*cells: object) -> None:
    """Print a table's line."""
    shown = (f'{cell:.4g}' if isinstance(cell, float) else str(cell) for cell in cells)
    print('| ' + ' | '.join(shown) + ' |', flush=True)


def head(title: str, *columns: str) -> None:
    """Print a section's title and the head of its table."""
    print(f'\n## {title}\n')
    row(*columns)
    row(*['---'] * len(columns))


def push_all(message_type: str, cdrs: Sequence[bytes]) -> int:
    """Decode messages; return their events."""
    stream = EventStream(message_type)
    for cdr in cdrs:
        stream.push(cdr)
    return stream.counts['events']


def decoding(folder: Path) -> MetricTable:
    """Measure the decoders alone: the real evt3 words against numpy and PyPI's evt3, and every encoding."""
    metrics: MetricTable = {}
    head('Decoding', 'what', 'Mev/s', 'MB/s', 'times numpy', 'times evt3 (PyPI)')
    payloads, size = real_words(folder, 100 * MEGABYTE, 256_000)
    cdrs = [build_event_packet(k, 'camera', *size, k, 0, 'evt3', payload) for k, payload in enumerate(payloads)]
    few = payloads[:20]
    events = push_all(PACKET_TYPE, cdrs)

    def decode_by_numpy() -> int:
        decoder = ReferenceEvt3Decoder(*size)
        batches = [decoder.decode(np.frombuffer(payload, np.uint8)) for payload in few]
        return sum(len(batch) for batch in batches if batch is not None)

    ours = metrics['evt3_decode_mev_per_s'] = mev_per_s(events, best_s(lambda: push_all(PACKET_TYPE, cdrs)))
    by_numpy = mev_per_s(decode_by_numpy(), best_s(decode_by_numpy))
    metrics['evt3_numpy_decode_mev_per_s'] = by_numpy
    metrics['evt3_decode_over_numpy_ratio'] = ours / by_numpy
    theirs = decode_by_pypi(payloads)
    if theirs is not None:
        metrics['evt3_pypi_decode_mev_per_s'] = theirs
        metrics['evt3_decode_over_pypi_ratio'] = ours / theirs
    size_mb = sum(map(len, payloads)) / MEGABYTE
    times_theirs = ours / theirs if theirs else '–'
    row('real evt3 words, 256 kB a packet', ours, ours * size_mb / events * 1e6, ours / by_numpy, times_theirs)
    payloads, size = real_words(folder, 20 * MEGABYTE)
    cdrs = [build_event_packet(k, 'camera', *size, k, 0, 'evt3', payload) for k, payload in enumerate(payloads)]
    count = push_all(PACKET_TYPE, cdrs)
    speed = mev_per_s(count, best_s(lambda: push_all(PACKET_TYPE, cdrs)))
    metrics['evt3_driver_packets_decode_mev_per_s'] = speed
    row('the same, packets of 4 ms and 664 events', speed, speed * sum(map(len, payloads)) / count, '–', '–')
    stream = make_stream(folder, HD, 40e6, 0.2)
    for encoding in ('evt3', 'libcaer_cmp', 'libcaer', 'mono', 'event_array'):
        message_type = ARRAY_TYPE if encoding == 'event_array' else PACKET_TYPE
        cdrs = list(messages(stream, encoding))
        events = push_all(message_type, cdrs)
        if events != stream.events:
            raise SystemExit(f'{encoding}: {events} of {stream.events} events came back')
        speed = mev_per_s(events, best_s(lambda t=message_type, c=cdrs: push_all(t, c)))  # type: ignore[misc]
        metrics[f'{encoding}_dense_decode_mev_per_s'] = speed
        row(f'{encoding}, 40,000 events a packet', speed, speed * sum(map(len, cdrs)) / events, '–', '–')
    return metrics


def decode_by_pypi(payloads: Sequence[bytes]) -> float | None:
    """Return what PyPI's evt3 makes of the same words (Mev/s), None if it is not installed."""
    try:
        import evt3
    except ImportError:
        print('evt3 is not installed (pip install evt3): not compared with', file=sys.stderr)
        return None

    def decode() -> int:
        decoder = evt3.Decoder()
        return sum(len(decoder.feed(payload)) for payload in payloads)

    return mev_per_s(decode(), best_s(decode))


CHAIN = (
    # key, sensor, background (events/s)
    ('', HD, 20e6),
    ('40mev_', HD, 40e6),
    ('7mev_', HD, 7e6),
    ('vga_20mev_', VGA, 20e6),
    ('vga_', VGA, 8e6),
    ('sparse_vga_', VGA, 1e6),
    ('real_vga_', VGA, None),  # the bag of real words, at its own pace and in its own packets
)
CHAIN_ROUNDS, REAL_PACKET_NS = 4, 4_000_000
LOOP_S = LOOP_NS / 1e9


def chain(folder: Path) -> MetricTable:
    """Measure bytes to characters, window and morphology included, and the share of each part."""
    metrics: MetricTable = {}
    head(
        'From evt3 bytes to characters, two beacons', 'sensor', 'Mev/s of the stream', 'receiver', 'Mev/s',
        'of real time', 'decoding ns', 'detection ns', 'demodulation ns an event', 'index_threshold', 'tracks', 'confirmed',
        'characters',
    )  # fmt: skip
    for key, size, rate in CHAIN:
        stream, cdrs = chain_messages(folder, size, rate)
        for receiver in ('threshold', 'sequence'):
            parameters = Parameters(receiver=receiver)
            run = best_chain(cdrs, size, parameters)
            name = f'{key}evt3_to_characters' + ('' if receiver == 'threshold' else '_sequence')
            metrics[f'{name}_mev_per_s'] = mev_per_s(run.events, run.total_s)
            print_chain(stream, receiver, run)
        if not key:
            settled = replace(parameters, index_threshold=run.index_threshold)
            by_numpy = numpy_mev_per_s(cdrs[:60], size, settled)
            metrics['numpy_reference_mev_per_s'] = by_numpy
            metrics['evt3_to_characters_over_numpy_ratio'] = metrics['evt3_to_characters_mev_per_s'] / by_numpy
            row('all in plain numpy', '', 'threshold', by_numpy, *[''] * 8)
    return metrics


def chain_messages(folder: Path, size: tuple[int, int], events_per_s: float | None) -> tuple[Stream, list[bytes]]:
    """Return a stream with two beacons, and its messages for :data:`CHAIN_ROUNDS` rounds; None: the bag of real words."""
    bag, packet_ns = (WORDS_BAG, REAL_PACKET_NS) if events_per_s is None else (BAG, PACKET_NS)
    stream = make_stream(folder, size, events_per_s, LOOP_S, packet_ns=packet_ns, repeatable=True, bag=bag)
    return stream, rounds(stream, CHAIN_ROUNDS)


def rounds(stream: Stream, count: int) -> list[bytes]:
    """Return a repeatable stream's messages, so many rounds of them."""
    return list(islice(Repeated(stream, 'evt3'), count * len(stream.batches)))


def numpy_mev_per_s(cdrs: Sequence[bytes], size: tuple[int, int], parameters: Parameters) -> float:
    """Return how fast plain numpy is from bytes to characters (Mev/s), with the paper's tracker and receiver."""
    run = run_chain(cdrs, size, replace(parameters, receiver='threshold', tracker='nearest'), ReferenceDetector)
    return mev_per_s(run.events, run.total_s - run.decode_s + numpy_decode_s(cdrs, size))


def numpy_decode_s(cdrs: Sequence[bytes], size: tuple[int, int]) -> float:
    """Return how long plain numpy takes to decode (s)."""
    payloads = [parse_event_packet(cdr).payload for cdr in cdrs]

    def decode() -> None:
        decoder = ReferenceEvt3Decoder(*size)
        for payload in payloads:
            decoder.decode(payload)

    return best_s(decode, 1)


def best_chain(cdrs: Sequence[bytes], size: tuple[int, int], parameters: Parameters, timed_from: int = 0) -> ChainRun:
    """Return the quickest of two runs."""
    return min((run_chain(cdrs, size, parameters, Detector, timed_from) for _ in range(2)), key=lambda run: run.total_s)


def print_chain(stream: Stream, receiver: str, run: ChainRun) -> None:
    """Print a run's line."""
    ns = [seconds / run.events * 1e9 for seconds in (run.decode_s, run.detect_s, run.demodulate_s)]
    row(
        f'{stream.width} x {stream.height}', stream.events / stream.seconds / 1e6, receiver, mev_per_s(run.events, run.total_s),
        f'{CHAIN_ROUNDS * stream.seconds / run.total_s:.2f} x', *ns, run.index_threshold, run.tracks, run.confirmed,
        run.characters,
    )  # fmt: skip


def stages(folder: Path) -> MetricTable:
    """Print in which modules the time goes, by the profiler, whose own cost is in the calls."""
    for size, rate in ((HD, 20e6), (VGA, 1e6)):
        cdrs = rounds(make_stream(folder, size, rate, LOOP_S, repeatable=True), 2)
        parameters = Parameters(receiver='threshold')
        table = module_ns(lambda c=cdrs, s=size, p=parameters: run_chain(c, s, p, Detector))  # type: ignore[misc]
        total = sum(table.values())
        head(f'Where the time goes: {size[0]} x {size[1]}, {rate / 1e6:g} Mev/s', 'module', 'ns an event', 'share')
        for module, ns in list(table.items())[:12]:
            row(module, ns, f'{ns / total:.0%}')
    return {}


HOPS = ((0.0, 'two_beacons'), (1e6, '1mev'), (10e6, '10mev'), (40e6, '40mev'))


def hops(folder: Path) -> MetricTable:
    """Measure what a hop costs beside its events' decoding and routing: windows, threshold, morphology, components."""
    metrics: MetricTable = {}
    title = 'A hop: windows, threshold, morphology, components, tracks'
    head(title, 'sensor', 'background Mev/s', 'ms a hop', 'index_threshold')
    for size, name in ((HD, 'hd'), (VGA, 'vga')):
        for rate, label in HOPS:
            stream = make_stream(folder, size, rate, 0.6, packet_ns=10_000_000)
            times = []
            for _ in range(2):
                detector = Detector(Parameters(), size)
                for k, batch in enumerate(stream.batches):
                    detector.route(batch.slice(0, int(np.searchsorted(batch.t_ns, batch.t_end_ns)), batch.t_end_ns))
                    begun = time.process_time()
                    detector.hop(batch.t_end_ns)
                    if k >= len(stream.batches) // 2:  # the threshold has settled
                        times.append(time.process_time() - begun)
            metrics[f'hop_{name}_{label}_ms'] = float(np.median(times) * 1e3)
            row(f'{size[0]} x {size[1]}', rate / 1e6, metrics[f'hop_{name}_{label}_ms'], detector.index_threshold)
    return metrics


SCALING_BEACONS, SCALING_RATES, SCALING_PACKET_NS = (2, 16, 64), (1e6, 5e6, 20e6), 4_000_000


def scaling(folder: Path) -> MetricTable:
    """Measure the cost of an event by beacons, rate and sensor; and of the beacons themselves."""
    metrics: MetricTable = {}
    head(
        'How the cost grows (receiver: threshold)', 'sensor', 'background Mev/s', 'beacons', 'Mev/s in all',
        'decoding and detection ns an event', 'all, ms a hop', 'demodulation ms a hop and track', 'confirmed',
    )  # fmt: skip
    for size, name in ((VGA, 'vga'), (HD, 'hd')):
        for rate in SCALING_RATES:
            for count in SCALING_BEACONS:
                stream = make_stream(folder, size, rate, LOOP_S, count, packet_ns=SCALING_PACKET_NS, repeatable=True)
                cdrs = rounds(stream, 2)
                run = best_chain(cdrs, size, Parameters(receiver='threshold', candidate_slots=80), len(stream.batches))
                hop_count = stream.seconds * 100
                key = f'scaling_{name}_{rate / 1e6:g}mev_{count}_beacons'
                metrics[f'{key}_ns_per_event'] = (run.decode_s + run.detect_s) / run.events * 1e9
                metrics[f'{key}_ms_per_hop'] = run.total_s / hop_count * 1e3
                metrics[f'{key}_demodulation_ms_per_hop_and_track'] = run.demodulate_s / hop_count / max(run.tracks, 1) * 1e3
                row(
                    f'{size[0]} x {size[1]}', rate / 1e6, count, stream.events / stream.seconds / 1e6,
                    metrics[f'{key}_ns_per_event'], metrics[f'{key}_ms_per_hop'],
                    metrics[f'{key}_demodulation_ms_per_hop_and_track'], run.confirmed,
                )  # fmt: skip
    return metrics


LIVE_RATES, LIVE_ARRAY_RATES, LATENCY_RATE = (2.5, 5.0, 10.0, 20.0, 40.0), (5.0, 10.0, 20.0), 10.0


def live(folder: Path) -> MetricTable:
    """Measure the node through DDS: the highest rates that it holds, and the latency of its characters."""
    load = os.getloadavg()[0]
    if not can_publish_arrays():
        print('dvs_msgs is not installed (make bench builds it): EventArray is not measured', file=sys.stderr)
    phases = measure(folder, LIVE_RATES, LIVE_ARRAY_RATES if can_publish_arrays() else ())
    head(
        f'Live, through DDS: 1280 x 720, packets of 1 ms, two beacons; {os.cpu_count()} processors, load {load:.1f} before',
        'messages', 'asked for, Mev/s', 'offered, Mev/s', 'publisher late by, ms', 'read, Mev/s', 'lost', 'shed', 'lag, ms',
        'character latency p50, ms', 'p99, ms', 'characters', 'confirmed', 'node, cores', 'publisher, cores',
    )  # fmt: skip
    for phase in phases:
        print_phase(phase)
    return live_metrics(phases)


def print_phase(phase: Phase) -> None:
    """Print a phase's line."""
    shed = f'{phase.shed / max(phase.measured, 1):.2%}' if phase.shed else '0'
    p50, p99 = ('–' if ms is None else ms for ms in (phase.latency_p50_ms, phase.latency_p99_ms))
    row(
        'EventPacket' if phase.encoding == 'evt3' else 'EventArray', phase.scene_mev_per_s, phase.offered_mev_per_s,
        phase.late_ms, phase.events_mev_per_s, phase.missing, shed, phase.lag_ms, p50, p99, phase.latency_characters,
        phase.confirmed, phase.node_cores, phase.publisher_cores,
    )  # fmt: skip


def live_metrics(phases: Sequence[Phase]) -> MetricTable:
    """Return the metrics of the live phases; a rate counts as far as it was really offered."""
    metrics: MetricTable = {}
    for encoding, name in (('evt3', 'packet'), ('event_array', 'event_array')):
        ours = [phase for phase in phases if phase.encoding == encoding]
        if not ours:
            continue
        best = max((phase for phase in ours if phase.held), key=lambda phase: phase.offered_mev_per_s, default=None)
        metrics[f'live_{name}_mev_per_s'] = 0.0 if best is None else best.offered_mev_per_s
        if best is not None and best.latency_p99_ms is not None:
            metrics[f'live_{name}_character_latency_at_that_rate_p99_ms'] = best.latency_p99_ms
        for phase in ours:
            key = f'live_{name}_{phase.nominal_mev_per_s:g}mev'
            metrics[f'{key}_offered_mev_per_s'] = phase.offered_mev_per_s
            metrics[f'{key}_shed_percent'] = 100.0 * phase.shed / max(phase.measured, 1)
            metrics[f'{key}_lost_packets'] = phase.missing
            if phase.latency_p50_ms is not None and phase.latency_p99_ms is not None:
                metrics[f'{key}_character_latency_p50_ms'] = phase.latency_p50_ms
                metrics[f'{key}_character_latency_p99_ms'] = phase.latency_p99_ms
    at_10 = next((p for p in phases if p.encoding == 'evt3' and p.nominal_mev_per_s == LATENCY_RATE), None)
    if at_10 is not None and at_10.latency_p99_ms is not None:
        metrics['character_latency_p99_ms'] = at_10.latency_p99_ms
    return metrics


def draw(metrics: MetricTable, path: Path) -> None:
    """Draw the cost of a hop by rate, and of a beacon by beacons."""
    import matplotlib

    matplotlib.use('Agg')
    from matplotlib import pyplot as plt

    figure, (left, right) = plt.subplots(1, 2, figsize=(11, 4.2), layout='constrained')
    rates = [rate / 1e6 for rate in SCALING_RATES]
    for name, label, style in (('vga', '640 x 480', '--'), ('hd', '1280 x 720', '-')):
        for count, colour in zip(SCALING_BEACONS, ('tab:blue', 'tab:orange', 'tab:green'), strict=True):
            keys = [f'scaling_{name}_{rate:g}mev_{count}_beacons' for rate in rates]
            values = [metrics[f'{key}_ms_per_hop'] for key in keys]
            left.plot(rates, values, style, color=colour, marker='o', label=f'{count} beacons, {label}')
        for rate, colour in zip(rates, ('tab:red', 'tab:purple', 'tab:brown'), strict=True):
            keys = [f'scaling_{name}_{rate:g}mev_{count}_beacons' for count in SCALING_BEACONS]
            values = [metrics[f'{key}_demodulation_ms_per_hop_and_track'] for key in keys]
            right.plot(SCALING_BEACONS, values, style, color=colour, marker='o', label=f'{rate:g} Mev/s, {label}')
    left.axhline(10, color='0.6', linewidth=1)
    left.text(rates[0], 10.3, 'real time: a hop is 10 ms', color='0.4', fontsize=8)
    left.set(xlabel='background (million events a second)', ylabel='processor time a hop (ms)', title='Bytes to characters')
    right.set(xlabel='beacons', ylabel='demodulation, ms a hop and track', xscale='log')
    right.set_title('What one more track costs its demodulator')
    right.set_xticks(SCALING_BEACONS, [str(count) for count in SCALING_BEACONS])
    right.minorticks_off()
    for axes in (left, right):
        axes.set_ylim(0, None)
        axes.legend(fontsize=7, handlelength=4)
        axes.grid(alpha=0.3)
    figure.savefig(path, dpi=110)
    plt.close(figure)


SECTIONS: dict[str, Callable[[Path], MetricTable]] = {
    'decoding': decoding,
    'chain': chain,
    'stages': stages,
    'hops': hops,
    'scaling': scaling,
    'live': live,
}


def main() -> None:
    """Run the sections asked for."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('--folder', type=Path, default=recordings_folder(), help='folder of the recordings')
    parser.add_argument('--only', nargs='+', choices=SECTIONS, default=list(SECTIONS), help='sections to run')
    parser.add_argument('--json', type=Path, default=PROJECT / 'bench.json', help='where the metrics go')
    parser.add_argument('--figure', type=Path, help='where the plot of the scaling goes')
    arguments = parser.parse_args()
    if not Path(arguments.folder).is_dir():
        raise SystemExit(f'{arguments.folder}: no such folder; the bench needs the recordings (--folder)')
    begun = time.perf_counter()
    for receiver in ('threshold', 'sequence'):
        warm_up(Parameters(receiver=receiver))
    print(f'# Speed\n\n{platform.machine()}, Python {platform.python_version()}, numba {numba.__version__}')
    metrics: MetricTable = {}
    for name in arguments.only:
        metrics |= SECTIONS[name](Path(arguments.folder))
    if arguments.figure is not None and 'scaling' in arguments.only:
        draw(metrics, arguments.figure)
    metrics['bench_wall_s'] = time.perf_counter() - begun
    arguments.json.write_text(json.dumps({key: round(value, 4) for key, value in metrics.items()}, indent=1) + '\n')
    print(f'\n{arguments.json}: {len(metrics)} metrics, {metrics["bench_wall_s"]:.0f} s')


if __name__ == '__main__':
    main()
