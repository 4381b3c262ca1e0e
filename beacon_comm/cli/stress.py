"""``beacon_evaluate --stress``: every receiver over waveforms that are made harder to read, step by step.

::

    .mat ──────────► decode, score: when was what sent? ─┐
    simulated text ─► known ─────────────────────────────┤
                                                         ▼
    events ─► stress ─► receive_signal ─► characters ─► times carried back ─► score_at ─► StressCount
              └─ warp ───────────────────────────────────▲
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import PurePath
from typing import Any

import numpy as np
from numpy.typing import NDArray

from beacon_comm.cli.offline import is_mat, receive_signal
from beacon_comm.cli.progress import progress
from beacon_comm.core.character import Character
from beacon_comm.core.errors import ParameterError, RecordingError
from beacon_comm.core.events import NS_PER_S
from beacon_comm.core.framing import CharacterFrame
from beacon_comm.core.parameters import Parameters
from beacon_comm.evaluation.held import Signal
from beacon_comm.evaluation.receivers import declared_receivers
from beacon_comm.evaluation.scoring import Transmission, not_found, score, score_at
from beacon_comm.evaluation.stress_report import Stress, StressCount, StressedWaveform, StressResults
from beacon_comm.recordings.folder import recordings_folder
from beacon_comm.recordings.mat import read_mat
from beacon_comm.simulation.led import OUTDOOR_30_M, simulate_text
from beacon_comm.simulation.stress import (
    Events,
    Warp,
    clock_warp,
    drift_warp,
    from_another_time,
    jitter_warp,
    looped,
    thinned,
    with_background,
    with_fading,
    with_gaps,
    with_leak,
)

RECORDINGS = ('504hz_30m.mat', '3125hz_30m.mat')
SIMULATED_BPS = (504.0, 1000.0, 3125.0)
REFERENCE = 'threshold'
SEED = 1
SIMULATED_START_NS = NS_PER_S // 5
# A simulated beacon of another rate, where no other recording is there to leak in.
SLOW_BPS, FAST_BPS = 504.0, 3125.0
# A rate is listed if one of the list is as near as this (share).
SAME_RATE = 0.02
SWING_WITHIN_S = 1.0
GAP_EVERY_BITS = 330.0
# A gap this near before or after a character touches it: it takes the events of its first or last edge (bits).
GAP_MARGIN_BITS = 0.5

STRESSES = (
    Stress(
        'thinned',
        'Events thinned',
        'Each event is kept with this probability, independently.',
        'events kept (%)',
        '%',
        (100.0, 50.0, 25.0, 10.0, 5.0),
        100.0,
        10.0,
        logarithmic=True,
    ),
    Stress(
        'clock',
        'Clock off',
        "The sender's clock runs faster (+) or slower (−) by this share, from beginning to end.",
        "sender's bit rate off by (%)",
        '%',
        (-2.0, -1.0, 0.0, 1.0, 2.0),
        0.0,
        2.0,
    ),
    Stress(
        'drift',
        'Clock drifting',
        "The sender's bit rate swings like a sine, to either side by this share; from slowest to fastest within 1 s.",
        'swing of the bit rate (± %)',
        '%',
        (0.0, 0.1, 0.5, 1.0, 2.0),
        0.0,
        2.0,
    ),
    Stress(
        'jitter',
        'Edge jitter',
        'Every edge, with its events, comes early or late by its own normally distributed time; its standard deviation'
        ' is this share of a bit.',
        'jitter (% of a bit)',
        '%',
        (0.0, 5.0, 10.0, 15.0, 20.0),
        0.0,
        10.0,
    ),
    Stress(
        'background',
        'Background events',
        "A Poisson process of this many events for each event of the signal, with the signal's share of ON events.",
        'background per signal event',
        ': 1',
        (0.0, 0.25, 0.5, 1.0, 2.0),
        0.0,
        1.0,
    ),
    Stress(
        'gaps',
        'Gaps',
        f'All events of this many bits are lost, at a random place in every {GAP_EVERY_BITS:g} bits'
        f' ({GAP_EVERY_BITS / 11:g} characters), while the sender goes on. A character that lies in a gap counts as wrong.',
        'length of a gap (bits)',
        'bits',
        (0.0, 1.0, 3.0, 10.0, 25.0, 50.0),
        0.0,
        50.0,
        logarithmic=True,
    ),
    Stress(
        'fading',
        'Fading',
        'The share of events that are kept swings between all and one in so many, from one end to the other within 1 s.',
        'strongest : weakest',
        ': 1',
        (1.0, 3.0, 10.0, 20.0),
        1.0,
        10.0,
        logarithmic=True,
    ),
    Stress(
        'leak',
        'Another beacon leaks in',
        "This share of a second beacon's events is mixed in; it sends the same text at another bit rate. A beacon at 3125"
        ' bps has several times the events a second of one at 504 bps: where they come to more than the own ones, a'
        " receiver that lists both rates may read the other beacon, and what it reads counts as inserted.",
        "other beacon's events (%)",
        '%',
        (0.0, 10.0, 20.0, 40.0),
        0.0,
        20.0,
    ),
    Stress(
        'leak_relative',
        'Another beacon leaks in, by the own events',
        "As before, but so many of the second beacon's events that they come to this share of the waveform's own.",
        'other over own events (%)',
        '%',
        (0.0, 5.0, 10.0, 20.0),
        0.0,
        20.0,
    ),
    Stress(
        'leak_same',
        'A beacon of the same bit rate leaks in',
        "This share of a second beacon's events is mixed in: the same waveform, begun in its middle.",
        "other beacon's events (%)",
        '%',
        (0.0, 10.0, 20.0, 40.0),
        0.0,
        20.0,
    ),
)


@dataclass(frozen=True, slots=True)
class Waveform:
    """Events of one beacon, and what was sent when.

    Attributes:
        name: for people.
        t_ns, polarity: the events; times from 0 on.
        bit_rate_bps: the sender's (bit/s).
        sent: the sendings of the truth.
        edges_ns: when the events of each sending's first edge begin (ns).
    """

    name: str
    t_ns: NDArray[np.int64]
    polarity: NDArray[np.int8]
    bit_rate_bps: float
    sent: tuple[Transmission, ...]
    edges_ns: tuple[float, ...]


@dataclass(frozen=True, slots=True)
class Stressed:
    """A waveform's events after a stress.

    Attributes:
        t_ns, polarity: the events.
        warp: what their times went through, None: nothing.
        gaps_ns: beginnings and ends of gaps (ns), ``(k, 2)``; None: it was no matter of gaps.
    """

    t_ns: NDArray[np.int64]
    polarity: NDArray[np.int8]
    warp: Warp | None = None
    gaps_ns: NDArray[np.int64] | None = None


def run_stress(
    recordings: Sequence[str],
    truth: str,
    parameters: Parameters,
    *,
    only: Sequence[str] | None = None,
    receivers: Sequence[str] | None = None,
    simulated_bps: Sequence[float] = SIMULATED_BPS,
) -> StressResults:
    """Measure all receivers over all waveforms and stresses.

    Args:
        recordings: .mat files; a bag holds more than one beacon.
        truth: text that was sent.
        parameters: for all receivers; its ``bit_rates`` are listed, a simulated beacon's own besides.
        only: names of stresses; None: all.
        receivers: names as :func:`~beacon_comm.evaluation.receivers.declared_receivers` has them; None: all.
        simulated_bps: bit rates to simulate the truth at (bit/s).

    Raises:
        BeaconCommError: an unknown name, a recording that cannot be read or in which the truth is not found, a truth
            that cannot be sent.
    """
    stresses = chosen_stresses(only)
    groups = [
        [recorded(path, truth, parameters) for path in recordings],
        [simulated(truth, rate, parameters) for rate in simulated_bps],
    ]
    waveforms = [waveform for group in groups for waveform in group]
    if not waveforms:
        raise RecordingError('--stress: no recording, and nothing simulated')
    others = [_other(group, place, truth, parameters) for group in groups for place in range(len(group))]
    measured = {waveform.name: receivers_for(waveform, parameters, receivers) for waveform in waveforms}
    jobs = [
        (stress, waveform, other, severity)
        for stress in stresses
        for waveform, other in zip(waveforms, others, strict=True)
        for severity in stress.severities
    ]
    unstressed: dict[tuple[str, str], StressCount] = {}
    counts = []
    for stress, waveform, other, severity in _announced(jobs):
        made: Stressed | None = None
        for receiver, setting in measured[waveform.name].items():
            if severity == stress.none and (waveform.name, receiver) in unstressed:
                counts.append(_as(unstressed[waveform.name, receiver], stress, severity))
                continue
            made = apply(stress.name, severity, waveform, other) if made is None else made
            count = count_of(stress, severity, waveform, made, receiver, setting, truth)
            if severity == stress.none:
                unstressed[waveform.name, receiver] = count
                count = _as(count, stress, severity)
            counts.append(count)
    return StressResults(
        stresses,
        tuple(_described(waveform, measured[waveform.name]) for waveform in waveforms),
        tuple(measured[waveforms[0].name]),
        tuple(counts),
    )


def chosen_stresses(only: Sequence[str] | None) -> tuple[Stress, ...]:
    """Return the stresses of these names, all for None.

    Raises:
        ParameterError: an unknown name.
    """
    known = {stress.name: stress for stress in STRESSES}
    for name in only or ():
        if name not in known:
            raise ParameterError(f'--stress-only {name}: must be some of {", ".join(known)}')
    return tuple(stress for stress in STRESSES if only is None or stress.name in only)


def default_recordings() -> list[str]:
    """Return the paper's recordings at 30 m that are in ``BEACON_COMM_DATA``, by default ``../shared/data``."""
    folder = recordings_folder()
    return [str(folder / name) for name in RECORDINGS if (folder / name).is_file()]


def recorded(path: str, truth: str, parameters: Parameters) -> Waveform:
    """Return a recorded waveform; what was sent when is what the paper's receiver finds in it as it is.

    Raises:
        RecordingError: no .mat file, or the truth is not found in it.
    """
    if not is_mat(path):
        raise RecordingError(f'{path}: --stress takes .mat files of one beacon')
    t_ns, polarity = read_mat(path)
    if not len(t_ns):
        raise RecordingError(f'{path}: no events')
    t_ns = t_ns - t_ns[0]
    reference = _all_receivers(parameters, parameters.bit_rates)[REFERENCE]
    characters = receive_signal(t_ns, polarity, reference).characters
    frame = CharacterFrame.from_parameters(parameters)
    sent = score(characters, truth, (0, int(t_ns[-1])), Signal(t_ns, polarity), frame)
    if not sent:
        raise RecordingError(f'{path}: the truth is not found in it, so that nothing can be compared')
    rates = [transmission.bit_rate_bps for transmission in sent if transmission.bit_rate_bps is not None]
    starts = [float(transmission.start_ns) for transmission in sent if transmission.start_ns is not None]
    return Waveform(PurePath(path).stem, t_ns, polarity, float(np.median(rates)), sent, tuple(starts))


def simulated(truth: str, bit_rate_bps: float, parameters: Parameters) -> Waveform:
    """Return a simulated waveform that sends the truth once.

    Raises:
        FramingError: a character that the frame cannot carry.
    """
    frame = CharacterFrame.from_parameters(parameters)
    t_ns, polarity = simulate_text(truth, bit_rate_bps, t0_ns=SIMULATED_START_NS, frame=frame, seed=SEED)
    sent = replace(not_found(truth, frame), start_ns=SIMULATED_START_NS, bit_rate_bps=bit_rate_bps)
    edge_ns = SIMULATED_START_NS + OUTDOOR_30_M.fall.delay_s * NS_PER_S
    return Waveform(f'simulated {bit_rate_bps:g} bps', t_ns, polarity, bit_rate_bps, (sent,), (edge_ns,))


def receivers_for(
    waveform: Waveform, parameters: Parameters, names: Sequence[str] | None = None
) -> dict[str, Parameters]:
    """Return the receivers to measure, each with the waveform's rate among the listed ones.

    Raises:
        ParameterError: an unknown name.
    """
    listed = parameters.bit_rates
    if not any(abs(rate / waveform.bit_rate_bps - 1.0) < SAME_RATE for rate in listed):
        listed = tuple(sorted((*listed, waveform.bit_rate_bps)))
    found = _all_receivers(parameters, listed)
    for name in names or ():
        if name not in found:
            raise ParameterError(f'receiver {name}: must be some of {", ".join(found)}')
    ordered = sorted(found.items(), key=lambda entry: entry[0] != REFERENCE)  # the paper's first
    return {name: setting for name, setting in ordered if names is None or name in names}


def _all_receivers(parameters: Parameters, listed_bps: tuple[float, ...]) -> dict[str, Parameters]:
    values: dict[str, Any] = {f.name: getattr(parameters, f.name) for f in fields(Parameters)}
    for name in ('receiver', 'blind'):
        values.pop(name, None)
    return declared_receivers(**{**values, 'bit_rates': listed_bps})


def apply(name: str, severity: float, waveform: Waveform, other: Events) -> Stressed:
    """Return a waveform's events under one stress; ``other``: events of a second beacon."""
    return APPLIED[name](severity, waveform, other)


def count_of(
    stress: Stress,
    severity: float,
    waveform: Waveform,
    made: Stressed,
    receiver: str,
    parameters: Parameters,
    truth: str,
) -> StressCount:
    """Run one receiver over a stressed waveform and count."""
    frame = CharacterFrame.from_parameters(parameters)
    characters: Sequence[Character] = ()
    if len(made.t_ns):
        characters = receive_signal(made.t_ns, made.polarity, parameters).characters
    if made.warp is not None and characters:
        t_ns = made.warp.undo(np.array([character.t_ns for character in characters], np.int64))
        characters = [replace(character, t_ns=int(t)) for character, t in zip(characters, t_ns, strict=True)]
    scores = score_at(characters, truth, waveform.sent, frame)
    sent = sum(found.characters for found in scores)
    missing = sum(found.missing for found in scores)
    inserted = sum(found.inserted for found in scores)
    untouched = None if made.gaps_ns is None else _untouched(scores, made.gaps_ns, frame.length)
    return StressCount(
        stress=stress.name,
        waveform=waveform.name,
        receiver=receiver,
        severity=severity,
        events=len(made.t_ns),
        characters=sent,
        wrong=sum(found.wrong for found in scores),
        missing=missing,
        inserted=inserted,
        wrong_ok=sum(found.wrong_ok for found in scores),
        repaired=sum(found.repaired for found in scores),
        outside=len(characters) - (sent - missing + inserted),
        untouched=None if untouched is None else untouched[0],
        untouched_wrong=None if untouched is None else untouched[1],
    )


def _untouched(
    scores: Sequence[Transmission], gaps_ns: NDArray[np.int64], frame_bits: int
) -> tuple[int, int]:
    """Return how many characters no gap touched, and how many of these are wrong or missing."""
    count = wrong = 0
    for found in scores:
        if found.start_ns is None or found.bit_rate_bps is None:
            continue
        bit_ns = NS_PER_S / found.bit_rate_bps
        k = np.arange(found.first, found.first + found.characters)
        begins_ns = found.start_ns + (k * frame_bits - GAP_MARGIN_BITS) * bit_ns
        ends_ns = begins_ns + (frame_bits + 2 * GAP_MARGIN_BITS) * bit_ns
        # Gaps that begin before the character's end, less those that ended before its beginning.
        begun = np.searchsorted(gaps_ns[:, 0], ends_ns)
        ended = np.searchsorted(gaps_ns[:, 1], begins_ns, side='right')
        free = set(k[begun == ended].tolist())
        count += len(free)
        wrong += sum(error.k in free for error in found.errors)
    return count, wrong


def _as(count: StressCount, stress: Stress, severity: float) -> StressCount:
    """Return the unstressed count as that of a stress's mildest severity."""
    if stress.name != 'gaps':
        return replace(count, stress=stress.name, severity=severity, untouched=None, untouched_wrong=None)
    wrong = count.wrong - count.inserted
    return replace(
        count, stress=stress.name, severity=severity, untouched=count.characters, untouched_wrong=wrong
    )


def _other(group: Sequence[Waveform], place: int, truth: str, parameters: Parameters) -> Events:
    """Return the events of a second beacon of another bit rate: the group's next one, or a simulated one."""
    own_bps = group[place].bit_rate_bps
    for waveform in (*group[place + 1 :], *group[:place]):
        if abs(waveform.bit_rate_bps / own_bps - 1.0) > SAME_RATE:
            return waveform.t_ns, waveform.polarity
    rate = FAST_BPS if abs(FAST_BPS / own_bps - 1.0) > SAME_RATE else SLOW_BPS
    waveform = simulated(truth, rate, parameters)
    return waveform.t_ns, waveform.polarity


def _described(waveform: Waveform, receivers: Mapping[str, Parameters]) -> StressedWaveform:
    return StressedWaveform(
        waveform.name,
        len(waveform.t_ns),
        waveform.bit_rate_bps,
        next(iter(receivers.values())).bit_rates,
        len(waveform.sent),
        sum(transmission.characters for transmission in waveform.sent),
    )


Job = tuple[Stress, Waveform, Events, float]


def _announced(jobs: Sequence[Job]) -> Iterator[Job]:
    """Pass the jobs through; on stderr a bar on a terminal, else a line for each stress."""
    names = list(dict.fromkeys(stress.name for stress, *_ in jobs))
    said = None
    for job in progress(jobs, 'stress', len(jobs)):
        name = job[0].name
        if name != said and not sys.stderr.isatty():
            print(f'{name}: {names.index(name) + 1} of {len(names)}', file=sys.stderr, flush=True)
        said = name
        yield job


def _thinned(severity: float, waveform: Waveform, _: Events) -> Stressed:
    return Stressed(*thinned(waveform.t_ns, waveform.polarity, severity / 100.0, SEED))


def _clock(severity: float, waveform: Waveform, _: Events) -> Stressed:
    return _warped(waveform, clock_warp(waveform.t_ns, 1.0 + severity / 100.0))


def _drift(severity: float, waveform: Waveform, _: Events) -> Stressed:
    return _warped(waveform, drift_warp(waveform.t_ns, severity / 100.0, SWING_WITHIN_S))


def _jitter(severity: float, waveform: Waveform, _: Events) -> Stressed:
    warp = jitter_warp(waveform.t_ns, waveform.bit_rate_bps, severity / 100.0, waveform.edges_ns, SEED)
    # What was sent when has not moved: only its edges tremble.
    return replace(_warped(waveform, warp), warp=None)


def _background(severity: float, waveform: Waveform, _: Events) -> Stressed:
    return Stressed(*with_background(waveform.t_ns, waveform.polarity, severity, SEED))


def _gaps(severity: float, waveform: Waveform, _: Events) -> Stressed:
    t_ns, polarity, gaps_ns = with_gaps(
        waveform.t_ns, waveform.polarity, waveform.bit_rate_bps, severity, GAP_EVERY_BITS, SEED
    )
    return Stressed(t_ns, polarity, gaps_ns=gaps_ns)


def _fading(severity: float, waveform: Waveform, _: Events) -> Stressed:
    return Stressed(*with_fading(waveform.t_ns, waveform.polarity, severity, seed=SEED))


def _leak(severity: float, waveform: Waveform, other: Events) -> Stressed:
    return Stressed(*with_leak(waveform.t_ns, waveform.polarity, *other, severity / 100.0, SEED))


def _leak_relative(severity: float, waveform: Waveform, other: Events) -> Stressed:
    begin_ns, end_ns = int(waveform.t_ns[0]), int(waveform.t_ns[-1])
    whole = len(looped(*other, begin_ns, end_ns)[0])
    return _leak(min(100.0, severity * len(waveform.t_ns) / whole), waveform, other)


def _leak_same(severity: float, waveform: Waveform, _: Events) -> Stressed:
    return _leak(severity, waveform, from_another_time(waveform.t_ns, waveform.polarity))


def _warped(waveform: Waveform, warp: Warp) -> Stressed:
    return Stressed(warp.apply(waveform.t_ns), waveform.polarity, warp)


APPLIED: dict[str, Callable[[float, Waveform, Events], Stressed]] = {
    'thinned': _thinned,
    'clock': _clock,
    'drift': _drift,
    'jitter': _jitter,
    'background': _background,
    'gaps': _gaps,
    'fading': _fading,
    'leak': _leak,
    'leak_relative': _leak_relative,
    'leak_same': _leak_same,
}
