"""The core's parameters: checked at construction, refused by name."""

import dataclasses

import pytest

from beacon_comm.core.errors import ParameterError
from beacon_comm.core.parameters import Parameters, declarations, from_mapping


def test_defaults_pass_their_own_checks() -> None:
    assert Parameters() == Parameters(**{d.name: d.default for d in declarations(Parameters)})


def test_every_parameter_has_a_meaning_and_every_number_a_bound() -> None:
    for declaration in declarations(Parameters):
        assert declaration.meaning, declaration.name
        if isinstance(declaration.default, str):
            assert declaration.choices, declaration.name
        elif not isinstance(declaration.default, bool):
            assert declaration.low is not None or declaration.high is not None, declaration.name


@pytest.mark.parametrize(
    ('name', 'value', 'text'),
    [
        ('hop_s', 0.0, r'hop_s = 0\.0: must lie in \[0\.001, 1\] s'),
        ('hop_s', 'fast', r"hop_s = 'fast': must be a number"),
        ('hop_s', float('nan'), r'hop_s = nan: must be a number'),
        ('candidate_slots', 2.5, r'candidate_slots = 2\.5: must be a whole number'),
        ('candidate_slots', True, r'candidate_slots = True: must be a number'),
        ('receiver', 'magic', r"receiver = 'magic': must be one of sequence, threshold"),
        ('bit_rates', (), r'bit_rates = \(\): must be a list'),
        ('bit_rates', (504, 5), r'bit_rates = 5: must lie in \[20, 10000\] bps'),
        ('idle_start', 1, r'idle_start = 1: must be true or false'),
        ('reserved_candidate_slots', 17, r'reserved_candidate_slots = 17: more than candidate_slots = 16'),
    ],
)
def test_a_wrong_value_is_refused_by_name(name: str, value: object, text: str) -> None:
    with pytest.raises(ParameterError, match=text):
        Parameters(**{name: value})  # type: ignore[arg-type]


def test_whole_numbers_are_taken_for_floats_and_lists() -> None:
    parameters = Parameters(hop_s=1, bit_rates=[504, 3125])  # type: ignore[arg-type]
    assert parameters.hop_s == 1.0 and isinstance(parameters.hop_s, float)
    assert parameters.bit_rates == (504.0, 3125.0)


def test_an_unknown_name_is_refused() -> None:
    with pytest.raises(ParameterError, match='hopp_s: no such parameter'):
        from_mapping(Parameters, {'hopp_s': 0.01})


def test_parameters_cannot_be_changed_afterwards() -> None:
    with pytest.raises(dataclasses.FrozenInstanceError):
        Parameters().hop_s = 0.5  # type: ignore[misc]
