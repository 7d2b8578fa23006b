"""One registration evaluated: errors, overlay and report, written beside its result."""

from pathlib import Path
from typing import Any

import cv2

from femoreg_torch.case import Case, Truth
from femoreg_torch.evaluation.errors import errors, reference_points
from femoreg_torch.evaluation.overlay import overlay_figure
from femoreg_torch.evaluation.report import write_report
from femoreg_torch.files import temporary_file, write_json


def evaluate_run(case: Case, result: dict[str, Any], run: Path) -> dict[str, Any] | None:
    """Write `errors.json` (if the case has a truth), `overlay.png` and `report.html` into `run`; returns the errors.

    `result` is what `read_result` gives. Raises `InputError` if it does not fit the case.
    """
    poses = poses_of(result)
    found = None if case.truth is None else errors(case.truth, poses, reference_points(case))
    overlay = overlay_figure(case, poses)
    if found is not None:
        write_json(run / "errors.json", found)
    with temporary_file(run / "overlay.png") as part:
        if not cv2.imwrite(str(part), overlay):
            raise OSError(f"{run / 'overlay.png'}: the picture could not be written.")
    write_report(run / "report.html", case, result, found, overlay)
    return found


def poses_of(result: dict[str, Any]) -> Truth:
    """The poses of a result in the form of a truth."""
    return Truth(result["camera_from_pelvis"], result["camera1_from_femur"], result.get("camera1_from_device"))
