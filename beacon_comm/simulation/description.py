"""What a scene file says: the sensor, the camera, the background, beacons and distractors, each key declared once.

    duration_s: 5
    beacons:
      - text: Hello
        bit_rate_bps: 1000
        path: {kind: line, from_px: [100, 200], speed_px_per_s: 800}

``python -P -m beacon_comm.simulation.description`` prints the table of all keys (``docs/scenes_format.md``).

Brightness is relative: 1 is the background of the outdoor recordings in full sun.  ``contrast`` is an LED's share: by how
many times the background's irradiance it adds to the pixel in the middle of its spot while it is on.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

from beacon_comm.core.errors import ParameterError, RecordingError
from beacon_comm.core.framing import CharacterFrame
from beacon_comm.core.yaml_text import load_yaml
from beacon_comm.simulation.keys import (
    key,
    list_of,
    number,
    number_or_list,
    numbers,
    part,
    part_of_kind,
    read_part,
    rows,
    whole,
    words,
)
from beacon_comm.simulation.paths import PATHS, PathKind, Shake, Still

REFERENCE_M = 30.0
PAPER_SLEW = 'the paper, section IV'
DEFAULT_TEXT = 'The quick brown fox jumps over the lazy dog. '
_SPANS = rows(2, '[begin_s, end_s]', spans=True)
_DAY_S = 86_400.0


@dataclass(frozen=True, slots=True)
class Sensor:
    """The event camera.  The defaults are fitted to the outdoor recordings at 30 m (docs/simulator.md)."""

    width: int = key(whole, 'px', 'columns', 640, low=16, high=2048)
    height: int = key(whole, 'px', 'rows', 480, low=16, high=2048)
    threshold_on: float = key(
        number, 'ln', 'step of log intensity for an ON event', 0.0955, low=0.02, high=2, source='Lichtsteiner et al. 2008'
    )
    threshold_off: float = key(
        number, 'ln', 'the same for an OFF event', 0.134, low=0.02, high=2, source='Lichtsteiner et al. 2008'
    )
    threshold_mismatch: float = key(
        number,
        '',
        'standard deviation of the thresholds from pixel to pixel, as a share',
        0.05,
        low=0,
        high=0.5,
        source='Lichtsteiner et al. 2008; Hu et al. 2021',
    )
    threshold_noise: float = key(
        number, '', 'the same from event to event in one pixel', 0.03, low=0, high=0.5, source='Lin et al. 2022'
    )
    photoreceptor_us: float = key(
        number,
        'µs',
        'time constant of the photoreceptor at brightness 1; inversely proportional to the light',
        67.3,
        low=0,
        high=1e5,
        source='Lichtsteiner et al. 2008; Hu et al. 2021',
    )
    follower_us: float = key(
        number,
        'µs',
        'time constant of the stage behind it, whatever the light',
        30.2,
        low=1,
        high=1e4,
        source='Hu et al. 2021; Graça and Delbruck 2025',
    )
    refractory_us: float = key(
        number,
        'µs',
        'how long a pixel is held in reset after an event',
        17.9,
        low=0,
        high=1e5,
        source='Lichtsteiner et al. 2008',
    )
    refractory_mismatch: float = key(
        number, '', 'standard deviation of that from pixel to pixel, as a share', 0.03, low=0, high=0.5, source='Hu et al. 2021'
    )
    leak_hz: float = key(
        number,
        '1/s',
        'ON events a pixel gives by leakage at its reset switch',
        0.1,
        low=0,
        high=1000,
        source='Nozaki and Delbruck 2017',
    )
    photon_noise: float = key(
        number,
        'ln',
        'rms noise of log intensity at brightness 1; falls with the root of the light',
        0.0157,
        low=0,
        high=0.5,
        source='Graça and Delbruck 2021; Hu et al. 2021',
    )
    noise_hz: float = key(
        number,
        '1/s',
        'background events a pixel gives by noise, half of them ON',
        0.5,
        low=0,
        high=1000,
        source='Hu et al. 2021',
    )
    hot_share: float = key(number, '', 'share of hot pixels', 1e-4, low=0, high=0.1, source='Hu et al. 2021')
    hot_hz: float = key(number, '1/s', 'events of a hot pixel', 200.0, low=0, high=1e5, source='Hu et al. 2021')
    psf_px: float = key(
        number, 'px', 'standard deviation of the lens and sensor point spread', 1.86, low=0.2, high=20, source='Smith 2000'
    )
    scan_us: float = key(
        number,
        'µs',
        'how long the arbiter takes to come by all rows, at its own pace; 0: it is there at once',
        98.0,
        low=0,
        high=1e5,
        source='measured',
    )
    scan_jitter: float = key(number, '', 'standard deviation of that, as a share', 0.13, low=0, high=1, source='measured')
    scan_row_us: float = key(number, 'µs', 'from a row to the next', 1.4, low=0, high=1e4, source='measured')
    row_us: float = key(
        number,
        'µs',
        'time the bus needs for a row; its pending pixels share one time stamp',
        0.1,
        low=0,
        high=100,
        source='Boahen 2000; Finateu et al. 2020',
    )
    pixel_us: float = key(
        number, 'µs', 'time each pixel of a row adds to it', 0.015, low=0, high=10, source='Boahen 2000; Finateu et al. 2020'
    )
    longest_wait_us: float = key(
        number,
        'µs',
        'an event that would wait longer for the bus is lost',
        2000.0,
        low=1,
        high=1e6,
        source='Boahen 2000; Finateu et al. 2020',
    )


@dataclass(frozen=True, slots=True)
class CameraKeys:
    """The camera's geometry, for bearings; without it there are pixels only."""

    focal_px: tuple[float, ...] = key(number_or_list(2), 'px', 'focal length; or two: fx, fy', low=1, high=1e6)
    centre_px: tuple[float, ...] | None = key(
        numbers(2), 'px', 'principal point; default: the middle', None, low=-1e5, high=1e5
    )
    distortion: tuple[float, ...] = key(
        numbers(None, 0), '', 'plumb_bob coefficients k1, k2, p1, p2[, k3]', (), low=-10, high=10
    )


@dataclass(frozen=True, slots=True)
class Texture:
    """A random texture that covers the sensor and moves with the camera (``shake``)."""

    contrast: float = key(number, 'ln', 'rms of its log intensity', 0.4, low=0, high=3)
    grain_px: float = key(
        number, 'px', 'size of its patches: standard deviation of the blur whose sign they are', 12.0, low=0.5, high=500
    )
    events_per_s: float | None = key(
        number,
        '1/s',
        'choose the size so that about so many events come in the mean; default: as grain_px says',
        None,
        low=1,
        high=1e9,
    )


@dataclass(frozen=True, slots=True)
class BackgroundKeys:
    """What is behind the beacons."""

    brightness: float = key(number, '', 'its irradiance; 1: outdoors in full sun, about 0.02: indoors', 1.0, low=1e-6, high=1e3)
    texture: Texture | None = key(part(Texture), '', 'a texture; default: an even background', None)
    bag: str | None = key(words, '', 'a recorded bag, whose events are mixed in, looped; a path from the scene file', None)
    bag_topic: str | None = key(words, '', 'its event topic; default: the only one', None)


@dataclass(frozen=True, slots=True)
class Led:
    """The LED and its driver; the defaults are those of the outdoor recordings (docs/simulator.md)."""

    contrast: float = key(
        number, '', 'irradiance in the middle of its spot at 30 m, over the background of brightness 1', 7.527, low=0, high=1e6
    )
    size_mm: float = key(number, 'mm', 'its diameter: matters where it is wider than the point spread', 5.0, low=0, high=1e4)
    delay_us: float = key(number, 'µs', 'from a transition of the line to the driver', 0.0, low=0, high=1e5)
    rise_us: float = key(number, 'µs', 'time constant of its rise', 20.79, low=0.1, high=1e6, source=PAPER_SLEW)
    fall_us: float = key(number, 'µs', 'time constant of its fall', 17.92, low=0.1, high=1e6, source=PAPER_SLEW)
    rise_slew_us: float = key(
        number, 'µs', 'before that, the driver rises steadily: its full swing', 1058.0, low=0.1, high=1e6, source=PAPER_SLEW
    )
    fall_slew_us: float = key(number, 'µs', 'and falls steadily: its full swing', 278.6, low=0.1, high=1e6, source=PAPER_SLEW)


@dataclass(frozen=True, slots=True)
class BeaconKeys:
    """One beacon, or ``count`` alike on a grid."""

    path: PathKind | None = key(part_of_kind(PATHS), '', 'where it moves; default: still, in the middle or on the grid', None)
    text: str = key(words, '', 'what it sends, over and over: sonnet18, a .txt file or the text itself', DEFAULT_TEXT)
    name: str = key(words, '', 'what the truth calls it; default: beacon 1, beacon 2, …', '')
    bit_rate_bps: tuple[float, ...] = key(
        number_or_list(None), 'bit/s', 'its bit rate; a list: for beacons on a grid in turn', (1000.0,), low=1, high=20_000
    )
    clock_ppm: float = key(number, 'ppm', 'by how much its clock is fast', 0.0, low=-50_000, high=50_000)
    start_s: float = key(number, 's', 'when its first sending begins; idle (on) before', 0.05, low=0, high=_DAY_S)
    gap_bits: float = key(number, 'bits', 'idle line between two sendings', 16.0, low=0, high=1e6)
    idle_s: tuple[tuple[float, float], ...] = key(
        _SPANS, 's', 'when it does not send but idles (on); a sending begins anew afterwards', (), low=0, high=_DAY_S
    )
    shown_s: tuple[float, float] | None = key(
        numbers(2), 's', 'when it is there at all: it comes and goes; default: always', None, low=0, high=_DAY_S
    )
    occluded_s: tuple[tuple[float, float], ...] = key(
        _SPANS, 's', 'when something passes before it and hides it', (), low=0, high=_DAY_S
    )
    occlusion_edge_s: float = key(number, 's', 'how long what hides it takes to cover its spot', 0.002, low=1e-5, high=10)
    distance_m: tuple[float, ...] = key(
        number_or_list(2),
        'm',
        'how far it is; or two: at the beginning and at the end, evenly',
        (REFERENCE_M,),
        low=0.05,
        high=1e4,
    )
    led: Led = key(part(Led), '', 'its LED', Led())
    count: int = key(whole, '', 'so many of them, on a grid over the sensor', 1, low=1, high=1000)

    def __post_init__(self) -> None:
        if self.count > 1 and self.path is not None:
            raise ParameterError('path: several beacons (count) have their places on a grid')
        if len(self.bit_rate_bps) > self.count:
            raise ParameterError(f'bit_rate_bps = {list(self.bit_rate_bps)}: more rates than beacons (count: {self.count})')
        if self.shown_s is not None and self.shown_s[1] <= self.shown_s[0]:
            raise ParameterError(f'shown_s = {list(self.shown_s)}: must be a begin and a later end')
        try:
            CharacterFrame().encode_bits(self.text)
        except ParameterError:
            raise
        except ValueError as error:
            raise ParameterError(f'text: {error}') from error


@dataclass(frozen=True, slots=True)
class Lamp:
    """A lamp on the mains: its light swings at twice the mains frequency."""

    path: PathKind = key(part_of_kind(PATHS), '', 'where it is')
    name: str = key(words, '', 'what the truth calls it', '')
    frequency_hz: float = key(number, 'Hz', 'of the swing: 100 or 120', 100.0, low=1, high=1e5)
    depth: float = key(number, '', 'share of the light that swings', 0.6, low=0, high=1)
    contrast: float = key(number, '', 'mean irradiance over the background of brightness 1', 10.0, low=0, high=1e6)
    radius_px: float = key(number, 'px', 'radius of its image', 6.0, low=0, high=500)


@dataclass(frozen=True, slots=True)
class Pwm:
    """An LED dimmed by pulse width: a tail lamp, a display, a bulb."""

    path: PathKind = key(part_of_kind(PATHS), '', 'where it is')
    name: str = key(words, '', 'what the truth calls it', '')
    frequency_hz: float = key(number, 'Hz', 'of the pulses', 240.0, low=1, high=1e5)
    duty: float = key(number, '', 'share of the period it is on', 0.5, low=0.001, high=0.999)
    contrast: float = key(number, '', 'irradiance while on, over the background of brightness 1', 10.0, low=0, high=1e6)
    radius_px: float = key(number, 'px', 'radius of its image', 3.0, low=0, high=500)
    edge_us: float = key(number, 'µs', 'time constant of its rise and fall', 20.0, low=0.1, high=1e6)


@dataclass(frozen=True, slots=True)
class Screen:
    """A screen that is refreshed line by line; each line flashes and fades."""

    path: PathKind = key(part_of_kind(PATHS), '', 'where its middle is')
    name: str = key(words, '', 'what the truth calls it', '')
    refresh_hz: float = key(number, 'Hz', 'refresh rate', 60.0, low=1, high=1000)
    width_px: float = key(number, 'px', 'width of its image', 60.0, low=1, high=2000)
    height_px: float = key(number, 'px', 'height of its image', 40.0, low=1, high=2000)
    fade_us: float = key(number, 'µs', 'time constant with which a line fades', 4000.0, low=1, high=1e6)
    contrast: float = key(
        number, '', 'irradiance of a line at its brightest, over the background of brightness 1', 5.0, low=0, high=1e6
    )


@dataclass(frozen=True, slots=True)
class Reflection:
    """A weaker copy of a beacon elsewhere: in a window, on a wet floor."""

    of: str = key(words, '', 'the name of the beacon')
    share: float = key(number, '', 'share of its light', 0.1, low=0, high=1)
    shift_px: tuple[float, float] | None = key(numbers(2), 'px', 'where it is from the beacon: it moves with it', None)
    path: PathKind | None = key(part_of_kind(PATHS), '', 'or a path of its own', None)
    name: str = key(words, '', 'what the truth calls it', '')

    def __post_init__(self) -> None:
        if (self.shift_px is None) == (self.path is None):
            raise ParameterError('shift_px, path: one of them must be there')


Distractor = Lamp | Pwm | Screen | Reflection
DISTRACTORS: dict[str, type] = {'lamp': Lamp, 'pwm': Pwm, 'screen': Screen, 'reflection': Reflection}


@dataclass(frozen=True, slots=True)
class SceneDescription:
    """A whole scene."""

    duration_s: float = key(number, 's', 'how long it is', 5.0, low=0.001, high=_DAY_S)
    beacons: tuple[BeaconKeys, ...] = key(list_of(part(BeaconKeys)), '', 'the beacons', ())
    distractors: tuple[Distractor, ...] = key(list_of(part_of_kind(DISTRACTORS)), '', 'what blinks and is no beacon', ())
    background: BackgroundKeys = key(part(BackgroundKeys), '', 'what is behind them', BackgroundKeys())
    shake: Shake = key(part(Shake), '', "the camera's motion, shared by everything in the scene", Shake())
    camera: CameraKeys | None = key(part(CameraKeys), '', 'for bearings; default: none', None)
    sensor: Sensor = key(part(Sensor), '', 'the event camera', Sensor())

    def __post_init__(self) -> None:
        beacons = _expanded(self.beacons, self.sensor)
        names = [beacon.name for beacon in beacons]
        for name in names:
            if names.count(name) > 1:
                raise ParameterError(f'beacons: two are called {name!r}')
        for index, one in enumerate(self.distractors):
            if isinstance(one, Reflection) and one.of not in names:
                raise ParameterError(f'distractors[{index}].of = {one.of!r}: no such beacon; there are {", ".join(names)}')
        object.__setattr__(self, 'beacons', beacons)


def _expanded(beacons: tuple[BeaconKeys, ...], sensor: Sensor) -> tuple[BeaconKeys, ...]:
    """Return the beacons with those of a ``count`` put on their grid, and all of them named."""
    found: list[BeaconKeys] = []
    for beacon in beacons:
        places = _grid(beacon.count, sensor)
        for index, place in enumerate(places):
            name = beacon.name or f'beacon {len(found) + 1}'
            found.append(
                replace(
                    beacon,
                    name=f'{name} {index + 1}' if beacon.name and beacon.count > 1 else name,
                    path=beacon.path if beacon.path is not None else Still(place),
                    bit_rate_bps=(beacon.bit_rate_bps[index % len(beacon.bit_rate_bps)],),
                    count=1,
                )
            )
    return tuple(found)


def _grid(count: int, sensor: Sensor) -> list[tuple[float, float]]:
    columns = max(round((count * sensor.width / sensor.height) ** 0.5), 1)
    lines = -(-count // columns)
    places = [
        ((column + 0.5) * sensor.width / columns - 0.5, (line + 0.5) * sensor.height / lines - 0.5)
        for line, column in itertools.product(range(lines), range(columns))
    ]
    return places[:count]


def make_description(content: Mapping[str, Any], load_text: Callable[[str], str] | None = None) -> SceneDescription:
    """Return the description that a file's content holds.

    Args:
        content: the mapping of the file's keys.
        load_text: turns a beacon's ``text`` into what is sent, as ``evaluation.truth.load_truth``; None: it is the text.

    Raises:
        ParameterError: naming the key by its path.
        RecordingError: a text file that cannot be read.
    """
    if load_text is not None and isinstance(content, Mapping) and isinstance(content.get('beacons'), list):
        content = {**content, 'beacons': [_with_text(one, load_text) for one in content['beacons']]}
    return read_part(SceneDescription, content)


def _with_text(beacon: Any, load_text: Callable[[str], str]) -> Any:
    name = beacon.get('text') if isinstance(beacon, Mapping) else None
    return {**beacon, 'text': load_text(name)} if isinstance(name, str) and name else beacon


def read_description(
    path: str | Path, load_text: Callable[[str], str] | None = None
) -> tuple[SceneDescription, dict[str, Any]]:
    """Read a scene file; return the description, and the file's content as it is.

    Raises:
        RecordingError: the file cannot be read.
        ParameterError: no YAML, or a wrong key or value; the text names file and key.
    """
    try:
        content = load_yaml(Path(path).read_text(encoding='utf-8'))
    except (OSError, UnicodeDecodeError) as error:
        raise RecordingError(f'{path}: cannot be read ({getattr(error, "strerror", None) or error})') from error
    except ValueError as error:
        raise ParameterError(f'{path}: no YAML ({error})') from error
    try:
        return make_description(content, load_text), content
    except ParameterError as error:
        raise ParameterError(f'{path}: {error}') from error
    except RecordingError as error:
        raise RecordingError(f'{path}: beacons: text: {error}') from error


_TITLES = {
    SceneDescription: 'A scene file',
    BeaconKeys: '`beacons[]`',
    Led: '`beacons[].led`',
    BackgroundKeys: '`background`',
    Texture: '`background.texture`',
    Shake: '`shake`',
    CameraKeys: '`camera`',
    Sensor: '`sensor`',
}


def tables() -> str:
    """Return Markdown tables of every key, its unit, default, range and meaning."""
    titles: dict[type, str] = dict(_TITLES)
    titles |= {kind: f'`path` of kind `{name}`' for name, kind in PATHS.items()}
    titles |= {kind: f'`distractors[]` of kind `{name}`' for name, kind in DISTRACTORS.items()}
    return '\n'.join(_table(kind, title) for kind, title in titles.items())


def _table(kind: type, title: str) -> str:
    lines = [f'## {title}', '', (kind.__doc__ or '').split('\n')[0], '']
    lines += ['| Key | Unit | Default | Range | Meaning |', '|---|---|---|---|---|']
    for one in fields(kind):
        data = one.metadata
        default = '**needed**' if one.default.__class__.__name__ == '_MISSING_TYPE' else _shown(one.default)
        bounds = '' if data['low'] == -float('inf') else f'{data["low"]:g} … {data["high"]:g}'
        source = f' [{data["source"]}]' if data['source'] else ''
        lines.append(f'| `{one.name}` | {data["unit"]} | {default} | {bounds} | {data["meaning"]}{source} |')
    return '\n'.join([*lines, ''])


def _shown(value: Any) -> str:
    if value is None or value == () or value == '':
        return ''
    if isinstance(value, tuple):
        return ', '.join(_shown(one) for one in value)
    if isinstance(value, (int, float)):
        return f'{value:g}'
    return value if isinstance(value, str) else 'its keys’ defaults'


def page() -> str:
    """Return ``docs/scenes_format.md``."""
    kinds = ', '.join(PATHS)
    return f"""# The keys of a scene file

Written by `python -P -m beacon_comm.simulation.description`; how to write a scene: [simulator.md](simulator.md).
A key without a default is needed; all others may be left out.
Paths are of kind {kinds}: `path: {{kind: still, at_px: [320, 240]}}`.
The names in brackets are the literature of a model, listed in [simulator.md](simulator.md#sources).

{tables()}"""


if __name__ == '__main__':
    print(page(), end='')
