"""What a report draws: a stretch of a beacon's signal, what the image showed at one instant, what was right when.

A stretch holds a few characters, and as many bits before them as the filter takes to settle::

    events    ┊·· ·· · ·· · ┊··· ·  ·· ···· ·  ·· ···  ··┊
              ┊   settling  ┊ S  H  a  l  l              ┊
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from beacon_comm.core.blobs import Blob, BlobFinder
from beacon_comm.core.character import Character
from beacon_comm.core.events import NS_PER_S, EventBatch
from beacon_comm.core.framing import CharacterFrame
from beacon_comm.core.high_pass import HighPassFilter
from beacon_comm.core.index_image import IndexImages, hop_length_ns, window_hops
from beacon_comm.core.parameters import Parameters
from beacon_comm.core.routing import Router
from beacon_comm.evaluation.result import PathPoint
from beacon_comm.evaluation.scoring import Transmission

SHOWN_CHARACTERS = 4
SETTLING_BITS = 150.0
MARGIN_BITS = 2.0
# The filtered signal is drawn at every event and between events that are farther apart than this (bits).
DECAY_STEP_BITS = 0.1

Ints = NDArray[np.int64]
Floats = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Stretch:
    """When a beacon is looked at, and why then.

    Attributes:
        begin_ns, end_ns: recording time (ns).
        bit_rate_bps: bit rate (bit/s).
        why: for the caption.
    """

    begin_ns: int
    end_ns: int
    bit_rate_bps: float
    why: str

    @property
    def bit_ns(self) -> float:
        """Length of a bit (ns)."""
        return NS_PER_S / self.bit_rate_bps

    @property
    def settling_ns(self) -> int:
        """From when on events are wanted, so that the filter has settled (ns)."""
        return self.begin_ns - round(SETTLING_BITS * self.bit_ns)


def choose_stretch(
    scores: Mapping[str, Sequence[Transmission]], characters: Sequence[Character], frame: CharacterFrame
) -> Stretch | None:
    """Choose a few characters that are worth a look.

    Args:
        scores: of one beacon, by receiver: the first error of any, else the middle of its longest sending.
        characters: what was decoded: the middle of it, where there are no scores.
        frame: layout of a character.

    Returns:
        None where nothing was decoded.
    """
    for receiver, transmissions in scores.items():
        found = [one for one in transmissions if one.found and any(e.received is not None for e in one.errors)]
        if found:
            one = found[-1]
            k = next(error.k for error in one.errors if error.received is not None)
            return _around(one, k, frame, f'around the first character that `{receiver}` reads wrong')
    sent = [one for transmissions in scores.values() for one in transmissions if one.found]
    if sent:
        one = max(sent, key=lambda transmission: transmission.characters)
        return _around(one, one.first + one.characters // 2, frame, 'in the middle of its longest sending')
    if not characters:
        return None
    middle = characters[len(characters) // 2]
    length_ns = frame.duration_ns(middle.bit_rate_bps)
    margin_ns = MARGIN_BITS * length_ns / frame.length
    begin_ns = round(middle.t_ns - length_ns - margin_ns)
    end_ns = round(middle.t_ns + (SHOWN_CHARACTERS - 1) * length_ns + margin_ns)
    return Stretch(begin_ns, end_ns, middle.bit_rate_bps, 'in the middle of what was decoded')


def _around(sent: Transmission, k: int, frame: CharacterFrame, why: str) -> Stretch:
    assert sent.start_ns is not None and sent.bit_rate_bps is not None
    length_ns = frame.duration_ns(sent.bit_rate_bps)
    margin_ns = MARGIN_BITS * length_ns / frame.length
    first = max(sent.first, min(k - 1, sent.first + sent.characters - SHOWN_CHARACTERS))
    count = min(SHOWN_CHARACTERS, sent.characters)
    begin_ns = sent.start_ns + first * length_ns
    return Stretch(round(begin_ns - margin_ns), round(begin_ns + count * length_ns + margin_ns), sent.bit_rate_bps, why)


@dataclass(frozen=True, slots=True, eq=False)
class Trace:
    """The paper's filter and levels over a stretch.

    Attributes:
        t_ns: times, increasing, ``(n,)`` int64: events, and instants between them.
        filtered: L (events), ``(n,)``.
        low, high: the levels (events), ``(n,)``.
        edges_ns, rising: edges of the binarised line, ``(m,)`` int64 and bool.
        line_before: the line before the first of them.
    """

    t_ns: Ints
    filtered: Floats
    low: Floats
    high: Floats
    edges_ns: Ints
    rising: NDArray[np.bool_]
    line_before: bool


def trace_filter(t_ns: Ints, polarity: NDArray[np.int8], stretch: Stretch, parameters: Parameters) -> Trace:
    """Run the paper's filter over a beacon's events; those before the stretch let it settle.

    Args:
        t_ns: times (ns), ``(n,)`` int64.
        polarity: ±1, ``(n,)`` int8.
        stretch: what is wanted.
        parameters: of the filter.
    """
    high_pass = HighPassFilter(stretch.bit_rate_bps, parameters)
    start, stop = (int(n) for n in np.searchsorted(t_ns, (stretch.begin_ns, stretch.end_ns)))
    settling = high_pass.push(t_ns[:start], polarity[:start])
    line = bool(settling.rising[-1]) if len(settling.rising) else True
    decay_per_ns = parameters.cutoff_per_bit / stretch.bit_ns
    step_ns = DECAY_STEP_BITS * stretch.bit_ns
    rows: list[tuple[float, float, float, float]] = []
    edges: list[tuple[int, bool]] = []
    before_ns = int(t_ns[start - 1]) if start else stretch.begin_ns
    ends_ns = [*(int(t) for t in t_ns[start:stop]), stretch.end_ns]
    for n, at_ns in enumerate(ends_ns):
        value, (low, high) = high_pass.filtered, high_pass.levels
        since = np.arange(before_ns + step_ns, at_ns, step_ns)
        rows += [(t, value * float(np.exp(-decay_per_ns * (t - before_ns))), low, high) for t in since if t >= stretch.begin_ns]
        if n < stop - start:
            one = slice(start + n, start + n + 1)
            found = high_pass.push(t_ns[one], polarity[one])
            edges += [(int(t), bool(rising)) for t, rising in zip(found.t_ns, found.rising, strict=True)]
            rows.append((at_ns, high_pass.filtered, *high_pass.levels))
        before_ns = at_ns
    columns = np.array(rows, np.float64).reshape(-1, 4)
    return Trace(
        columns[:, 0].astype(np.int64),
        columns[:, 1],
        columns[:, 2],
        columns[:, 3],
        np.array([t for t, _ in edges], np.int64),
        np.array([rising for _, rising in edges], np.bool_),
        line,
    )


@dataclass(frozen=True, slots=True, eq=False)
class SignalView:
    """A stretch of one beacon's signal, and what the receivers made of it.

    Attributes:
        name: of the beacon.
        stretch: when.
        t_ns, polarity: the beacon's events from the stretch's settling on: recording time ``(n,)`` int64, ±1 ``(n,)`` int8.
        trace: the paper's filter over the stretch.
        read: characters that begin in the stretch, by receiver.
        sent: when a character was due (ns), and its code; empty where that is not known.
    """

    name: str
    stretch: Stretch
    t_ns: Ints
    polarity: NDArray[np.int8]
    trace: Trace
    read: Mapping[str, Sequence[Character]]
    sent: Sequence[tuple[float, int]]


def sent_within(
    transmissions: Sequence[Transmission], text: str, stretch: Stretch, frame: CharacterFrame
) -> list[tuple[float, int]]:
    """Return when each character that was sent in a stretch was due (ns), and its code."""
    found = []
    for one in transmissions:
        if one.start_ns is None or one.bit_rate_bps is None:
            continue
        length_ns = frame.duration_ns(one.bit_rate_bps)
        for k in range(one.first, one.first + one.characters):
            due_ns = one.start_ns + k * length_ns
            if stretch.begin_ns <= due_ns < stretch.end_ns - 0.5 * length_ns:
                found.append((due_ns, ord(text[k])))
    return sorted(found)


@dataclass(frozen=True, slots=True)
class PathView:
    """A path over the image.

    Attributes:
        name: label, or the beacon's name.
        x_px, y_px: positions, in order of time.
        confirmed: a confirmed track's, or a true one.
        true: the truth's, not a track's.
        at: where it was at the image's instant (px, with the extent), None: not there.
    """

    name: str
    x_px: Floats
    y_px: Floats
    confirmed: bool
    true: bool
    at: tuple[float, float, float] | None


@dataclass(frozen=True, slots=True, eq=False)
class ImageView:
    """The index image of one instant, its blobs, and all paths.

    Attributes:
        t_ns: the instant (recording time, ns).
        window_s: of the index image (s).
        index: the paper's index I, ``(height, width)``.
        blobs: as the receiver finds them.
        paths: of tracks and of true beacons.
    """

    t_ns: int
    window_s: float
    index: Floats
    blobs: Sequence[Blob]
    paths: Sequence[PathView] = field(default_factory=tuple)


def image_span_ns(t_ns: int, parameters: Parameters) -> tuple[int, int]:
    """Return the hops' begin and end (ns, on their grid) of the events that the image at ``t_ns`` needs."""
    hop_ns = hop_length_ns(parameters)
    end_ns = t_ns // hop_ns * hop_ns
    return end_ns - window_hops(parameters)[-1] * hop_ns, end_ns


def view_image(
    batch: EventBatch, size: tuple[int, int], begin_ns: int, origin_ns: int, parameters: Parameters
) -> tuple[Floats, list[Blob], float]:
    """Return the short window's index image, the blobs and the window's length (s).

    Args:
        batch: events from ``begin_ns`` to its end, both points of the hops' grid (ns, sensor clock).
        size: width and height of the sensor (px).
        begin_ns: see ``batch``.
        origin_ns: sensor time at recording time 0 (ns).
        parameters: of the detection.
    """
    images, finder, router = IndexImages(parameters, size), BlobFinder(parameters, size), Router(parameters, size)
    hop_ns = hop_length_ns(parameters)
    blobs: list[Blob] = []
    for t_hop_ns in range(begin_ns, batch.t_end_ns, hop_ns):
        router.aim((), t_hop_ns)
        start, stop = np.searchsorted(batch.t_ns, (t_hop_ns, t_hop_ns + hop_ns))
        router.route(batch.slice(int(start), int(stop), t_hop_ns + hop_ns))
        images.push(router.close())
        blobs = finder.find(images, t_hop_ns + hop_ns)
    window = images.windows[0]
    return images.index(window), blobs, window.hops * parameters.hop_s


def thin(path: Sequence[PathPoint], most: int = 600) -> list[PathPoint]:
    """Return at most about so many points of a path."""
    return list(path[:: max(1, -(-len(path) // most))])
