"""What the command lines share: a parser whose errors are one line, and their exit codes."""

from __future__ import annotations

import argparse
from typing import NoReturn

EXIT_OK = 0
EXIT_ERROR = 2


class OneLineParser(argparse.ArgumentParser):
    """Parser whose errors are one line."""

    def error(self, message: str) -> NoReturn:
        """Print the error without the usage, and exit with 2."""
        self.exit(EXIT_ERROR, f'{self.prog}: {message}\n')
