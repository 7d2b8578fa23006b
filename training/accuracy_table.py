"""An accuracy as files: every figure with its interval as JSON, and a page to read."""

import math
from dataclasses import asdict
from pathlib import Path

from femoreg_torch.files import write_json, write_text
from femoreg_torch.volume import HIP_LANDMARKS
from training.measure import COARSE, FAIR, REGISTERED_DEG, Accuracy, Measure

_SHARE, _MM = "share", "mm"
_ROWS = {  # figure → what it is called, and its unit
    "median_mm": ("landmark error, median", _MM),
    "mean_mm": ("landmark error, mean", _MM),
    "p90_mm": ("landmark error, 90th percentile", _MM),
    "gross": ("found further than 20 mm off", _SHARE),
    "recall": ("recall: found of those in the image", _SHARE),
    "within_10mm_or_missed": ("found within 10 mm, of those in the image", _SHARE),
    "false_positives": ("false positives: found of those not in the image", _SHARE),
    "dice_1": ("Dice, left hip bone", ""),
    "dice_2": ("Dice, right hip bone", ""),
    "dice_3": ("Dice, vertebrae", ""),
    "dice_4": ("Dice, sacrum", ""),
    "dice_5": ("Dice, left femur", ""),
    "dice_6": ("Dice, right femur", ""),
    "dice_mean": ("Dice, mean of six", ""),
    "pose_fair": ("pose within {:g}°, {:g} mm across, {:g} mm in depth".format(*FAIR), _SHARE),
    "pose_coarse": ("pose within {:g}°, {:g} mm, {:g} mm".format(*COARSE), _SHARE),
    "pose_refused": ("pose refused", _SHARE),
    "registered_1deg": (f"pelvis within {REGISTERED_DEG:g}° after single-view registration", _SHARE),
    "rotation_median_deg": ("rotation error, median", "°"),
}


def write_accuracy(out: Path, accuracy: Accuracy) -> None:
    """Write `accuracy.json` and `accuracy.md` into the folder `out`."""
    out.mkdir(parents=True, exist_ok=True)
    write_json(out / "accuracy.json", asdict(accuracy))
    write_text(out / "accuracy.md", accuracy_page(accuracy))


def accuracy_page(accuracy: Accuracy) -> str:
    """Markdown: all figures with 95 % intervals, then the landmarks one by one."""
    lines = [
        f"{accuracy.images} images of {accuracy.patients} patients. Errors are on the detector; brackets hold the 95 % "
        "interval by bootstrap over patients.",
        "",
        "| | |",
        "| --- | --- |",
        *(f"| {name} | {_value(accuracy.measures[key], unit)} |" for key, (name, unit) in _ROWS.items()),
        "",
        "| landmark | mean, mm | median, mm | recall | in the image |",
        "| --- | --- | --- | --- | --- |",
    ]
    for n, (mean, median, recall, count) in accuracy.landmarks.items():
        lines.append(f"| {HIP_LANDMARKS[n]} | {mean:.1f} | {median:.1f} | {100 * recall:.0f} % | {count} |")
    return "\n".join(lines) + "\n"


def _value(measure: Measure, unit: str) -> str:
    if math.isnan(measure.value):
        return "–"
    if unit == _SHARE:
        return f"{100 * measure.value:.1f} % ({100 * measure.low:.1f} to {100 * measure.high:.1f})"
    digits = 1 if unit else 2
    return f"{measure.value:.{digits}f} {unit}".rstrip() + f" ({measure.low:.{digits}f} to {measure.high:.{digits}f})"
