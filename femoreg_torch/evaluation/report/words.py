"""Numbers and notes as a report tells them."""

import math


def number(value: float, digits: int) -> str:
    """A number with so many decimals, or that it is unknown."""
    return f"{value:.{digits}f}" if math.isfinite(value) else "unknown"


def sentence(words: str) -> str:
    """Words with a capital letter and a full stop."""
    return words[:1].upper() + words[1:] + ("" if words.endswith(".") else ".")
