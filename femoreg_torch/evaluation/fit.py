"""Whether a result is of a case."""

import torch

from femoreg_torch.case import Case, Result
from femoreg_torch.case.inputs import case_digest
from femoreg_torch.case.result import path_in_camera1
from femoreg_torch.errors import InputError, shortened

_ROUNDED = 1e-3  # mm, or of a direction: what a file's digits leave


def check_fits(case: Case, result: Result) -> None:
    """Raises `InputError` if a result has other objects or another number of views than the case."""
    for name in result.poses.camera1_from:
        if name not in case.objects:
            raise InputError(
                f"the result has an object {shortened(name)}, but {case.folder} has {', '.join(case.objects)}. Name "
                "the case that was registered."
            )
    views = len(result.poses.camera_from_camera1)
    if views != len(case.views):
        raise InputError(
            f"the result has {views} views, but {case.folder} has {len(case.views)}. Name the case that was registered."
        )


def check_made_of(case: Case, result: Result) -> None:
    """Raises `InputError` if a result was made of another case, or of other files; of an older one nobody knows."""
    if result.case_files and result.case_files != case_digest(case):
        raise InputError(
            f"{case.folder}: the result was made of another case, or its case.yaml, CT, labels, images or models were "
            "changed since. Name the case that was registered, or register again."
        )


def check_plan_fits(case: Case, result: Result) -> None:
    """Raises `InputError` if the path or the guide that a result tells is not the one of the case."""
    points, directions = path_in_camera1(case, result.poses)
    for told, here in ((result.points_camera1, points), (result.directions_camera1, directions)):
        for name in told.keys() & here.keys():
            if not torch.allclose(told[name], here[name], atol=_ROUNDED):
                raise InputError(
                    f"{case.folder}: its {name.replace('_', ' ')} is another one than the result tells: the plan or "
                    "the device's points were changed since. Register again."
                )
