"""The package's one family of errors: everything raised on purpose derives from BeaconCommError."""


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
