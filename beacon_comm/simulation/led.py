"""The events of one LED's blob: a beacon that sends text, a lamp that flickers, and noise.

    level    ‾‾‾‾‾‾‾|____________|‾‾‾‾‾‾‾‾‾‾‾‾‾
    OFF events       ·········· · · ·           burst after the fall: delay, then an exponential tail
    ON events   · · ·             ·············· ·· · · ·     the same after the rise, longer; a few while held

A transition starts a burst of its polarity, whose events come after ``delay`` plus an exponential latency; the burst
ends where the next transition takes effect.  At a high bit rate the tail of a burst therefore lasts for as long as
the level is held, and every bit looks alike; at a low one nearly everything comes at the edges.  A burst is weaker
when the level before was held only briefly: 1 − exp(−held / memory).

The defaults come close to the counts and latencies measured on the outdoor recordings at 30 m, at 504 and at
3125 bps: events a bit, ON to OFF ratio, latencies.  Not modelled: the refractory period (lockstep bursts), single
pixels' thresholds, distance, the transmitter's clock error.  A study of limits needs more than this.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from beacon_comm.core.errors import ParameterError
from beacon_comm.core.events import NS_PER_S, EventBatch
from beacon_comm.core.framing import CharacterFrame, transitions

Events = tuple[NDArray[np.int64], NDArray[np.int8]]
_TIME_STEP_NS = 1000  # sensors stamp in whole microseconds


@dataclass(frozen=True, slots=True)
class Burst:
    """What a transition to one level causes.

    Attributes:
        events: mean number of events of a whole burst.
        variation: standard deviation of that number over its mean.
        delay_s: time until the first of them.
        spread_s: time constant of their exponential latency beyond the delay.
        memory_s: time constant with which a held level restores the strength of the next burst.
        held_per_s: rate of further events of this polarity while the level is held (1/s).
    """

    events: float
    variation: float
    delay_s: float
    spread_s: float
    memory_s: float
    held_per_s: float


@dataclass(frozen=True, slots=True)
class LedModel:
    """An LED and the pixels that see it: bursts of ON events after a rise, of OFF events after a fall.

    Attributes:
        rise, fall: see :class:`Burst`.
        stray_per_s: rate of events of either polarity at any time (1/s).
    """

    rise: Burst = Burst(330.0, 0.18, 115e-6, 450e-6, 0.22e-3, 3000.0)
    fall: Burst = Burst(185.0, 0.26, 105e-6, 145e-6, 0.18e-3, 1500.0)
    stray_per_s: float = 300.0


OUTDOOR_30_M = LedModel()


def simulate_text(
    text: str,
    bit_rate_bps: float,
    *,
    t0_ns: int = 0,
    lead_s: float = 0.1,
    tail_s: float = 0.1,
    frame: CharacterFrame | None = None,
    model: LedModel = OUTDOOR_30_M,
    seed: int = 0,
) -> Events:
    """Return the events of a beacon that sends ``text`` once, between two stretches of idle line.

    Args:
        text: what it sends.
        bit_rate_bps: the bit rate (bit/s).
        t0_ns: time of the first start bit (ns).
        lead_s, tail_s: idle line before and after (s).
        frame: character framing; None: the default one.
        model: the LED.
        seed: of the random numbers.

    Returns:
        ``(t_ns, polarity)``: ns (whole microseconds, non-decreasing) ``(n,)`` int64, and +1 / -1 ``(n,)`` int8.

    Raises:
        FramingError: a character that the frame cannot carry.
    """
    bits = (frame or CharacterFrame()).encode_bits(text)
    changes_ns, levels = transitions(bits, bit_rate_bps, t0_ns)
    end_ns = t0_ns + round(len(bits) / bit_rate_bps * NS_PER_S)
    return simulate_levels(
        changes_ns,
        levels,
        t0_ns - round(lead_s * NS_PER_S),
        end_ns + round(tail_s * NS_PER_S),
        model=model,
        seed=seed,
    )


def square_wave(
    frequency_hz: float,
    duty: float,
    duration_s: float,
    *,
    t0_ns: int = 0,
    model: LedModel = OUTDOOR_30_M,
    seed: int = 0,
) -> Events:
    """Return the events of a lamp that is on for a share ``duty`` of each period.

    Args:
        frequency_hz: its frequency (Hz).
        duty: share of the period that it is on, in (0, 1).
        duration_s: how long (s).
        t0_ns: time of its first rise (ns).
        model: the LED.
        seed: of the random numbers.

    Returns:
        As :func:`simulate_text`.

    Raises:
        ParameterError: a frequency, duty or duration out of range.
    """
    if not 0.0 < duty < 1.0:
        raise ParameterError(f'duty = {duty:g}: must lie between 0 and 1')
    if not (frequency_hz > 0.0 and duration_s >= 0.0 and math.isfinite(frequency_hz * duration_s)):
        raise ParameterError(f'frequency {frequency_hz:g} Hz for {duration_s:g} s: must be positive')
    periods = math.ceil(frequency_hz * duration_s)
    begins = np.arange(periods)[:, None] + np.array([0.0, duty])
    changes_ns = t0_ns + np.rint(begins.ravel() / frequency_hz * NS_PER_S).astype(np.int64)
    end_ns = t0_ns + round(duration_s * NS_PER_S)
    kept = changes_ns < end_ns
    levels = np.tile(np.array([1, 0], np.uint8), periods)
    return simulate_levels(changes_ns[kept], levels[kept], t0_ns, end_ns, model=model, seed=seed)


def simulate_levels(
    changes_ns: NDArray[np.int64],
    levels: NDArray[np.uint8],
    start_ns: int,
    end_ns: int,
    *,
    model: LedModel = OUTDOOR_30_M,
    seed: int = 0,
) -> Events:
    """Return the events of an LED whose level changes at given times.

    Args:
        changes_ns: times of the level changes (ns, increasing), ``(k,)``.
        levels: level from each change on, 0 or 1 in alternation, ``(k,)``.
        start_ns, end_ns: the time simulated (ns); the level before the first change is its opposite, held for long.
        model: the LED.
        seed: of the random numbers.

    Returns:
        As :func:`simulate_text`.

    Raises:
        ParameterError: times that do not increase, or levels that do not alternate.
    """
    changes_ns = np.asarray(changes_ns, np.int64)
    levels = np.asarray(levels, np.uint8)
    if len(changes_ns) != len(levels) or np.any(np.diff(changes_ns) <= 0):
        raise ParameterError('level changes: times must increase, one level each')
    if np.any(levels > 1) or np.any(np.diff(levels.astype(np.int8)) == 0):
        raise ParameterError('level changes: levels must alternate between 0 and 1')
    random = np.random.default_rng(seed)
    parts = [
        noise(model.stray_per_s, (end_ns - start_ns) / NS_PER_S, t0_ns=start_ns, seed=int(random.integers(2**32)))
    ]
    for level, burst, polarity in ((1, model.rise, 1), (0, model.fall, -1)):
        parts.append(_held(random, changes_ns, levels, start_ns, end_ns, level, burst, polarity))
        parts.append(_bursts(random, changes_ns, levels, end_ns, level, model, polarity))
    return _sorted(parts, start_ns, end_ns)


def noise(rate_per_s: float, duration_s: float, *, on_share: float = 0.5, t0_ns: int = 0, seed: int = 0) -> Events:
    """Return events at random: a Poisson process of ``rate_per_s`` (1/s), a share ``on_share`` of them ON.

    Returns:
        As :func:`simulate_text`.
    """
    random = np.random.default_rng(seed)
    count = int(random.poisson(rate_per_s * duration_s))
    t_ns = t0_ns + np.floor(random.random(count) * duration_s * NS_PER_S).astype(np.int64)
    polarity = np.where(random.random(count) < on_share, 1, -1).astype(np.int8)
    return _sorted([(t_ns, polarity)], t0_ns, t0_ns + round(duration_s * NS_PER_S))


def sensor_noise(
    rate_per_s: float, duration_s: float, width: int, height: int, *, t0_ns: int = 0, seed: int = 0
) -> EventBatch:
    """Return Poisson noise of ``rate_per_s`` (1/s) in all, spread evenly over a sensor's pixels."""
    t_ns, polarity = noise(rate_per_s, duration_s, t0_ns=t0_ns, seed=seed)
    random = np.random.default_rng([seed, 1])
    x = random.integers(width, size=len(t_ns)).astype(np.uint16)
    y = random.integers(height, size=len(t_ns)).astype(np.uint16)
    return EventBatch(x, y, polarity, t_ns, t0_ns + round(duration_s * NS_PER_S))


def _bursts(
    random: np.random.Generator,
    changes_ns: NDArray[np.int64],
    levels: NDArray[np.uint8],
    end_ns: int,
    level: int,
    model: LedModel,
    polarity: int,
) -> Events:
    burst, other = (model.rise, model.fall) if level == 1 else (model.fall, model.rise)
    ours = np.flatnonzero(levels == level)
    begins_ns = changes_ns[ours]
    held_s = np.diff(changes_ns, prepend=-(2**62)).astype(np.float64)[ours] / NS_PER_S
    # The burst gives way when the next transition's own burst begins.
    ends_ns = np.append(changes_ns[1:] + round(other.delay_s * NS_PER_S), end_ns)[ours]
    strength = 1.0 - np.exp(-held_s / burst.memory_s)
    strength = strength * np.maximum(random.normal(1.0, burst.variation, len(ours)), 0.0)
    counts = random.poisson(burst.events * strength)
    latency_s = burst.delay_s + random.exponential(burst.spread_s, int(counts.sum()))
    t_ns = np.repeat(begins_ns, counts) + np.rint(latency_s * NS_PER_S).astype(np.int64)
    t_ns = t_ns[t_ns < np.repeat(ends_ns, counts)]
    return t_ns, np.full(len(t_ns), polarity, np.int8)


def _held(
    random: np.random.Generator,
    changes_ns: NDArray[np.int64],
    levels: NDArray[np.uint8],
    start_ns: int,
    end_ns: int,
    level: int,
    burst: Burst,
    polarity: int,
) -> Events:
    duration_s = (end_ns - start_ns) / NS_PER_S
    count = int(random.poisson(burst.held_per_s * duration_s))
    t_ns = start_ns + np.floor(random.random(count) * duration_s * NS_PER_S).astype(np.int64)
    before = np.uint8(1 - levels[0]) if len(levels) else np.uint8(1)
    level_then = np.concatenate(([before], levels))[np.searchsorted(changes_ns, t_ns, side='right')]
    t_ns = t_ns[level_then == level]
    return t_ns, np.full(len(t_ns), polarity, np.int8)


def _sorted(parts: list[Events], start_ns: int, end_ns: int) -> Events:
    t_ns = np.concatenate([part[0] for part in parts])
    polarity = np.concatenate([part[1] for part in parts])
    t_ns = t_ns // _TIME_STEP_NS * _TIME_STEP_NS
    kept = (t_ns >= start_ns) & (t_ns < end_ns)
    t_ns, polarity = t_ns[kept], polarity[kept]
    order = np.argsort(t_ns, kind='stable')
    return t_ns[order], polarity[order]
