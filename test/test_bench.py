"""The benchmark's live part: what it sends is a stream without a seam, what it counts is what was offered, and it runs."""

from __future__ import annotations

import sys
from itertools import islice
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / 'bench'))

from live import Phase, measure  # noqa: E402
from streams import LOOP_NS, START_NS, Repeated, make_stream, messages  # noqa: E402

import bench  # noqa: E402
from beacon_comm.core.parameters import Parameters  # noqa: E402
from beacon_comm.wire.stream import EventStream  # noqa: E402
from bench import live_metrics  # noqa: E402

TYPES = {'evt3': 'event_camera_msgs/msg/EventPacket', 'event_array': 'dvs_msgs/msg/EventArray'}


@pytest.mark.parametrize('encoding', TYPES)
def test_what_is_sent_round_and_round_goes_on(encoding: str, data_folder: Path) -> None:
    stream = make_stream(data_folder, (1280, 720), 0.0, LOOP_NS / 1e9, repeatable=True)
    count = len(stream.batches)
    reader = EventStream(TYPES[encoding])
    times = []
    for message in islice(Repeated(stream, encoding), 3 * count):
        decoded = reader.push(message)
        assert decoded.batch is not None and decoded.problem is None
        times.append(decoded.batch.t_ns)
    t_ns = np.concatenate(times)
    once = np.concatenate([batch.t_ns for batch in stream.batches])
    assert np.array_equal(t_ns, np.concatenate([once + k * LOOP_NS for k in range(3)]))
    assert once[0] >= START_NS and once[-1] < START_NS + LOOP_NS
    told = {kind: number for kind, number in reader.counts.items() if number and kind != 'empty_packets'}
    assert told == {'packets': 3 * count, 'events': 3 * stream.events}


def test_a_rate_counts_as_far_as_it_was_offered_and_held() -> None:
    held = Phase('evt3', 5.0, offered_mev_per_s=4.8, measured=4000, latency_p50_ms=1.0, latency_p99_ms=3.0)
    shed = Phase('evt3', 10.0, offered_mev_per_s=10.1, measured=4000, shed=40, latency_p50_ms=2.0, latency_p99_ms=9.0)
    lost = Phase('event_array', 5.0, offered_mev_per_s=5.0, measured=4000, missing=1)
    metrics = live_metrics([held, shed, lost])
    assert metrics['live_packet_mev_per_s'] == 4.8
    assert metrics['live_packet_character_latency_at_that_rate_p99_ms'] == 3.0
    assert metrics['character_latency_p99_ms'] == 9.0
    assert metrics['live_packet_10mev_shed_percent'] == 1.0
    assert metrics['live_event_array_mev_per_s'] == 0.0
    assert 'live_event_array_5mev_character_latency_p99_ms' not in metrics
    assert all(key.rpartition('_')[2] in ('s', 'ms', 'percent', 'packets') for key in metrics)


def test_the_live_part_runs(data_folder: Path) -> None:
    pytest.importorskip('rclpy')
    pytest.importorskip('event_camera_msgs')
    (phase,) = measure(data_folder, [0.0], warm_up_s=1.0, measured_s=2.0)
    assert phase.packets == 3000 and phase.missing == 0
    assert 0 < phase.measured <= phase.packets
    assert 0.0 < phase.offered_mev_per_s <= phase.scene_mev_per_s * 1.1
    assert phase.shed > 0 or phase.events_mev_per_s > 0.0


def test_the_numpy_reference_runs_with_the_default_parameters(data_folder: Path) -> None:
    stream = make_stream(data_folder, bench.VGA, 1e6, 0.1)
    assert bench.numpy_mev_per_s(list(messages(stream, 'evt3')), bench.VGA, Parameters()) > 0.0
