"""The package's one family of errors: everything raised on purpose derives from BeaconCommError; and how they quote."""


MOST_QUOTED = 40


def quoted(value: object) -> str:
    """Return a value as an error shows it: in quotes if it is text, cut off where it is long."""
    text = repr(value)
    return text if len(text) <= MOST_QUOTED else text[: MOST_QUOTED - 1] + '…'


class BeaconCommError(Exception):
    """Base of all errors this package raises on purpose."""


class ParameterError(BeaconCommError, ValueError):
    """A parameter has a wrong type or lies outside its range; the text names it, its value and its range."""


class FramingError(BeaconCommError, ValueError):
    """A text cannot be framed: a character does not fit into the data bits."""


class RecordingError(BeaconCommError, OSError):
    """A recording cannot be read or written; the text names the file and the reason."""


class CalibrationError(BeaconCommError, ValueError):
    """A camera calibration is incomplete, contradictory or of an unknown distortion model."""
