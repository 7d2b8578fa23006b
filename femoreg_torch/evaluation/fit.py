"""Whether a result is of a case."""

from femoreg_torch.case import Case, Result
from femoreg_torch.errors import InputError, shortened


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
