"""`femoreg slicer RUN`: a result as a scene of 3D Slicer."""

from pathlib import Path


def slicer(run: Path, *, case: Path | None = None, out: Path | None = None) -> None:
    """Write a result as a scene of 3D Slicer: drag scene.mrml into its window.

    Shows, in the space of the CT: the CT where it is a file, the surface of every object where it was found, below a
    transform `<anchor>_from_<object>`, the landmarks, the planned path and the guide. A scene says in a comment whether
    its result is trusted.

    Args:
        run: Folder that `femoreg register` wrote.
        case: Case folder, if it no longer stands where it stood, seen from RUN, when it was registered.
        out: Folder to write to; by default RUN/slicer. What stood in it stays, but for what is written anew.
    """
    from rich.console import Console

    from femoreg_torch.case import RESULT_NAME, new_folder, read_case, read_result
    from femoreg_torch.errors import InputError
    from femoreg_torch.neighbours.slicer import SCENE_NAME, write_scene

    result = read_result(run)
    if case is None:
        if result.case is None:
            raise InputError(f"{run / RESULT_NAME}, case: missing. Name the case folder with --case.")
        case = run / result.case
    folder = run / "slicer" if out is None else out
    with new_folder(folder) as built:
        write_scene(built, read_case(case), result, standing=folder)
    Console().print(f"Scene written to {folder / SCENE_NAME}", markup=False, highlight=False, soft_wrap=True)
