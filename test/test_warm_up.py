"""After the warm-up nothing is compiled any more, whatever comes."""

import subprocess
import sys

import pytest

SCRIPT = """
import importlib, pkgutil, sys
from dataclasses import replace
import numpy as np
from numba.core.registry import CPUDispatcher
import beacon_comm.core, beacon_comm.wire
from beacon_comm.compiling.warm_up import synthetic_beacons, warm_up
from beacon_comm.core.events import NS_PER_S, EventBatch
from beacon_comm.core.parameters import Parameters
from beacon_comm.core.receiver import Receiver
from beacon_comm.wire.cdr import build_event_array, build_event_packet
from beacon_comm.wire.evt3_encoder import Evt3Encoder
from beacon_comm.wire.stream import EventStream

def compiled():
    rooms = (beacon_comm.core, beacon_comm.wire)
    modules = [importlib.import_module(m.name) for r in rooms for m in pkgutil.iter_modules(r.__path__, r.__name__ + '.')]
    kernels = {f'{k.py_func.__module__}.{k.py_func.__name__}': k for m in modules for k in vars(m).values()
               if isinstance(k, CPUDispatcher)}
    return {name: len(kernel.signatures) for name, kernel in kernels.items()}

parameters = Parameters(**eval(sys.argv[1]))
warm_up(parameters)
before = compiled()
assert sum(before.values()) > 20, before
size, events = (1280, 720), synthetic_beacons(parameters, 1.0)
rng = np.random.default_rng(1)
n = 20_000
noise = EventBatch(rng.integers(0, 1280, n).astype(np.uint16), rng.integers(0, 720, n).astype(np.uint16),
                   rng.choice([-1, 1], n).astype(np.int8), np.sort(rng.integers(0, NS_PER_S, n)) + NS_PER_S, 0)
order = np.argsort(np.concatenate((events.t_ns, noise.t_ns)), kind='stable')
columns = [np.concatenate((getattr(events, c), getattr(noise, c)))[order] for c in ('x', 'y', 'polarity', 't_ns')]
scene = EventBatch(*columns, int(columns[3][-1]))
receiver, encoder = Receiver(replace(parameters, new_tracks_burst=0), size), Evt3Encoder(*size)
packets, arrays = EventStream('event_camera_msgs/msg/EventPacket'), EventStream('dvs_msgs/msg/EventArray')
missing, cluttered = 0, False
cuts = range(NS_PER_S, scene.t_end_ns, 4_000_000)
for seq, begin in enumerate(cuts):
    start, stop = np.searchsorted(scene.t_ns, (begin, begin + 4_000_000))
    part = scene.slice(start, stop, begin + 4_000_000)
    cdr = build_event_packet(begin, 'camera', *size, seq, 0, 'evt3', encoder.encode(part))
    if 140 < seq < 145:
        missing += len(part)
        continue
    receiver.push(packets.push(bytearray(cdr) if seq % 2 else cdr).batch)
    cluttered |= receiver.index_threshold > parameters.index_threshold
    arrays.push(build_event_array(begin, 'camera', *size, part.x, part.y, part.polarity, part.t_ns))
assert arrays.counts['events'] == packets.counts['events'] == len(scene) - missing
assert packets.counts['lost_packets'] == 4 and cluttered
for encoding in ('libcaer_cmp', 'libcaer', 'mono'):
    cdr = build_event_packet(0, 'camera', *size, 0, 0, encoding, rng.bytes(6401))
    EventStream('event_camera_msgs/msg/EventPacket').push(cdr)
assert receiver.beacons()
receiver.push(EventBatch.empty(cuts[-1] + 2 * NS_PER_S))
receiver.flush()
after = compiled()
assert after == before, {k: (before.get(k), n) for k, n in after.items() if before.get(k) != n}
"""


@pytest.mark.parametrize(
    'parameters',
    [
        {'receiver': 'threshold'},
        {'receiver': 'sequence'},
        {'tracker': 'nearest'},
        {'receiver': 'threshold', 'bit_rates': (20.0,)},
        {'short_window_s': 0.3, 'long_window_bits': 1.0, 'hop_s': 0.1},
    ],
)
def test_nothing_is_compiled_after_the_warm_up(parameters: dict[str, object]) -> None:
    done = subprocess.run(
        [sys.executable, '-P', '-c', SCRIPT, repr(parameters)], capture_output=True, text=True, timeout=200, check=False
    )
    assert done.returncode == 0, done.stderr[-2000:]
