"""`femoreg register`: from a case folder to poses."""

from pathlib import Path


def register(case: Path, *, out: Path, preset: str = "demo", seed: int = 0, weights: Path | None = None) -> None:
    """Register femur and device to the fluoroscopic images of a case.

    Landmarks found by the network in view 1 start the pelvis; the steps of the preset do the rest. Writes result.json
    with all poses, their quality and, where the case has a truth, their errors. `femoreg evaluate` makes the pictures.

    Args:
        case: Case folder with case.yaml.
        out: Folder to write the result to.
        preset: Workflow in configs/registration: `demo` (coarse and quick) or `paper` (images and
            optimisers of the paper, minutes).
        seed: Of the random searches; the same seed gives the same result.
        weights: Weights of the landmark network, if not those shipped (safetensors).
    """
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

    from femoreg_torch.case import RESULT_NAME, new_folder, read_case, write_json
    from femoreg_torch.evaluation import errors, poses_of, reference_points
    from femoreg_torch.registration.run import register_case

    console, procedure = Console(), read_case(case)
    columns = (TextColumn("{task.description}"), BarColumn(), TimeElapsedColumn())
    with Progress(*columns, console=console, transient=True) as progress:
        task = progress.add_task("reading the case", total=1.0)

        def report(step: str, share: float) -> None:
            progress.update(task, completed=share, description=step)

        content = register_case(procedure, preset, seed, weights, report)
    if procedure.truth is not None:
        content["errors"] = errors(procedure.truth, poses_of(content), reference_points(procedure))
    with new_folder(out) as folder:
        write_json(folder / RESULT_NAME, content)
    for name, quality in content["quality"].items():
        if not quality["trusted"]:
            console.print(f"[bold red]Do not trust the pose of the {name}[/]: {quality['reason']}.")
    console.print(f"Result written to {out / 'result.json'} ({content['timings_s']['total']:.0f} s).")
