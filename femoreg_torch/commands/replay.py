"""`femoreg replay RUN`: the registration once more, as a moving picture."""

from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from femoreg_torch.case import Result


def replay(run: Path, *, case: Path | None = None, out: Path | None = None) -> None:
    """Show how a registration converged: an animated picture of the overlay, stage after stage.

    Each frame has the edges of all objects, rendered at the poses of that moment, each in its colour over the
    fluoroscopic images; views and objects that have no place yet stay dark and bare. Above stand the stage, its
    evaluations so far and its cost (what it minimises: mean dissimilarity of its images, and its prior); in each
    image the similarity (mean patch Grad-NCC, 1 at most) of all that is drawn, by the same measure in all stages.

    Args:
        run: Folder that `femoreg register` wrote.
        case: Case folder, if it no longer stands where it stood, seen from RUN, when it was registered.
        out: File to write, .gif, or a film as .mp4 or .webm (extra `video`); by default replay.gif in RUN.
    """
    from rich.console import Console

    from femoreg_torch.case import read_case, read_result
    from femoreg_torch.evaluation import write_replay
    from femoreg_torch.files import check_files

    console, result = Console(), read_result(run)
    folder = case_of(run, result, case)
    path = run / "replay.gif" if out is None else out
    check_files(path)
    with console.status("drawing"):
        write_replay(path, read_case(folder), result)
    console.print(f"Replay written to {path}")


def case_of(run: Path, result: "Result", case: Path | None) -> Path:
    """The case folder that was named, or else the one that the result of `run` names. Raises `InputError`."""
    from femoreg_torch.case import RESULT_NAME
    from femoreg_torch.errors import InputError
    from femoreg_torch.paths import check_readable

    if case is not None:
        return case
    if result.case is None:
        raise InputError(f"{run / RESULT_NAME}, case: missing. Name the case folder with --case.")
    folder = run / result.case
    check_readable(folder, "Name the case folder with --case.", "folder")
    return folder
