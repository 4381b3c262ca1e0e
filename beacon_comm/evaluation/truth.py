"""Truth: the text that a recorded beacon sent, as the evaluator knows it.

:data:`SONNET18` is William Shakespeare's Sonnet 18 ("Shall I compare thee to a summer's day?") in the spelling that
the paper's beacon sent: modernised, with "owest" and "growest" written out, "wander'st", "dimm'd" and "untrimm'd"
elided, no comma in "this and this", straight apostrophes, no indent, no title.  Its 14 lines are joined by a line
feed and none follows the last: 618 characters.  The published outdoor recordings are the source: every character of
it was checked against their events.
"""

from __future__ import annotations

import os
from pathlib import Path

from beacon_comm.core.errors import RecordingError

SONNET18 = '\n'.join(
    (
        "Shall I compare thee to a summer's day?",
        'Thou art more lovely and more temperate:',
        'Rough winds do shake the darling buds of May,',
        "And summer's lease hath all too short a date:",
        'Sometime too hot the eye of heaven shines,',
        "And often is his gold complexion dimm'd;",
        'And every fair from fair sometime declines,',
        "By chance or nature's changing course untrimm'd;",
        'But thy eternal summer shall not fade',
        'Nor lose possession of that fair thou owest;',
        "Nor shall Death brag thou wander'st in his shade,",
        'When in eternal lines to time thou growest:',
        'So long as men can breathe or eyes can see,',
        'So long lives this and this gives life to thee.',
    )
)

BUILT_IN = {'sonnet18': SONNET18}

# Longer arguments, or such with a line feed, are meant as text and never tried as a path.
LONGEST_PATH = 1000


def _may_be_path(argument: str) -> bool:
    return len(argument) <= LONGEST_PATH and '\n' not in argument and '\0' not in argument


def load_truth(argument: str) -> str:
    """Return the text that ``argument`` stands for.

    Args:
        argument: the name of a built-in text (``sonnet18``), else the path of a text file if there is one (every
            byte of it is truth, a line feed at its end too), else the text itself.  One that looks like a path
            (ends in .txt, or has a slash and no white space) must be a file's.

    Returns:
        The text, one character for each that was sent; never empty.

    Raises:
        RecordingError: nothing in it, the file cannot be read or is not text, or what looks like a file's path is none.
    """
    if argument in BUILT_IN:
        return BUILT_IN[argument]
    path = Path(argument)
    if _may_be_path(argument) and os.path.isfile(path):  # unlike Path.is_file, it knows no error
        try:
            text = path.read_bytes().decode('utf-8')
        except (OSError, UnicodeDecodeError) as error:
            raise RecordingError(f'{path}: not a readable text file ({error})') from error
    elif path.suffix.lower() == '.txt' and '\n' not in argument:
        raise RecordingError(f'{path}: no such file')
    elif _may_be_path(argument) and '/' in argument and not any(symbol.isspace() for symbol in argument):
        raise RecordingError(f'{argument}: no such file (a text with a slash and no space must come in a file)')
    else:
        text = argument
    if not text:
        raise RecordingError(f'truth {argument!r}: no text')
    return text
