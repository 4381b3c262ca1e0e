"""What the command lines share: a parser whose errors are one line, their exit codes, and the longest time they take."""

from __future__ import annotations

import argparse
from typing import NoReturn

EXIT_OK = 0
EXIT_ERROR = 2
LONGEST_S = 1e9
"""No part of a recording begins later or is longer: in int64 nanoseconds, twice that and the sensor's time have room."""


class OneLineParser(argparse.ArgumentParser):
    """Parser whose errors are one line."""

    def error(self, message: str) -> NoReturn:
        """Print the error without the usage, and exit with 2."""
        self.exit(EXIT_ERROR, f'{self.prog}: {message}\n')
