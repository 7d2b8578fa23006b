"""Statistics of a group of runs: errors, success, trust, and whether stated deviations hold."""

from dataclasses import dataclass

import numpy as np
import pandas as pd

from femoreg_torch.statistics.intervals import UNKNOWN, Interval, mean_interval, rate_interval
from femoreg_torch.statistics.outcome import asked, everything, is_flagged, object_is_wrong, run_is_wrong, told
from femoreg_torch.statistics.quantities import AXES, OBJECTS
from femoreg_torch.statistics.rows import procedures


@dataclass(frozen=True)
class Statistics:
    """Of one absolute error. Median, percentile and maximum are over all `asked` runs, failures as infinitely large.

    No finite mean can hold those, so mean and deviation are of the `count` runs that gave an error. nan: not known.
    """

    asked: int
    count: int
    mean: float
    deviation: float
    median: float
    percentile_95: float
    maximum: float


def statistics(rows: pd.DataFrame, column: str) -> Statistics:
    """Of one error over all runs of a group."""
    values = everything(rows, column)
    if len(values) == 0:
        return Statistics(0, 0, *[float("nan")] * 5)
    given = values[np.isfinite(values)]
    mean = float(given.mean()) if len(given) else float("nan")
    deviation = float(given.std(ddof=1)) if len(given) > 1 else float("nan")
    return Statistics(
        len(values), len(given), mean, deviation, _quantile(values, 0.5), _quantile(values, 0.95), float(values.max())
    )


def _quantile(values: np.ndarray, share: float) -> float:
    """With values that may be infinite: interpolating linearly, anything beside an infinite value is infinite."""
    place = share * (len(values) - 1)
    low, high = np.sort(values)[[int(np.floor(place)), int(np.ceil(place))]]
    return float(high if np.isinf(high) or low == high else low + (place % 1) * (high - low))


def interval_of_mean(rows: pd.DataFrame, column: str, seed: int) -> Interval:
    """95 % interval of the mean of the runs that gave an error; runs of one procedure are drawn together."""
    values = told(rows, column)[asked(rows, column)].dropna()
    return mean_interval(values, seed, procedures(rows)[values.index])


@dataclass(frozen=True)
class Rate:
    """How many of how many, and the 95 % interval of their share."""

    met: int
    of: int
    independent: bool = True  # False where several runs are of one procedure

    @property
    def share(self) -> float:
        """nan of none."""
        return self.met / self.of if self.of else float("nan")

    @property
    def interval(self) -> Interval:
        """Wilson's; unknown for runs that are not independent."""
        return rate_interval(self.met, self.of) if self.independent else UNKNOWN


def independent(rows: pd.DataFrame) -> bool:
    """Whether no two runs are of one procedure."""
    return not procedures(rows).duplicated().any()


def within(rows: pd.DataFrame, column: str, limit: float) -> Rate:
    """Of the runs that should have an error: those that have one of at most `limit`."""
    values = everything(rows, column)
    return Rate(int((values <= limit).sum()), len(values), independent(rows))


def right_runs(rows: pd.DataFrame) -> Rate:
    """Runs that place every object, and entry point to tip, within the limits of `outcome`."""
    return Rate(int((~run_is_wrong(rows)).sum()), len(rows), independent(rows))


def trusted_runs(rows: pd.DataFrame) -> Rate:
    """Runs that say that they can be trusted."""
    return Rate(int((~is_flagged(rows)).sum()), len(rows), independent(rows))


@dataclass(frozen=True)
class Confusion:
    """Right and wrong results against whether they said that they can be trusted."""

    right_trusted: int
    right_flagged: int
    wrong_trusted: int
    wrong_flagged: int
    independent: bool

    @property
    def harm(self) -> Rate:
        """Wrong ones among the trusted."""
        return Rate(self.wrong_trusted, self.wrong_trusted + self.right_trusted, self.independent)


def confusion(rows: pd.DataFrame, name: str | None = None) -> Confusion | None:
    """Of whole runs, or of one object; None where the runs do not say whether the object can be trusted."""
    if name is not None and f"{name}_trusted" not in rows:
        return None
    if name is None:
        counted, wrong = pd.Series(True, rows.index), run_is_wrong(rows)
    else:
        counted, wrong = asked(rows, f"{name}_mm"), object_is_wrong(rows, name)
    flagged = is_flagged(rows, name)
    return Confusion(
        int((counted & ~wrong & ~flagged).sum()),
        int((counted & ~wrong & flagged).sum()),
        int((counted & wrong & ~flagged).sum()),
        int((counted & wrong & flagged).sum()),
        independent(rows),
    )


@dataclass(frozen=True)
class Coverage:
    """Errors of one object, in mm or degrees, within one and two stated deviations, along or about each axis."""

    object: str
    unit: str  # mm or deg
    within_1: tuple[Rate, ...]
    within_2: tuple[Rate, ...]


def coverage(rows: pd.DataFrame) -> list[Coverage]:
    """Of every object whose deviation the runs state, over the runs that give both error and deviation."""
    found, apart = [], independent(rows)
    for name in OBJECTS:
        for unit in ("mm", "deg"):
            ratios = [deviations_off(rows, name, unit, axis) for axis in AXES]
            if any(len(ratio) for ratio in ratios):
                one, two = (
                    tuple(Rate(int((ratio <= times).sum()), len(ratio), apart) for ratio in ratios) for times in (1, 2)
                )
                found.append(Coverage(name, unit, one, two))
    return found


def deviations_off(rows: pd.DataFrame, name: str, unit: str, axis: str) -> np.ndarray:
    """Absolute errors divided by the deviations that the runs state (N,), of the runs that give both."""
    error, sigma = told(rows, f"{name}_{unit}_{axis}"), told(rows, f"{name}_sigma_{unit}_{axis}")
    both = error.notna() & sigma.gt(0)
    return (error[both] / sigma[both]).to_numpy(float)
