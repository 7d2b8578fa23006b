"""`femoreg register`: from a case folder to poses."""

from pathlib import Path


def register(
    case: Path,
    *,
    out: Path,
    preset: str = "fast",
    seed: int = 0,
    weights: Path | None = None,
    robot: Path | None = None,
) -> None:
    """Register femur and device to the fluoroscopic images of a case.

    Landmarks found by the network in view 1 start the pelvis; the steps of the preset do the rest. Writes result.json
    with all poses, their quality and, where the case has a truth, their errors; and where a device was registered, the
    motion that brings its guide onto the planned path: navigation.json and navigation/, see `femoreg navigate --help`.
    `femoreg evaluate` makes pictures of the result, `femoreg replay` shows how it came about.

    Args:
        case: Case folder with case.yaml.
        out: Folder to write the result to.
        preset: Workflow in configs/registration: `fast` (derivatives of the images, everything refined together),
            `paper` (images and optimisers of the paper, minutes) or `derivative_free` (as `paper`, but coarse).
        seed: Of the random searches; the same seed gives the same result.
        weights: Weights of the landmark network, if not those shipped (safetensors).
        robot: Calibration of the robot, to have the motion in its base frame too: see `femoreg navigate --help`.
    """
    import os

    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

    from femoreg_torch.case import RESULT_NAME, new_folder, read_case, write_json
    from femoreg_torch.errors import InputError
    from femoreg_torch.evaluation import errors, poses_of, reference_points
    from femoreg_torch.navigation import clear_navigation, navigation_content, read_robot, summary, write_navigation
    from femoreg_torch.registration.run import register_case

    console, procedure = Console(), read_case(case)
    calibration = None if robot is None else read_robot(robot)
    if robot is not None and (procedure.device is None or any(view.device is None for view in procedure.views)):
        raise InputError(f"{case}: --robot was given, but there is no device to steer, or a view has no image of it.")
    columns = (TextColumn("{task.description}"), BarColumn(), TimeElapsedColumn())
    with Progress(*columns, console=console, transient=True) as progress:
        task = progress.add_task("reading the case", total=1.0)

        def report(step: str, share: float) -> None:
            progress.update(task, completed=share, description=step)

        content = register_case(procedure, preset, seed, weights, report)
    if procedure.truth is not None:
        content["errors"] = errors(procedure.truth, poses_of(content), reference_points(procedure))
    content["case"] = os.path.relpath(case.resolve(), out.resolve())
    navigation = navigation_content(content, calibration) if "camera1_from_device" in content else None
    with new_folder(out) as folder:
        write_json(folder / RESULT_NAME, content)
        if navigation is None:
            clear_navigation(out)
        else:
            write_navigation(folder, navigation)
    for name, quality in content["quality"].items():
        if not quality["trusted"]:
            console.print(f"[bold red]Do not trust the pose of the {name}[/]: {quality['reason']}.")
    for line in [] if navigation is None else summary(navigation):
        console.print(line)
    console.print(f"Result written to {out / 'result.json'} ({content['timings_s']['total']:.0f} s).")
