"""The one exception that means: the input is wrong, and here is how to mend it; and a defect told in one line."""

import traceback
from pathlib import Path


class InputError(ValueError):
    """Bad input from a user: a file, a setting or an image.

    The message is one line that says where, what was found, what was expected and what to do. The command line prints
    it without a traceback and ends with exit status 2.
    """


def defect_in_one_line(error: Exception) -> str:
    """An exception that nobody expected, with the place in the code that raised it, for a table of many runs."""
    place = traceback.extract_tb(error.__traceback__)[-1]
    told = f"{type(error).__name__}: {error} ({Path(place.filename).name}, line {place.lineno})"
    return " ".join(told.split())
