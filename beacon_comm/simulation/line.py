"""What a beacon's line does: its text over and over, with idle line between the sendings and while it is told to idle.

idle (1) ──┐sending├── gap ──┐sending├── gap ──┐send      ├──── idle ────┐sending├──
           start_s                                 cut at a character       begins anew
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from beacon_comm.core.events import NS_PER_S
from beacon_comm.core.framing import CharacterFrame
from beacon_comm.simulation.description import BeaconKeys
from beacon_comm.simulation.trajectory import Times
from beacon_comm.simulation.truth import Levels


@dataclass(frozen=True, slots=True, eq=False)
class Line:
    """A line over a scene's time.

    Attributes:
        bit_rate_bps: the actual rate (bit/s), with the clock's error.
        sendings_ns: begin of each sending, ``(s,)`` int64.
        characters_ns: begin of each character's start bit, ``(n,)`` int64.
        codes: of each character, ``(n,)`` uint8.
        changes_ns, levels: transitions, ``(k,)`` int64, and the level from each on, ``(k,)`` uint8; 1 before the first.
    """

    bit_rate_bps: float
    sendings_ns: Times
    characters_ns: Times
    codes: Levels
    changes_ns: Times
    levels: Levels


def line_of(beacon: BeaconKeys, duration_s: float) -> Line:
    """Return what a beacon's line does in a scene of a duration (s); a character that the end cuts is not listed."""
    frame = CharacterFrame()
    bit_rate_bps = beacon.bit_rate_bps[0] * (1.0 + 1e-6 * beacon.clock_ppm)
    bit_ns = NS_PER_S / bit_rate_bps
    codes = np.frombuffer(beacon.text.encode('ascii'), np.uint8)
    bits = frame.encode_bits(beacon.text)
    end_ns = duration_s * NS_PER_S
    busy = sorted((begin * NS_PER_S, end * NS_PER_S) for begin, end in beacon.idle_s)
    sendings, starts, sent, times, levels = [], [], [], [], []
    now_ns = beacon.start_s * NS_PER_S
    while now_ns < end_ns:
        resting = [end for begin, end in busy if begin <= now_ns < end]
        if resting:
            now_ns = max(resting)
            continue
        until_ns = min([begin for begin, _ in busy if begin > now_ns] + [end_ns])
        count = min(int((until_ns - now_ns) / (bit_ns * frame.length) + 1e-9), len(codes))
        if count == 0:
            if until_ns >= end_ns:
                break
            now_ns = until_ns
            continue
        sendings.append(now_ns)
        starts.append(now_ns + np.arange(count) * (frame.length * bit_ns))
        sent.append(codes[:count])
        some = bits[: count * frame.length].astype(np.int8)
        changes = np.flatnonzero(np.diff(np.concatenate(([1], some, [1])).astype(np.int8)))
        times.append(now_ns + changes * bit_ns)
        levels.append(np.concatenate((some, [1]))[changes])
        now_ns += (count * frame.length + (beacon.gap_bits if count == len(codes) else 0.0)) * bit_ns
        if count < len(codes):
            if until_ns >= end_ns:
                break
            now_ns = until_ns
    return Line(
        bit_rate_bps,
        _times([np.array(sendings)]),
        _times(starts),
        np.concatenate([np.empty(0, np.uint8), *sent]),
        _times(times),
        np.concatenate([np.empty(0, np.uint8), *levels]).astype(np.uint8),
    )


def _times(parts: list[np.ndarray]) -> Times:
    return np.rint(np.concatenate([np.empty(0), *parts])).astype(np.int64)
