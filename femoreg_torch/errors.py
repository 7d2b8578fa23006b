"""The one exception that means: the input is wrong, and here is how to mend it; and a defect told in one line."""

import traceback
from pathlib import Path
from typing import Any

_FEW = 4


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


def shortened(value: Any, most: int = 60) -> str:
    """What was found, in at most so many characters, for a message: text in quotes, the beginning of what is long.

    A mapping, or a list of more than a few plain values, is told by its kind and size alone: one of aliases may be
    endless when it is written out.
    """
    if isinstance(value, list | tuple) and len(value) <= _FEW and not any(isinstance(v, dict | list) for v in value):
        value = f"[{', '.join(shortened(v, most // _FEW) for v in value)}]"
        return value if len(value) <= most else f"{value[: most - 1]}…"
    if isinstance(value, dict | list | tuple | set):
        return f"a {type(value).__name__} of {len(value)}"
    if isinstance(value, str):
        value = value[: 4 * most]
        text = repr(value)
    else:
        text = " ".join(str(value).split())
    return text if len(text) <= most else text[: most - 1] + "…"


def in_mm(length: float) -> str:
    """A length for a message, in figures as people write them: `0.12 mm`, `60000 mm`."""
    return f"{length:.0f} mm" if 100 <= length < 1e7 else f"{length:.3g} mm"
