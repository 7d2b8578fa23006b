"""The minimum between values at equal steps."""


def parabola_minimum(before: float, here: float, after: float) -> float:
    """Where a parabola through three values, one step apart, has its minimum, in steps from the middle one.

    nan if it has none.
    """
    curvature = before - 2 * here + after
    return (before - after) / (2 * curvature) if curvature > 0 else float("nan")
