"""`femoreg register`: from a case folder to poses."""

from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

if TYPE_CHECKING:
    import torch

    from femoreg_torch.case import Case, Result
    from femoreg_torch.registration.workflow import Follow, Report


def register(
    case: Path,
    *,
    out: Path,
    preset: str = "fast",
    seed: int = 0,
    weights: Path | None = None,
    landmarks: Path | None = None,
    start: Path | None = None,
    robot: Path | None = None,
    require_trust: bool = False,
    device: Literal["cpu", "cuda", "auto"] = "cpu",
) -> int:
    """Register the objects of a case, such as femur and device, to its fluoroscopic images.

    Landmarks found by the network in view 1 start the bones; the steps of the preset do the rest. Writes result.json
    with all poses, their quality and, where the case has a truth, their errors; and where a tool with a guide was
    registered, the motion that brings it onto the planned path: navigation.json and navigation/, see `femoreg navigate
    --help`. Where the case's path is from `femoreg plan` (`plan: {file: PLAN/plan.json}`) and `femoreg plan-offsets`
    was run, it tells what the registration's uncertainty leaves of the modelled gain. `femoreg evaluate` makes pictures
    of the result, `femoreg replay` shows how it came about.

    Args:
        case: Case folder with case.yaml.
        out: Folder to write the result to. What an earlier run wrote there is replaced as a whole.
        preset: Workflow in configs/registration, or a YAML file: `fast` (derivatives of the images, everything refined
            together), `fast_wide_device` (as `fast`, for a nominal pose that is far off), `fast_carm_as_told` (as
            `fast`, but the C-arm's file is not refined), `device_fiducial` (as `fast`, but the device tells the
            C-arm's poses first), `paper` (images and optimisers of the paper, minutes), `derivative_free` (as `paper`,
            but coarse) or `rigid` (any rigid objects).
        seed: Of the random searches; the same seed gives the same result.
        weights: Weights of the landmark network, if not those shipped (safetensors).
        landmarks: Landmarks in the first image, picked by hand or found by another network, in place of the network's:
            a CSV file with the columns landmark, column_px, row_px (as `femoreg detect` writes it), or 3D Slicer
            markups with x = column and y = row.
        start: Start poses in place of landmarks and of nominal poses: a JSON file with an entry
            `camera1_from_<object>`, 4×4 in mm, for each object that is to start there, such as an earlier result.json.
        robot: Calibration of the robot, to have the motion in its base frame too: see `femoreg navigate --help`.
        require_trust: End with status 3 if the result is not trusted.
        device: Where volumes and images lie, and are drawn and compared: cpu, cuda (the first GPU), or auto, a GPU
            where there is one. Run `femoreg doctor` before you trust a GPU.
    """
    import os

    # NumPy and SciPy see only small matrices here, in loops: threads that wait for each other cost more than they save.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    from rich.console import Console
    from rich.markup import escape

    from femoreg_torch.case import RESULT_NAME, read_case
    from femoreg_torch.commands.status import NOT_TRUSTED
    from femoreg_torch.commands.telling import progress_report, tell_device, tell_verdict
    from femoreg_torch.navigation import summary

    console = Console()
    place = tell_device(console, device)
    read = read_case(case)
    response = None
    if read.plan is not None and read.plan.file is not None:  # else the planner is loaded for nothing
        from femoreg_torch.planning.quote import response_of

        response = response_of(read)
    with progress_report(console, "reading the case") as report:
        result, navigation = register_into(
            out,
            read,
            preset,
            seed,
            weights=weights,
            landmarks=landmarks,
            start=start,
            robot=robot,
            device=place,
            report=report,
        )
    tell_verdict(console, result)
    if response is not None:
        from femoreg_torch.planning.quote import quoted_gain

        quoted = quoted_gain(response, result)
        if quoted is not None:
            console.print(quoted.sentence)
    for line in [] if navigation is None else summary(navigation, result.verdict.reasons):
        console.print(line)
    console.print(f"Result written to {escape(str(out / RESULT_NAME))} ({result.timings_s['total']:.0f} s).")
    return NOT_TRUSTED if require_trust and not result.verdict.trusted else 0


def register_into(
    out: Path,
    case: "Case",
    preset: str,
    seed: int,
    *,
    weights: Path | None = None,
    landmarks: Path | None = None,
    start: Path | None = None,
    robot: Path | None = None,
    device: "torch.device | None" = None,
    report: "Report | None" = None,
    follow: "Follow | None" = None,
) -> "tuple[Result, dict[str, Any] | None]":
    """Register a case and write all that belongs to its run into `out`; see `register`.

    Without a `device`, it computes on the CPU. `follow` is told the poses after every optimisation.

    Returns the result, and the content of navigation.json if there is any. Raises `InputError`.
    """
    import os
    from dataclasses import replace

    from femoreg_torch.case import RESULT_NAME, new_folder, result_content, write_json
    from femoreg_torch.case.inputs import case_digest
    from femoreg_torch.case.review import REVIEW_NAME
    from femoreg_torch.case.start_files import read_pixels, read_start_poses
    from femoreg_torch.drr import CPU
    from femoreg_torch.errors import InputError
    from femoreg_torch.evaluation import EVALUATION_NAMES, REPLAY_NAMES, evaluate
    from femoreg_torch.files import check_new_folder
    from femoreg_torch.navigation import NAVIGATION_NAMES, navigation_content, read_robot, write_navigation
    from femoreg_torch.neighbours.slicer import SCENE_FOLDER
    from femoreg_torch.registration.run import network_detector, register_scene, silent

    check_new_folder(out, case.folder)
    tool = None if case.plan is None else case.plan.tool
    calibration = None if robot is None or tool is None else read_robot(robot, tool)
    if robot is not None and (tool is None or not _is_seen(case, tool)):
        raise InputError(
            f"{case.folder}: --robot was given, but there is no tool to steer, or no view has an image of it."
        )
    find = None if weights is None else network_detector(case, weights, device or CPU)
    marks = None if landmarks is None else read_pixels(landmarks)
    poses = None if start is None else read_start_poses(start)
    # before all is read: of a file that changes meanwhile it is not the digest that the next command finds
    case_files = case_digest(case)
    inputs = inputs_of(case, preset, weights, landmarks=landmarks, start=start, robot=robot)
    result, scene = register_scene(
        case,
        None,
        preset,
        seed=seed,
        find=find,
        landmarks=marks,
        start=poses,
        device=device or CPU,
        report=report or silent,
        follow=follow,
    )
    result = replace(
        result,
        errors=evaluate(case, result, scene),
        inputs=inputs,
        case_files=case_files,
        case=os.path.relpath(case.folder.resolve(), out.resolve()),
    )
    navigation = None if result.object_from_tool is None else navigation_content(result, calibration)
    of_the_result = (*EVALUATION_NAMES, *NAVIGATION_NAMES, *REPLAY_NAMES, REVIEW_NAME, SCENE_FOLDER)
    with new_folder(out, without=of_the_result) as built:
        write_json(built / RESULT_NAME, result_content(result))
        if navigation is not None:
            write_navigation(built, navigation)
    return result, navigation


def inputs_of(case: "Case", preset: str, weights: Path | None = None, **given: Path | None) -> str:
    """Digest of all that a run is made of: the files of its case, its preset, weights, and other files by option.

    Raises `InputError`.
    """
    from femoreg_torch.case.inputs import inputs_digest
    from femoreg_torch.configs import load_preset
    from femoreg_torch.detect import weights_file

    return inputs_digest(case, {"weights": weights_file(weights), **given}, load_preset("registration", preset))


def _is_seen(case: "Case", tool: str) -> bool:
    return any(kind in view.images for kind in case.objects[tool].images or case.kinds for view in case.views)
