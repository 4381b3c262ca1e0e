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
    declared = {declaration.name: declaration for declaration in declarations(Parameters)}
    found = {name: Parameters(**{'receiver': name, **parameters}) for name in declared['receiver'].choices}
    if 'blind' in declared:
        usual = {name: Parameters(**{'blind': False, 'receiver': name, **parameters}) for name in found}
        # The paper's receiver has to be told the rate.
        blind = {
            f'{name}, blind': Parameters(**{'receiver': name, **parameters, 'blind': True})
            for name in found
            if name != 'threshold'
        }
        return usual | blind
    return found
