"""One registration evaluated: errors, overlay and report, written beside its result."""

from pathlib import Path
from typing import Any

from femoreg_torch.case import Case, Result, new_folder
from femoreg_torch.evaluation.errors import errors, reference_points
from femoreg_torch.evaluation.fit import check_fits, check_made_of, check_plan_fits
from femoreg_torch.evaluation.overlay import draw, overlay_figure
from femoreg_torch.files import write_json, write_text
from femoreg_torch.pictures import write_picture
from femoreg_torch.registration import Scene, prepare_scene

ERRORS_NAME, OVERLAY_NAME, REPORT_NAME = "errors.json", "overlay.png", "report.html"
EVALUATION_NAMES = (ERRORS_NAME, OVERLAY_NAME, REPORT_NAME)


def evaluate(case: Case, result: Result, scene: Scene | None = None) -> dict[str, Any] | None:
    """Errors of a result against the truth of its case, see `errors`; None if the case has no truth.

    Raises `InputError` if the result does not fit the case.
    """
    check_fits(case, result)
    return None if case.truth is None else errors(case.truth, result.poses, reference_points(case, scene))


def write_report(case: Case, result: Result, run: Path) -> dict[str, Any] | None:
    """Write `errors.json` (if the case has a truth), `overlay.png` and `report.html` into `run`, all or none.

    Returns the errors. Raises `InputError` if the result does not fit the case.
    """
    # Here, as `register` needs none of it and would load it for nothing.
    from femoreg_torch.evaluation.report import report_page
    from femoreg_torch.evaluation.report.pictures import PANEL_PX

    check_fits(case, result)
    check_plan_fits(case, result)
    check_made_of(case, result)
    scene = prepare_scene(case)
    found = evaluate(case, result, scene)
    drawn = draw(scene, result.poses, PANEL_PX)
    overlay = overlay_figure(case, scene, result.poses, drawn)
    page = report_page(case, scene, result, found, drawn)
    with new_folder(run, without=EVALUATION_NAMES) as folder:
        if found is not None:
            write_json(folder / ERRORS_NAME, found)
        write_picture(folder / OVERLAY_NAME, overlay)
        write_text(folder / REPORT_NAME, page)
    return found


def evaluation_page(case: Case, result: Result, scene: Scene) -> str:
    """The report alone, as text, from the scene of the case. Raises `InputError` if the result does not fit it."""
    from femoreg_torch.evaluation.report import report_page
    from femoreg_torch.evaluation.report.pictures import PANEL_PX

    check_fits(case, result)
    check_plan_fits(case, result)
    found = evaluate(case, result, scene)
    return report_page(case, scene, result, found, draw(scene, result.poses, PANEL_PX))
