#!/usr/bin/env python3
"""Count how many candidates that are no beacon are read, or even confirmed; print the tables of false_alarms.md.

    python docs/false_alarms.py                                       # a minute or two
    python docs/false_alarms.py --full --output docs/false_alarms.md  # more than 10 000 candidates, each receiver

::

    lamp, noise, edge, patch of a real bag ─► 1 to 3 s of one blob's events ─► SignalReceiver ─► confirmed?  characters?

The seed, the family and the number of a candidate determine it: the ones that were confirmed are named at the end.
"""

from __future__ import annotations

import argparse
import shlex
import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from beacon_comm.core.character import Character, Status
from beacon_comm.core.confirmation import ParityRecord, Verdict
from beacon_comm.core.events import NS_PER_S, EventBatch
from beacon_comm.core.framing import CharacterFrame
from beacon_comm.core.index_image import hop_length_ns
from beacon_comm.core.parameters import Parameters
from beacon_comm.core.receiver import SignalReceiver
from beacon_comm.evaluation.receivers import declared_receivers
from beacon_comm.evaluation.scoring import wilson_interval
from beacon_comm.evaluation.truth import SONNET18
from beacon_comm.recordings.bags import open_recording
from beacon_comm.recordings.folder import recordings_folder
from beacon_comm.simulation.led import OUTDOOR_30_M, Burst, LedModel, noise, simulate_levels, simulate_text, square_wave
from beacon_comm.wire.stream import EventStream

Events = tuple[NDArray[np.int64], NDArray[np.int8]]
Random = np.random.Generator

T0_NS = 2**40
FRAME_BITS = CharacterFrame().length
RATES_BPS = Parameters().bit_rates
MAINS_HZ = (100.0, 120.0)
# Frames in a period, or the other way round, at which a square wave reads alike for ever.
FRAMES = (1 / 5, 1 / 4, 2 / 7, 1 / 3, 4 / 11, 2 / 5, 1 / 2, 2 / 3, 3 / 4, 1.0, 4 / 3, 3 / 2, 2.0)
PATCH_SIDES_PX = (5, 7, 9, 11, 15, 21, 31)
LEAST_EVENTS = 200
SHORTEST_S, LONGEST_S = 1.0, 3.0
BAGS = ('evt3_static', 'libcaer_grid', 'evt3_trigger_hd')
DEFAULT_COUNT, FULL_COUNT = 30, 600
CONTROL = 'control: a beacon that sends text'


# What a blob that is no beacon may be


def duration(random: Random) -> float:
    """Draw how long a candidate is seen (s)."""
    return float(random.uniform(SHORTEST_S, LONGEST_S))


def logarithmic(random: Random, low: float, high: float) -> float:
    """Draw a number whose logarithm is uniform."""
    return float(np.exp(random.uniform(np.log(low), np.log(high))))


def seed_from(random: Random) -> int:
    """Draw the seed of a simulation."""
    return int(random.integers(2**32))


def lamp(random: Random) -> LedModel:
    """Draw a lamp, or an LED: near or far, sharp or slow, with or without events between its edges."""
    if random.random() < 0.4:
        share = logarithmic(random, 0.03, 1.0)
        rise, fall = (
            replace(burst, events=share * burst.events, held_per_s=share * burst.held_per_s)
            for burst in (OUTDOOR_30_M.rise, OUTDOOR_30_M.fall)
        )
        return LedModel(rise, fall, share * OUTDOOR_30_M.stray_per_s)
    events = logarithmic(random, 3.0, 60.0)
    spread_s = logarithmic(random, 1e-6, 1e-3)
    held_per_s = float(random.choice([0.0, 300.0]))
    rise = Burst(events, float(random.uniform(0.0, 0.5)), 20e-6, spread_s, 1e-6, held_per_s)
    fall = replace(rise, events=events * random.uniform(0.5, 1.5), spread_s=spread_s * random.uniform(0.3, 1.0))
    return LedModel(rise, fall, float(random.choice([0.0, 50.0, 500.0])))


def switched(random: Random, changes_s: NDArray[np.float64], seconds: float) -> Events:
    """Return the events of a lamp that is switched at given times (s, increasing), ``(n,)``."""
    changes_ns = np.unique(np.rint(changes_s * NS_PER_S).astype(np.int64))
    changes_ns = T0_NS + changes_ns[(changes_ns >= 0) & (changes_ns < seconds * NS_PER_S)]
    levels = ((np.arange(len(changes_ns)) + 1) % 2).astype(np.uint8)
    end_ns = T0_NS + round(seconds * NS_PER_S)
    return simulate_levels(changes_ns, levels, T0_NS, end_ns, model=lamp(random), seed=seed_from(random))


def merged(parts: Sequence[Events]) -> Events:
    """Return the events of several sources in one blob, in order of time."""
    t_ns = np.concatenate([part[0] for part in parts])
    order = np.argsort(t_ns, kind='stable')
    return t_ns[order], np.concatenate([part[1] for part in parts])[order]


def square(random: Random, frequency_hz: float, duty: float | None = None) -> Events:
    """Return the events of a square wave of a random duty."""
    share = float(random.uniform(0.05, 0.95)) if duty is None else duty
    return square_wave(frequency_hz, share, duration(random), t0_ns=T0_NS, model=lamp(random), seed=seed_from(random))


def mains_lamp(random: Random) -> Events:
    """Mains flicker: 100 or 120 Hz or a harmonic, 300 ppm off, its edges a little uneven."""
    frequency_hz = random.choice(MAINS_HZ) * random.integers(1, 6) * (1.0 + random.normal(0.0, 3e-4))
    seconds, duty = duration(random), random.uniform(0.1, 0.9)
    period_s = 1.0 / frequency_hz
    periods = np.arange(int(seconds * frequency_hz))
    wander = np.cumsum(random.normal(0.0, logarithmic(random, 1e-5, 3e-3), len(periods)))
    rises = (periods + wander) * period_s
    changes = np.sort(np.column_stack([rises, rises + duty * period_s]).ravel())
    return switched(random, changes, seconds)


def frame_fraction(random: Random) -> Events:
    """A square wave with a whole number of periods a frame, or another simple ratio, exactly."""
    if random.random() < 0.5:
        return square(random, random.choice(RATES_BPS) / FRAME_BITS * random.integers(1, 11))
    return square(random, random.choice(RATES_BPS) / FRAME_BITS / random.choice(FRAMES))


def near_frame_fraction(random: Random) -> Events:
    """The same, but some 1000 ppm beside it."""
    ratio = random.integers(1, 11) if random.random() < 0.5 else 1.0 / random.choice(FRAMES)
    return square(random, random.choice(RATES_BPS) / FRAME_BITS * ratio * (1.0 + random.normal(0.0, 1e-3)))


def any_square(random: Random) -> Events:
    """A square wave of 10 Hz to 5 kHz."""
    return square(random, logarithmic(random, 10.0, 5000.0))


def pwm(random: Random) -> Events:
    """A lamp dimmed by switching it at 200 Hz to 20 kHz."""
    return square(random, logarithmic(random, 200.0, 20_000.0))


def pwm_dimming(random: Random) -> Events:
    """The same while it is dimmed up and down, 0.2 to 120 times a second."""
    frequency_hz, seconds = logarithmic(random, 200.0, 20_000.0), duration(random)
    rises = np.arange(int(seconds * frequency_hz)) / frequency_hz
    swing = 2.0 * np.pi * (logarithmic(random, 0.2, 120.0) * rises + random.random())
    duty = 0.5 + random.uniform(0.05, 0.45) * np.sin(swing)
    return switched(random, np.column_stack([rises, rises + duty / frequency_hz]).ravel(), seconds)


def two_lamps(random: Random) -> Events:
    """Two square waves in one blob."""
    return merged([square(random, logarithmic(random, 20.0, 5000.0)) for _ in range(2)])


def sine(random: Random) -> Events:
    """A lamp whose brightness swings as a sine: events as often as it changes fast, some of the other polarity."""
    frequency_hz = logarithmic(random, 10.0, 2000.0)
    if random.random() < 0.5:
        frequency_hz = random.choice(MAINS_HZ) * random.integers(1, 4)
    t_ns, _ = noise(logarithmic(random, 1e3, 2e5), duration(random), t0_ns=T0_NS, seed=seed_from(random))
    slope = np.cos(2.0 * np.pi * frequency_hz * (t_ns - T0_NS) / NS_PER_S)
    kept = random.random(len(t_ns)) < np.abs(slope)
    flipped = random.random(len(t_ns)) < random.uniform(0.0, 0.2)
    polarity = np.where((slope > 0.0) ^ flipped, 1, -1).astype(np.int8)
    return t_ns[kept], polarity[kept]


def poisson(random: Random) -> Events:
    """Noise, 100 to 300 000 events a second, any share of them ON."""
    rate_per_s, on_share = logarithmic(random, 100.0, 3e5), float(random.random())
    return noise(rate_per_s, duration(random), on_share=on_share, t0_ns=T0_NS, seed=seed_from(random))


def bursts(random: Random) -> Events:
    """Noise in bursts at random times, each of one polarity or of both."""
    seconds = duration(random)
    parts = [noise(logarithmic(random, 10.0, 3000.0), seconds, t0_ns=T0_NS, seed=seed_from(random))]
    begins_s = random.random(random.poisson(logarithmic(random, 20.0, 3000.0) * seconds)) * seconds
    counts = random.poisson(logarithmic(random, 3.0, 100.0), len(begins_s))
    spread_s = logarithmic(random, 1e-5, 3e-3)
    on_share = random.beta(*((0.05, 0.05) if random.random() < 0.7 else (2.0, 2.0)), len(begins_s))
    t_s = np.repeat(begins_s, counts) + random.exponential(spread_s, int(counts.sum()))
    polarity = np.where(random.random(len(t_s)) < np.repeat(on_share, counts), 1, -1).astype(np.int8)
    parts.append((T0_NS + np.rint(t_s * 1e6).astype(np.int64) * 1000, polarity))
    return merged(parts)


def moving_edges(random: Random, regular: bool) -> Events:
    """Bars that pass the blob: ON at one edge, OFF at the other, spread over the time an edge takes to cross."""
    seconds = duration(random)
    period_s = logarithmic(random, 2e-3, 0.2)
    if regular:
        passes = np.arange(int(seconds / period_s)) * period_s
        passes = passes + random.normal(0.0, random.uniform(0.0, 0.1) * period_s, len(passes))
    else:
        passes = random.random(random.poisson(seconds / period_s)) * seconds
    crossing_s, width_s = period_s * random.uniform(0.02, 0.5), period_s * random.uniform(0.1, 0.7)
    parts = [noise(logarithmic(random, 10.0, 2000.0), seconds, t0_ns=T0_NS, seed=seed_from(random))]
    dark = random.random() < 0.5
    for edge, polarity in ((0.0, -1 if dark else 1), (width_s, 1 if dark else -1)):
        counts = random.poisson(logarithmic(random, 5.0, 500.0), len(passes))
        begins = np.repeat(passes + edge, counts)
        t_s = np.abs(begins + crossing_s * random.uniform(-0.5, 0.5, len(begins)))
        parts.append((T0_NS + np.rint(t_s * 1e6).astype(np.int64) * 1000, np.full(len(t_s), polarity, np.int8)))
    return merged(parts)


def telegraph(random: Random) -> Events:
    """A light switched at random: hold times are exponential, 0.2 to 20 bits on average."""
    seconds = duration(random)
    mean_s = logarithmic(random, 0.2, 20.0) / random.choice(RATES_BPS)
    changes = np.cumsum(random.exponential(mean_s, int(1.5 * seconds / mean_s) + 10))
    return switched(random, changes, seconds)


def random_bits(random: Random) -> Events:
    """Random bits at a listed rate, without frames: the data of another kind of sender."""
    seconds, rate_bps = duration(random), random.choice(RATES_BPS) * (1.0 + random.normal(0.0, 3e-4))
    bits = random.random(int(seconds * rate_bps)) < random.uniform(0.3, 0.7)
    return switched(random, np.flatnonzero(np.diff(bits, prepend=False)) / rate_bps, seconds)


def random_bits_any_rate(random: Random) -> Events:
    """The same at 100 bps to 10 kbps."""
    seconds, rate_bps = duration(random), logarithmic(random, 100.0, 10_000.0)
    bits = random.random(int(seconds * rate_bps)) < random.uniform(0.3, 0.7)
    return switched(random, np.flatnonzero(np.diff(bits, prepend=False)) / rate_bps, seconds)


def held_line(random: Random) -> Events:
    """A light held on (ON events go on) or off, with strays; now and then it is switched."""
    seconds = duration(random)
    on_share = float(random.choice([0.02, 0.98])) if random.random() < 0.8 else float(random.choice([0.0, 1.0]))
    parts = [
        noise(logarithmic(random, 300.0, 1e5), seconds, on_share=on_share, t0_ns=T0_NS, seed=seed_from(random)),
        switched(random, np.sort(random.random(random.integers(0, 6)) * seconds), seconds),
    ]
    return merged(parts)


def beacon(random: Random) -> Events:
    """The control: a beacon that sends a part of the sonnet at a listed rate."""
    rate_bps, seconds = float(random.choice(RATES_BPS)), duration(random)
    text = SONNET18 * 3
    start = int(random.integers(len(SONNET18)))
    count = int(seconds * rate_bps / FRAME_BITS)
    return simulate_text(
        text[start : start + count], rate_bps, t0_ns=T0_NS, lead_s=0.02, tail_s=0.02, seed=seed_from(random)
    )


# Patches of the real bags


@lru_cache(maxsize=len(BAGS))
def bag_events(path: Path) -> EventBatch:
    """Return all events of a bag."""
    batches = []
    with open_recording(path) as bag:
        topic = bag.event_topic()
        stream = EventStream(topic.type)
        for _, cdr in bag.messages(topic):
            batch = stream.push(cdr).batch
            if batch is not None:
                batches.append(batch)
    x, y, polarity, t_ns = (np.concatenate([getattr(b, name) for b in batches]) for name in ('x', 'y', 'polarity', 't_ns'))
    return EventBatch(x, y, polarity, t_ns, batches[-1].t_end_ns)


def patch(random: Random, path: Path) -> Events:
    """A square patch around one of the bag's events, over a part of its time; one time in two looped to 1 s or more."""
    events = bag_events(path)
    begin_ns, end_ns = int(events.t_ns[0]), events.t_end_ns
    while True:
        centre = int(random.integers(len(events)))
        reach = int(random.choice(PATCH_SIDES_PX)) // 2
        length_ns = round(random.uniform(0.3, 1.0) * (end_ns - begin_ns))
        start_ns = int(random.integers(begin_ns, end_ns - length_ns + 1))
        a, b = np.searchsorted(events.t_ns, [start_ns, start_ns + length_ns])
        inside = np.abs(events.x[a:b].astype(int) - int(events.x[centre])) <= reach
        inside &= np.abs(events.y[a:b].astype(int) - int(events.y[centre])) <= reach
        if inside.sum() >= LEAST_EVENTS:
            break
    t_ns, polarity = events.t_ns[a:b][inside] - start_ns + T0_NS, events.polarity[a:b][inside]
    times = max(1, round(duration(random) * NS_PER_S / length_ns)) if random.random() < 0.5 else 1
    return np.concatenate([t_ns + k * length_ns for k in range(times)]), np.tile(polarity, times)


SIMULATED: dict[str, Callable[[Random], Events]] = {
    'mains lamp and harmonics': mains_lamp,
    'square wave, simple ratio to the frame': frame_fraction,
    'square wave, 1000 ppm beside it': near_frame_fraction,
    'square wave, 10 Hz to 5 kHz': any_square,
    'PWM, 200 Hz to 20 kHz': pwm,
    'PWM, duty changing': pwm_dimming,
    'two lamps': two_lamps,
    'sine flicker': sine,
    'noise': poisson,
    'noise in bursts': bursts,
    'moving edges, regular': partial(moving_edges, regular=True),
    'moving edges, at random': partial(moving_edges, regular=False),
    'random telegraph': telegraph,
    'random bits without frames, listed rate': random_bits,
    'random bits without frames, any rate': random_bits_any_rate,
    'held line with strays': held_line,
}


def families(folder: Path | None) -> dict[str, Callable[[Random], Events]]:
    """Return the families of candidates by name; those of the bags only if there is a folder of recordings."""
    patches = {} if folder is None else {f'patch of {name}': partial(patch, path=folder / name) for name in BAGS}
    return SIMULATED | patches


def candidate(make: Callable[[Random], Events], name: str, number: int, seed: int = 0) -> Events:
    """Return candidate ``number`` of a family: ``(t_ns, polarity)``, the same for the same seed, name and number."""
    return make(np.random.default_rng([seed, number, *name.encode()]))


# What a receiver makes of it


@dataclass(frozen=True, slots=True)
class Outcome:
    """What became of a candidate.

    Attributes:
        name, number: the candidate.
        seconds: how long it was seen (s).
        confirmed: whether it was ever confirmed.
        characters, ok, repaired: what was given out of it.
    """

    name: str
    number: int
    seconds: float
    confirmed: bool
    characters: int
    ok: int
    repaired: int


def try_candidate(name: str, number: int, events: Events, parameters: Parameters) -> Outcome:
    """Push a candidate through a receiver, hop by hop, and one second of silence after it."""
    t_ns, polarity = events
    if not len(t_ns):
        return Outcome(name, number, 0.0, False, 0, 0, 0)
    receiver = SignalReceiver(parameters)
    hop_ns = hop_length_ns(parameters)
    end_ns = int(t_ns[-1]) + 1
    cuts_ns = np.append(np.arange(int(t_ns[0]) + hop_ns, end_ns, hop_ns), [end_ns, end_ns + NS_PER_S])
    stops = np.searchsorted(t_ns, cuts_ns)
    characters: list[Character] = []
    confirmed = False
    start = 0
    for cut_ns, stop in zip(cuts_ns.tolist(), stops.tolist(), strict=True):
        output = receiver.push_signal(t_ns[start:stop], polarity[start:stop], cut_ns)
        start = stop
        given = [received.character for received in output.characters]
        characters += given
        confirmed |= bool(receiver.confirmed) or confirmed_at_once(given, parameters)
    characters += [received.character for received in receiver.flush().characters]
    confirmed |= bool(receiver.confirmed)
    statuses = [character.status for character in characters]
    seconds = (end_ns - int(t_ns[0])) / NS_PER_S
    return Outcome(
        name, number, seconds, confirmed, len(statuses), statuses.count(Status.OK), statuses.count(Status.REPAIRED)
    )


def confirmed_at_once(characters: Sequence[Character], parameters: Parameters) -> bool:
    """Tell whether a turn may have been confirmed and demoted within the characters of one hop (a turn's backlog)."""
    record = ParityRecord(parameters)
    return any(record.push(character) is Verdict.CONFIRMED for character in characters)


@dataclass(frozen=True, slots=True)
class Job:
    """Some candidates of one family, and the receivers to try them with."""

    name: str
    numbers: range
    seed: int
    receivers: dict[str, Parameters]
    folder: Path | None
    blind_every: int = 1

    def run(self) -> dict[str, list[Outcome]]:
        """Return the outcomes for each receiver; all of them see the same events."""
        make = beacon if self.name == CONTROL else families(self.folder)[self.name]
        outcomes: dict[str, list[Outcome]] = {receiver: [] for receiver in self.receivers}
        for number in self.numbers:
            events = candidate(make, self.name, number, self.seed)
            for receiver, parameters in self.receivers.items():
                if parameters.rate_search == 'blind' and parameters.receiver != 'threshold' and number % self.blind_every:
                    continue
                outcomes[receiver].append(try_candidate(self.name, number, events, parameters))
        return outcomes


def run_job(job: Job) -> dict[str, list[Outcome]]:
    """Run a job; for a pool of processes."""
    return job.run()


def run_jobs(jobs: Sequence[Job], processes: int) -> Iterator[dict[str, list[Outcome]]]:
    """Run jobs, here or in a pool; yield their outcomes in order."""
    if processes <= 1:
        yield from map(run_job, jobs)
        return
    with ProcessPoolExecutor(processes) as pool:
        yield from pool.map(run_job, jobs)


# Tables


def rate(count: int, trials: int) -> str:
    """Return a rate with its 95 % interval."""
    interval = wilson_interval(count / trials, trials)
    share, low, high = (f'{round(100 * x, 6):.3g}' for x in (count / trials, interval.low, interval.high))
    return f'{share} % ({low} to {high})'


COLUMNS = (
    'family', 'candidates', 'confirmed', 'false-alarm rate (95 % interval)', 'gave characters', 'gave an ok one',
    'share of that (95 % interval)', 'characters', 'ok', 'repaired', 'seconds',
)  # fmt: skip


def row(name: str, outcomes: Sequence[Outcome]) -> str:
    """Return a line of a table."""
    n = len(outcomes)
    confirmed = sum(outcome.confirmed for outcome in outcomes)
    with_ok = sum(outcome.ok > 0 for outcome in outcomes)
    cells = (
        name, n, confirmed, rate(confirmed, n), sum(outcome.characters > 0 for outcome in outcomes), with_ok,
        rate(with_ok, n), sum(outcome.characters for outcome in outcomes), sum(outcome.ok for outcome in outcomes),
        sum(outcome.repaired for outcome in outcomes), f'{sum(outcome.seconds for outcome in outcomes):.0f}',
    )  # fmt: skip
    return '| ' + ' | '.join(str(cell) for cell in cells) + ' |'


def tables(outcomes: dict[str, list[Outcome]]) -> Iterator[str]:
    """Yield the lines of one table a receiver, and of the list of what was confirmed."""
    for receiver, all_of_it in outcomes.items():
        names = list(dict.fromkeys(outcome.name for outcome in all_of_it))
        false = [outcome for outcome in all_of_it if outcome.name != CONTROL]
        yield from ('', f'## {receiver}', '', '| ' + ' | '.join(COLUMNS) + ' |', '|---' * len(COLUMNS) + '|')
        for name in names:
            if name != CONTROL:
                yield row(name, [outcome for outcome in false if outcome.name == name])
        if false:
            yield row('**all**', false)
        if CONTROL in names:
            yield row(f'*{CONTROL}*', [outcome for outcome in all_of_it if outcome.name == CONTROL])
        confirmed = [f'{outcome.name} {outcome.number}' for outcome in false if outcome.confirmed]
        if confirmed:
            yield from ('', 'Confirmed: ' + '; '.join(confirmed) + '.')


HEAD = """# False alarms: candidates that are no beacon

Lamps, PWM dimming, moving edges and noise are not characters. The test: a *candidate* is {shortest:g} to {longest:g} s of one
blob's events (patches of short bags as long as they are), drawn at random from a family below. It goes through the
receiver with the default parameters but for `rate_search`, which is `listed` or `blind`; listed rates {rates} bps: slot,
demodulator, parity record, confirmation, and new turns after each rejection for as long as it lasts. It is a **false alarm**
if it is ever confirmed, and the false-alarm rate is the share of candidates that are. What is not confirmed may still give
characters, which a node publishes as a candidate's: *ok* ones are counted too, and say that a lamp reads like characters, not
that it is a beacon. *Gave characters* is how many candidates were read at all: a receiver that
synchronises first has locked on them.

Simulated families draw their lamp anew each time: 3 to 330 events a transition, spread over 1 µs to 1 ms, with and without
stray events. Patches are 5 to 31 px wide, around one of the bag's events, with {least} events at least, over 30 to 100 %
of the bag's time, one in two looped; they overlap, so their intervals are too narrow. All receivers saw the same
candidates, with `--blind-every N` the blind ones every Nth of them.
The control is a beacon at a listed rate, through the same path: what is confirmed of it shows that the test can fail.

```
python docs/false_alarms.py {arguments}
```
"""


def text_of(outcomes: dict[str, list[Outcome]], arguments: Sequence[str]) -> str:
    """Return the whole page."""
    head = HEAD.format(
        shortest=SHORTEST_S,
        longest=LONGEST_S,
        rates=' and '.join(f'{rate_bps:g}' for rate_bps in RATES_BPS),
        least=LEAST_EVENTS,
        arguments=' '.join(arguments),
    )
    return head + '\n'.join(tables(outcomes)) + '\n'


def chosen(names: Iterable[str], wanted: str | None) -> list[str]:
    """Return the names that contain one of the words wanted (separated by commas), all without any."""
    return [name for name in names if wanted is None or any(word in name for word in wanted.split(','))]


def main() -> None:
    """Run the candidates; print the page or write it."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('--full', action='store_true', help=f'{FULL_COUNT} candidates a family, not {DEFAULT_COUNT}')
    parser.add_argument('--count', type=int, help='so many candidates a family')
    parser.add_argument('--seed', type=int, default=0)
    parser.add_argument('--families', help='only those with one of these words, separated by commas, in their names')
    parser.add_argument('--receivers', help='likewise')
    parser.add_argument(
        '--blind-every', type=int, default=1, help='every so many candidates for blind receivers, which cost most'
    )
    parser.add_argument('--processes', type=int, default=1)
    parser.add_argument('--output', type=Path, help='write the page to this file')
    arguments = parser.parse_args()
    count = arguments.count or (FULL_COUNT if arguments.full else DEFAULT_COUNT)
    folder = recordings_folder() if (recordings_folder() / BAGS[0]).is_dir() else None
    if folder is None:
        print(f'no recordings at {recordings_folder()}: no patches of bags; set BEACON_COMM_DATA', file=sys.stderr)
    declared = declared_receivers()
    receivers = {name: declared[name] for name in chosen(declared, arguments.receivers)}
    names = [*chosen(families(folder), arguments.families), CONTROL]
    jobs = [
        Job(name, range(first, min(first + 10, count)), arguments.seed, receivers, folder, arguments.blind_every)
        for name in names
        for first in range(0, count, 10)
    ]
    outcomes: dict[str, list[Outcome]] = {receiver: [] for receiver in receivers}
    for done, found in enumerate(run_jobs(jobs, arguments.processes), start=1):
        for receiver, some in found.items():
            outcomes[receiver] += some
        print(f'\r{done} of {len(jobs)}', end='', file=sys.stderr, flush=True)
    print(file=sys.stderr)
    shown = ['--full'] if arguments.full else []
    for option in ('count', 'seed', 'families', 'receivers', 'blind_every'):
        if getattr(arguments, option) not in (None, parser.get_default(option)):
            shown += [f'--{option.replace("_", "-")}', shlex.quote(str(getattr(arguments, option)))]
    page = text_of(outcomes, shown)
    if arguments.output is not None:
        arguments.output.write_text(page)
    else:
        print(page)


if __name__ == '__main__':
    main()
