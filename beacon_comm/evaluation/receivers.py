"""The receivers that are declared, each with the parameters to measure it with, for tables that hold all of them."""

from __future__ import annotations

from typing import Any

from beacon_comm.core.parameters import Parameters, declarations


def declared_receivers(**parameters: Any) -> dict[str, Parameters]:
    """Return every declared receiver by a name for tables; one that can work blind comes a second time, blind.

    Args:
        parameters: other parameters, for all of them alike.

    Raises:
        ParameterError: a refused value.
    """
    found: dict[str, Parameters] = {}
    for receiver in next(d for d in declarations(Parameters) if d.name == 'receiver').choices:
        found[receiver] = Parameters(**{'receiver': receiver, 'rate_search': 'listed', **parameters})
        if receiver != 'threshold':  # the paper's receiver has to be told the rate
            found[f'{receiver}, blind'] = Parameters(**{'receiver': receiver, **parameters, 'rate_search': 'blind'})
    return found
