"""Every parameter of the core, written once: name, default, unit, range, meaning.

The ROS node, ``config/beacon.yaml``, the command lines and the README's table derive from the declarations in this
file (the node's own are declared the same way in :mod:`beacon_comm.ros.parameters`).  A wrong value is refused at
construction with its name, value and range; nothing is repaired silently.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, fields
from typing import Any, TypeVar

from beacon_comm.core.errors import ParameterError

Value = bool | int | float | str | tuple[float, ...]
T = TypeVar('T')


@dataclass(frozen=True, slots=True)
class Declaration:
    """One declared parameter.

    Attributes:
        name: its name on the node, in the YAML file and (with dashes) on the command line.
        default: its default; its type is the parameter's type.
        unit: physical unit, '' for pure numbers.
        low, high: inclusive range of numbers (of each entry of a list), None where not bounded.
        choices: allowed strings, empty for other types.
        meaning: one line.
    """

    name: str
    default: Value
    unit: str
    low: float | None
    high: float | None
    choices: tuple[str, ...]
    meaning: str

    def check(self, value: object) -> Value:
        """Return ``value`` in the parameter's type.

        Raises:
            ParameterError: wrong type, outside the range, or not one of the choices.
        """
        if isinstance(self.default, bool):
            if not isinstance(value, bool):
                raise ParameterError(f'{self.name} = {value!r}: must be true or false')
            return value
        if isinstance(self.default, str):
            if not isinstance(value, str) or (self.choices and value not in self.choices):
                allowed = ', '.join(self.choices) or 'a string'
                raise ParameterError(f'{self.name} = {value!r}: must be one of {allowed}')
            return value
        if isinstance(self.default, tuple):
            if not isinstance(value, (list, tuple)) or not value:
                raise ParameterError(f'{self.name} = {value!r}: must be a list of at least one number')
            return tuple(float(self._number(entry)) for entry in value)
        number = self._number(value)
        if isinstance(self.default, int):
            if number != int(number):
                raise ParameterError(f'{self.name} = {value!r}: must be a whole number')
            return int(number)
        return float(number)

    def _number(self, value: object) -> float:
        if isinstance(value, bool) or not isinstance(value, (int, float)) or not math.isfinite(value):
            raise ParameterError(f'{self.name} = {value!r}: must be a number')
        if (self.low is not None and value < self.low) or (self.high is not None and value > self.high):
            raise ParameterError(f'{self.name} = {value!r}: must lie in {self.range_text()}')
        return value

    def range_text(self) -> str:
        """Return the range as text, for tables and errors."""
        if self.choices:
            return ', '.join(self.choices)
        if isinstance(self.default, bool):
            return 'true, false'
        if self.low is None and self.high is None:
            return ''
        low = '-∞' if self.low is None else f'{self.low:g}'
        high = '∞' if self.high is None else f'{self.high:g}'
        return f'[{low}, {high}]{" " + self.unit if self.unit else ""}'


def parameter(
    default: Any,
    meaning: str,
    unit: str = '',
    low: float | None = None,
    high: float | None = None,
    choices: tuple[str, ...] = (),
) -> Any:
    """Declare a parameter as a dataclass field."""
    return field(
        default=default, metadata={'unit': unit, 'low': low, 'high': high, 'choices': choices, 'meaning': meaning}
    )


def declarations(cls: type) -> tuple[Declaration, ...]:
    """Return the declarations of a parameter dataclass, in order."""
    return tuple(
        Declaration(
            f.name,
            f.default,  # type: ignore[arg-type]
            f.metadata['unit'],
            f.metadata['low'],
            f.metadata['high'],
            f.metadata['choices'],
            f.metadata['meaning'],
        )
        for f in fields(cls)
    )


class Declared:
    """Base of parameter dataclasses: checks every field against its declaration."""

    def __post_init__(self) -> None:
        for declaration in declarations(type(self)):
            object.__setattr__(self, declaration.name, declaration.check(getattr(self, declaration.name)))


def from_mapping(cls: type[T], values: dict[str, Any]) -> T:
    """Build parameters from a mapping such as a YAML file's.

    Raises:
        ParameterError: an unknown name, or a refused value.
    """
    known = {declaration.name for declaration in declarations(cls)}
    for name in values:
        if name not in known:
            raise ParameterError(f'{name}: no such parameter')
    return cls(**values)


@dataclass(frozen=True)
class Parameters(Declared):
    """Parameters of the receiver."""

    # Demodulation
    receiver: str = parameter(
        'sequence',
        "demodulator of the candidate slots: sequence detection, or threshold, the paper's",
        choices=('sequence', 'threshold'),
    )
    bit_rates: tuple[float, ...] = parameter(
        (504.0, 3125.0), 'bit rates to try; the one that explains most of the signal is kept', 'bps', 20.0, 10_000.0
    )
    rate_search: str = parameter(
        'both',
        'sequence: look for the listed bit rates, for any from 100 bps to 10 kbps (blind), or side by side for both',
        choices=('both', 'listed', 'blind'),
    )
    search_load: float = parameter(
        0.5, 'sequence: computing time that all candidates may spend on looking for their bit rates (1: a core)', '', 0.01
    )
    cutoff_per_bit: float = parameter(
        2.0 * math.pi / 3.0,
        "high-pass cut-off alpha over the bit rate (2π/3: the paper's released script; 1/3: the paper's text)",
        'rad/bit',
        0.01,
        20.0,
    )
    levels: str = parameter(
        'adaptive', "hysteresis levels: shares of the signal's own amplitude, or fixed", choices=('adaptive', 'fixed')
    )
    high_share: float = parameter(0.12, "adaptive high level over the signal's amplitude", '', 0.0, 1.0)
    low_share: float = parameter(0.1, "adaptive |low level| over the signal's amplitude", '', 0.0, 1.0)
    amplitude_memory_bits: float = parameter(100.0, 'time constant of the amplitude', 'bit', 1.0, 1e6)
    least_level: float = parameter(2.0, 'adaptive levels never come nearer to zero', 'events', 0.0)
    high_level: float = parameter(20.0, 'fixed high level of the filtered signal', 'events', 0.0)
    low_level: float = parameter(-15.0, 'fixed low level of the filtered signal', 'events', None, 0.0)
    idle_start: bool = parameter(
        True, 'the first fall after 10.5 or more high bits is a start bit (false: the paper to the letter)'
    )
    start_trials: bool = parameter(
        True, 'try every fall of the first character as its start bit (false: the first one, the paper to the letter)'
    )

    # Character frame
    data_bits: int = parameter(7, 'data bits of a character', 'bit', 5, 8)
    parity: str = parameter('even', 'parity bit', choices=('even', 'odd', 'none'))
    stop_bits: int = parameter(2, "stop bits (the paper's end bits)", 'bit', 1, 2)
    bit_order: str = parameter(
        'msb_first', 'order of the data bits on the line', choices=('msb_first', 'lsb_first')
    )

    # Detection
    hop_s: float = parameter(0.01, 'spacing of the detection grid, absolute in event time', 's', 0.001, 1.0)
    short_window_s: float = parameter(0.02, 'short detection window', 's', 0.001, 1.0)
    long_window_bits: float = parameter(22.0, 'long detection window, in bits of the slowest listed rate', 'bit', 1, 1000)
    index_offset: float = parameter(10.0, 'B of the index I = n / (B + |Σσ|)', 'events', 0.1, 1000.0)
    index_threshold: float = parameter(0.6, 'a blob has a pixel of at least this index …', '', 0.0)
    index_grow_share: float = parameter(
        0.5, '… and grows over neighbours above this share of it (1: one threshold, as the paper)', '', 0.1, 1.0
    )
    new_tracks_burst: int = parameter(
        64, 'so many tracks may begin at once; further ones are clutter and raise index_threshold …', '', 0, 1_000_000
    )
    new_tracks_per_s: float = parameter(2.0, '… for a while, so that in the long run no more than this begin', '1/s', 0.1)
    closing_px: int = parameter(3, 'side of the square of the morphological closing', 'px', 1, 31)
    min_area_px: int = parameter(3, 'smallest blob', 'px', 1)
    max_area_px: int = parameter(10_000, 'largest blob', 'px', 1)
    window_max_bytes: int = parameter(
        256_000_000, 'bound of the events kept for the windows, and of their counts; what is dropped is counted', 'byte', 1000
    )

    # Tracks
    tracker: str = parameter(
        'motion',
        "nearest: blobs' nearest neighbours at hops, the paper's; motion: tracks move on with their own events, filtered",
        choices=('nearest', 'motion'),
    )
    event_latency_s: float = parameter(
        130e-6, 'motion: events come so long after the light; a moving beacon is ahead of them', 's', 0.0, 0.01
    )
    min_fill: float = parameter(
        0.1, 'motion: what fills less of the disc with its spread is edges, no light (0: thin rings are lights, too)',
        '', 0.0, 1.0,
    )  # fmt: skip
    association_gate_px: float = parameter(12.0, 'largest distance of a blob from the predicted centre', 'px', 0.1)
    gate_growth_px_per_s: float = parameter(40.0, 'growth of the gate while a track is unseen', 'px/s', 0.0)
    max_gate_px: float = parameter(40.0, 'largest gate', 'px', 0.1)
    lost_after_s: float = parameter(2.0, 'a track unseen for this long is lost', 's', 0.01, 60.0)
    reacquire_s: float = parameter(
        10.0,
        'motion: what appears so soon where a track of known rate was lost takes its label, unless its rate is another',
        's',
        0.0,
        3600.0,
    )
    merge_after_s: float = parameter(
        0.5, 'a track inside the blob of an older one for this long is dropped', 's', 0.0
    )
    max_tracks: int = parameter(
        256, 'tracks kept at once; for further blobs quiet ones and those that had a turn in vain are given up', '', 1, 65_000
    )
    routing_extent_factor: float = parameter(1.5, "an event is a track's within its extent times this …", '', 0.1)
    routing_margin_px: float = parameter(2.0, '… plus this', 'px', 0.0)
    buffer_min_s: float = parameter(0.5, 'events kept for each track: the longer of this …', 's', 0.0)
    buffer_characters: int = parameter(30, '… and so many characters of the slowest listed rate', '', 1)
    buffer_max_bytes: int = parameter(16_000_000, 'bound of one buffer; overflow is counted', 'byte', 1000)

    # Candidate slots
    candidate_slots: int = parameter(16, 'demodulators at work at once', '', 1, 4096)
    reserved_candidate_slots: int = parameter(1, 'slots that confirmed beacons never take', '', 1, 4096)
    judged_characters: int = parameter(15, 'a candidate is judged after so many counted characters, and every so many', '', 1)
    judged_last: int = parameter(5, 'the judgement looks at so many last parities …', '', 1)
    judged_right: int = parameter(4, '… and demotes below so many right ones', '', 0)
    starved_after_s: float = parameter(
        2.0, 'a slot with too few characters to judge for this long, while there are events, is given up', 's', 0.01
    )
    starved_margin: float = parameter(
        1.5, '… but not before so many times the duration of judged_characters at the slowest listed rate', '', 1.0, 100.0
    )
    turn_characters: int = parameter(
        30, 'a candidate not confirmed by so many counted characters gives its slot to a waiting one', '', 1
    )
    confirm_window: int = parameter(15, 'a confirmation looks at so many last characters …', '', 1)
    confirm_ok: int = parameter(12, '… of which so many are ok …', '', 1)
    confirm_free_confidence: float = parameter(
        0.9, 'a repaired character whose bits say the same without the frame vouches, too, if it is so sure', '', 0.0, 1.0
    )
    confirm_distinct_codes: int = parameter(4, '… with so many distinct codes …', '', 1)
    confirm_period: int = parameter(3, '… that do not repeat with a period of so many characters or less', '', 0)
    confirm_repeats: float = parameter(
        0.5, '… (repeats: more than this share of the ok characters equals the one a period before)', '', 0.0, 1.0
    )
    confirm_regular: float = parameter(
        0.66, '… and of which no more than this share could be a lamp: falls at one constant spacing', '', 0.0, 1.0
    )
    confirm_confidence: float = parameter(
        0.2, '… and whose median confidence is at least this …', '', 0.0, 1.0
    )
    confirm_sharp: float = parameter(
        0.4, '… and at least this, or else …', '', 0.0, 1.0
    )
    confirm_comb: float = parameter(
        0.8, '… no more than this share could be a lamp with missed edges: falls on one comb', '', 0.0, 1.0
    )
    confirm_sure: float = parameter(
        0.6, '… between the two: two such windows without a common character are asked for below this …', '', 0.0, 1.0
    )
    confirm_edge_spread: float = parameter(
        0.06, '… and above this spread of the edges about the borders of the bits …', 'bit', 0.0, 1.0
    )
    confirm_edge_most: float = parameter(
        0.22, '… and nothing is confirmed above this one: edges that lie anywhere have 0.29', 'bit', 0.0, 1.0
    )
    confirm_equal: float = parameter(
        0.3, '… there moreover no more than this share of the pairs of ok codes so far may be equal …', '', 0.0, 1.0
    )
    confirm_equal_on_comb: float = parameter(
        0.2, '… nor more than this where the falls lie on a comb', '', 0.0, 1.0
    )
    allow_periodic: bool = parameter(False, 'confirm streams that repeat, fall regularly or on a comb, too')

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.reserved_candidate_slots > self.candidate_slots:
            raise ParameterError(
                f'reserved_candidate_slots = {self.reserved_candidate_slots}: more than candidate_slots'
                f' = {self.candidate_slots}'
            )
        if self.levels == 'fixed' and not self.high_level > -self.low_level:
            raise ParameterError(f'high_level = {self.high_level:g}: must be above |low_level| = {-self.low_level:g}')
        if self.levels == 'adaptive' and not self.high_share > self.low_share:
            raise ParameterError(f'high_share = {self.high_share:g}: must be above low_share = {self.low_share:g}')
        if self.min_area_px > self.max_area_px:
            raise ParameterError(f'min_area_px = {self.min_area_px}: above max_area_px = {self.max_area_px}')
        if self.judged_right > self.judged_last:
            raise ParameterError(f'judged_right = {self.judged_right}: above judged_last = {self.judged_last}')
        if self.judged_last > self.judged_characters:
            raise ParameterError(
                f'judged_last = {self.judged_last}: above judged_characters = {self.judged_characters}'
            )
        if self.confirm_ok > self.confirm_window:
            raise ParameterError(f'confirm_ok = {self.confirm_ok}: above confirm_window = {self.confirm_window}')

    @property
    def slowest_bit_s(self) -> float:
        """Bit period of the slowest listed rate (s)."""
        return 1.0 / min(self.bit_rates)
