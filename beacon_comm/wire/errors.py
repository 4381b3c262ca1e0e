"""The one error of this room."""

from __future__ import annotations

from beacon_comm.core.errors import BeaconCommError


class WireError(BeaconCommError, ValueError):
    """Bytes that are not the message they should be, or events that a format cannot hold.

    Attributes:
        kind: short name of what is wrong, fit for a counter: 'truncated', 'encapsulation', 'time_base', …
    """

    def __init__(self, kind: str, text: str) -> None:
        super().__init__(text)
        self.kind = kind
