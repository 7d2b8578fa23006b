"""`femoreg slicer RUN`: a result as a scene of 3D Slicer."""

from pathlib import Path


def slicer(run: Path, *, case: Path | None = None, out: Path | None = None) -> None:
    """Write a result as a scene of 3D Slicer: drag scene.mrml into its window.

    Shows, in the space of the CT: the CT where it is a file, the surface of every object where it was found, below a
    transform `<anchor>_from_<object>`, the landmarks, the planned path and the guide. CT and landmarks are left out
    where nothing that was registered is a bone of the CT or placed by landmarks. A scene says in a comment whether its
    result is trusted.

    Args:
        run: Folder that `femoreg register` wrote.
        case: Case folder, if it no longer stands where it stood, seen from RUN, when it was registered.
        out: Folder to write to. What stood in it stays, but for what is written anew. By default RUN/slicer, which goes
            with the result: the next registration into RUN removes it.
    """
    from rich.console import Console

    from femoreg_torch.case import case_folder, new_folder, read_case, read_result
    from femoreg_torch.commands.replay import case_of
    from femoreg_torch.evaluation.fit import check_fits, check_made_of, check_plan_fits
    from femoreg_torch.files import check_new_folder
    from femoreg_torch.neighbours.slicer import SCENE_FOLDER, SCENE_NAME, outside_ct, write_scene

    console, result = Console(), read_result(run)
    of = case_folder(case_of(run, result, case))
    folder = run / SCENE_FOLDER if out is None else out
    check_new_folder(folder, of)
    content = read_case(of)
    with console.status("writing the scene"), new_folder(folder) as built:
        check_fits(content, result)
        check_made_of(content, result)
        check_plan_fits(content, result)
        write_scene(built, content, result, standing=folder)
    if outside_ct(content, result) and (content.ct_path is not None or content.landmarks):
        Console(stderr=True).print(
            "CT and landmarks are left out: no object that was registered is a bone of the CT or placed by landmarks.",
            markup=False,
            highlight=False,
            soft_wrap=True,
        )
    console.print(f"Scene written to {folder / SCENE_NAME}", markup=False, highlight=False, soft_wrap=True)
