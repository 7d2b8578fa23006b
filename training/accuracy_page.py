"""An accuracy as files: every figure with its interval as JSON, and a page to read."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path

from femoreg_torch.anatomy import HIP
from femoreg_torch.errors import InputError
from femoreg_torch.files import write_json, write_text
from femoreg_torch.fluoro import SOURCES
from training.accuracy import COARSE, FAIR, GROSS_MM, NEAR_MM, REGISTERED_DEG, Accuracy, Measure, figures, summarise
from training.calibration import RIGHT_MM, calibration_error, draw_reliability
from training.measure import Reading
from training.robustness import Outcomes

_SHARE, _MM = "share", "mm"
_ROWS = {  # figure → what it is called, and its unit
    "median_mm": ("landmark error, median", _MM),
    "mean_mm": ("landmark error, mean", _MM),
    "p90_mm": ("landmark error, 90th percentile", _MM),
    "gross": (f"found further than {GROSS_MM:g} mm off", _SHARE),
    "recall": ("recall: found of those in the image", _SHARE),
    "within_10mm": (f"found within {NEAR_MM:g} mm, of those in the image", _SHARE),
    "false_positives": ("false positives: found of those not in the image", _SHARE),
    **{f"dice_{bone}": (f"Dice, {bone.replace('_', ' ')}", "") for bone in HIP.bone_names},
    "dice_mean": (f"Dice, mean of {len(HIP.bones)}", ""),
    "pose_fair": ("pose within {:g}°, {:g} mm across, {:g} mm in depth".format(*FAIR), _SHARE),
    "pose_coarse": ("pose within {:g}°, {:g} mm, {:g} mm".format(*COARSE), _SHARE),
    "pose_refused": ("pose refused", _SHARE),
    "registered_1deg": (f"pelvis within {REGISTERED_DEG:g}° after single-view registration", _SHARE),
    "rotation_median_deg": ("rotation error, median", "°"),
}


def write_accuracy(out: Path, readings: Sequence[Reading], altered: Mapping[str, Outcomes]) -> str:
    """Write `accuracy.json`, `accuracy.md` and `reliability.png` into the folder `out`; returns the page.

    `altered` says what became of start poses in altered images; empty where that was not measured. Raises `InputError`
    where no image was read.
    """
    if not readings:
        raise InputError("there is no image in these files to measure anything on.")
    accuracy = summarise(readings)
    out.mkdir(parents=True, exist_ok=True)
    error = calibration_error(readings)
    outcomes = {name: asdict(counted) for name, counted in altered.items()}
    write_json(out / "accuracy.json", {**asdict(accuracy), "calibration_error": error, "altered": outcomes})
    draw_reliability(readings, out / "reliability.png")
    page = "\n".join([*_figures(accuracy), "", *_by_source(readings), *_calibration(error), *_altered(altered)]) + "\n"
    write_text(out / "accuracy.md", page)
    return page


def _figures(accuracy: Accuracy) -> list[str]:
    """All figures, with 95 % intervals where there are several patients, then the landmarks one by one."""
    several = accuracy.patients > 1
    of = f"{accuracy.patients} patients" if several else "one patient, which tells no intervals"
    told = "; brackets hold the 95 % interval by bootstrap over patients" if several else ""
    lines = [
        f"{accuracy.images} images of {of}. Errors are on the detector{told}.",
        "",
        "| | |",
        "| --- | --- |",
        *(f"| {name} | {_value(accuracy.measures[key], unit, several)} |" for key, (name, unit) in _ROWS.items()),
        "",
        "| landmark | mean, mm | median, mm | recall | in the image |",
        "| --- | --- | --- | --- | --- |",
    ]
    for name, one in accuracy.landmarks.items():
        found = [_number(one.mean_mm, 1), _number(one.median_mm, 1), _number(100 * one.recall, 0, " %")]
        lines.append(f"| {name} | {' | '.join(found)} | {one.in_image} |")
    return lines


def _by_source(readings: Sequence[Reading]) -> list[str]:
    """A line for each side of the patient that a source stood on; none where that was one and the same."""
    groups = {source: [one for one in readings if one.source == source] for source in SOURCES}
    groups = {source: group for source, group in groups.items() if group}
    if len(groups) < 2:
        return []
    lines = [
        "| source | images | error, median | recall | false positives | {} | refused |".format(_ROWS["pose_fair"][0]),
        "| --- | --- | --- | --- | --- | --- | --- |",
    ]
    for source, group in groups.items():
        values = figures(group)
        told = [_number(values["median_mm"], 1, " mm")]
        told += [
            _number(100 * values[key], 1, " %") for key in ("recall", "false_positives", "pose_fair", "pose_refused")
        ]
        lines.append(f"| {source} | {len(group)} | {' | '.join(told)} |")
    return [*lines, ""]


def _calibration(error: float) -> list[str]:
    return [
        "A confidence is the probability that the landmark is in the image and within "
        f"{RIGHT_MM:g} mm of where it was found. Stated and true share differ by {100 * error:.1f} % in the mean "
        "(reliability.png)."
    ]


def _altered(altered: Mapping[str, Outcomes]) -> list[str]:
    if not altered:
        return []
    good = "{:g}°, {:g} mm and {:g} mm".format(*COARSE)
    return [
        "",
        f"Start poses in altered images; a good one is within {good}, a silent failure is any other that is given.",
        "",
        "| images | good | refused | silent failure |",
        "| --- | --- | --- | --- |",
        *(f"| {name} | {one.good} | {one.refused} | {one.silent_failures} |" for name, one in altered.items()),
    ]


def _value(measure: Measure, unit: str, several: bool) -> str:
    if unit == _SHARE:
        scale, digits, written = 100, 1, " %"
    else:
        scale, digits, written = 1, 1 if unit else 2, f" {unit}" if unit else ""
    value = _number(scale * measure.value, digits, written)
    if not several or math.isnan(measure.value):
        return value
    return f"{value} ({scale * measure.low:.{digits}f} to {scale * measure.high:.{digits}f})"


def _number(value: float, digits: int, unit: str = "") -> str:
    """A dash where nothing was measured."""
    return "–" if math.isnan(value) else f"{value:.{digits}f}{unit}"
