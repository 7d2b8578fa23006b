"""`femoreg navigate RUN`: what a registration means for the robot."""

from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from femoreg_torch.case import Result


def navigate(run: Path, *, robot: Path | None = None) -> None:
    """Tell how far the guide is from the planned path, and write the motion of the tool that corrects it.

    Writes into RUN: navigation.json, and navigation/ with every transform as 4×4 text (.txt) and as an ITK transform
    (.tfm) for 3D Slicer and SimpleITK. A matrix `b_from_a` takes points of frame a to frame b, in mm. A .tfm is in
    ITK's direction: under it in 3D Slicer, a model of frame a appears in frame b. `femoreg register` writes the same
    files; this command writes them anew, with the robot's calibration if it was not known then. It refuses where the
    plan of the case was changed since.

    Args:
        run: Folder that `femoreg register` wrote.
        robot: Calibration of the robot at the moment of the device images, to have all in its base frame too. Text:
            a line `base_from_device` and the four rows of the 4×4 matrix below it, in mm; or, so, both
            `base_from_flange` (forward kinematics) and `flange_from_device` (hand-eye calibration). Or an ITK
            transform named base_from_device.tfm, as 3D Slicer saves it.
    """
    from rich.console import Console

    from femoreg_torch.case import new_folder, read_result
    from femoreg_torch.errors import InputError
    from femoreg_torch.navigation import (
        NAVIGATION_NAME,
        NAVIGATION_NAMES,
        navigation_content,
        read_robot,
        summary,
        write_navigation,
    )

    result = read_result(run)
    not_asked = _check_plan(run, result)
    tool = (result.path and result.path[1]) or "device"
    calibration = None if robot is None else read_robot(robot, tool)
    try:
        content = navigation_content(result, calibration)
    except InputError as error:
        raise InputError(f"{run}: {error}") from error
    with new_folder(run, without=NAVIGATION_NAMES) as folder:
        write_navigation(folder, content)
    console = Console()
    if not_asked is not None:
        console.print(f"Whether the plan was changed since was not asked: {not_asked}", markup=False)
    for line in summary(content):
        console.print(line)
    console.print(f"Written to {run / NAVIGATION_NAME} and {run / 'navigation'}")


def _check_plan(run: Path, result: "Result") -> str | None:
    """Raises `InputError` if the case that was registered, where it still stands there, has another plan by now.

    Returns why that was not asked, if it was not: a run is complete without its case, whose CT, say, may be archived.
    """
    from femoreg_torch.case import read_case
    from femoreg_torch.errors import InputError
    from femoreg_torch.evaluation.fit import check_plan_fits

    if result.case is None:
        return "the result names no case."
    try:
        case = read_case(run / result.case)
    except InputError as error:
        return str(error)
    check_plan_fits(case, result)
    return None
