"""`femoreg plan CASE` and what a plan is worth beside its place: `plan-offsets`, `plan-robustness`."""

from pathlib import Path
from typing import Literal


def plan(
    case: Path,
    *,
    out: Path,
    volume_ml: float = 9.5,
    preset: str = "default",
    seed: int = 0,
    device: Literal["cpu", "cuda", "auto"] = "cpu",
) -> None:
    """Plan where cement is injected into a femur: entry point, direction, amounts, and the modelled gain.

    Writes into OUT: plan.json (path in the form that a case's `plan:` takes, injections, loads, settings),
    cement.nii.gz and optimum.nii.gz (label maps of the CT's voxels, their axes in the order of LPS), cement.stl and
    path.stl, path.mrk.json for 3D Slicer, fields.vtu, curves.png and overlay.png. Loads are modelled, not measured; no
    medical device.

    Args:
        case: Folder with case.yaml, its CT, label map and landmarks.
        out: Folder to write.
        volume_ml: Cement in ml.
        preset: Name in configs/planning, or a YAML file; it may say `extends: default`.
        seed: Of the search for the path; same seed, same plan.
        device: Where linear systems are solved: cpu, cuda (the first GPU), or auto, a GPU where there is one.
    """
    from rich.console import Console

    from femoreg_torch.case import case_folder, read_case
    from femoreg_torch.commands.telling import progress_report, tell_device
    from femoreg_torch.files import check_new_folder, new_folder
    from femoreg_torch.planning.figures import curves_figure, overlay_figure, save
    from femoreg_torch.planning.plan import make_plan
    from femoreg_torch.planning.prepare import prepare
    from femoreg_torch.planning.report import ROBUSTNESS_NAMES, write_plan
    from femoreg_torch.planning.settings import load_planning

    console = Console()
    case = case_folder(case)
    check_new_folder(out, case)
    place = tell_device(console, device)
    content = read_case(case)
    prepared = prepare(content, load_planning(preset), device=place)
    with progress_report(console, "optimal cement") as report:
        found = make_plan(prepared, volume_ml, seed, report)
    with new_folder(out, without=ROBUSTNESS_NAMES) as folder:
        write_plan(folder, content, prepared, found, seed)
        curves = {"without cement": found.baseline, "as planned": found.curve, "optimum": found.optimum_curve}
        save(curves_figure(curves), folder / "curves.png")
        save(overlay_figure(prepared, found), folder / "overlay.png")
    calibration = prepared.bone.calibration.kind
    console.print(
        f"Modelled yield load {found.baseline.yield_load_n:.0f} N without cement, "
        f"{found.curve.yield_load_n:.0f} N with {volume_ml:g} ml as planned ({100 * found.gain:+.1f} %), "
        f"{found.optimum_curve.yield_load_n:.0f} N at the free optimum ({100 * found.optimum_gain:+.1f} %)."
    )
    doubt = (
        "" if calibration == "phantom" else ", not by a phantom: trust no load in N, and compare within this CT only"
    )
    console.print(f"Calibration: {calibration}{doubt}.")
    console.print(f"Written to {out}")


def plan_offsets(
    plan: Path,
    *,
    distance_mm: float | None = None,
    case: Path | None = None,
    device: Literal["cpu", "cuda", "auto"] = "cpu",
) -> None:
    """Move a plan by some mm in six directions, and its end in four, and tell what is left of its gain.

    Writes offsets.json and offsets.png into PLAN, and into its plan.json a quadratic through these loads, by which
    `femoreg register` tells what an uncertain registration costs. Cement spreads anew from the moved path, or is moved
    itself, as `offsets.moves` of the plan's settings says.

    Args:
        plan: Folder that `femoreg plan` wrote.
        distance_mm: How far; as in the plan's settings if not given.
        case: Folder of the case, if it is no longer where it was planned from.
        device: Where linear systems are solved, as for `femoreg plan`.
    """
    from rich.console import Console

    from femoreg_torch.commands.telling import progress_report, tell_device
    from femoreg_torch.errors import InputError
    from femoreg_torch.files import write_json
    from femoreg_torch.planning.diffusion import NoMarrowError
    from femoreg_torch.planning.figures import offsets_figure, save
    from femoreg_torch.planning.offsets import directions, turned_ends
    from femoreg_torch.planning.replan import Replan
    from femoreg_torch.planning.report import add_response

    console = Console()
    again = Replan(plan, case, tell_device(console, device))
    far = again.stored.planning.offsets.distance_mm if distance_mm is None else distance_mm
    if not far > 0:
        raise InputError(f"--distance-mm: a number above 0 was expected, found {far:g}.")
    wanted = {name: far * way for name, way in directions(again.side).items()}
    wanted |= turned_ends(again.stored.path, far)
    with progress_report(console, "offsets") as report:
        outcomes = {}
        for n, (name, offset) in enumerate(wanted.items()):
            report(name, n / len(wanted))
            try:
                outcomes[name] = again.at(offset)
            except NoMarrowError as error:
                raise InputError(f"{far:g} mm {name}: {error} Give a smaller --distance-mm.") from error
    write_json(plan / "offsets.json", again.content({name: [o] for name, o in outcomes.items()}) | {"distance_mm": far})
    add_response(plan, again.response(outcomes, far))
    save(offsets_figure(outcomes, again.baseline_n, again.planned_n), plan / "offsets.png")
    console.print(f"As planned: {again.planned_n:.0f} N ({again.gain(again.planned_n):+.1f} %, modelled).")
    for name, outcome in outcomes.items():
        console.print(f"{far:g} mm {name}: {outcome.yield_load_n:.0f} N ({again.gain(outcome.yield_load_n):+.1f} %).")


def plan_robustness(
    plan: Path,
    *,
    study: Path | None = None,
    covariance: Path | None = None,
    mean: list[float] | None = None,
    draws: int | None = None,
    seed: int = 0,
    case: Path | None = None,
    device: Literal["cpu", "cuda", "auto"] = "cpu",
) -> None:
    """Carry a plan out under errors of registration, shifts and turns, and tell how its gain is distributed.

    Writes robustness.json and robustness.png into PLAN. Errors are drawn from the trusted runs of a study, or from a
    normal distribution. A draw that leaves an injection without marrow is counted, and has no gain.

    Args:
        plan: Folder that `femoreg plan` wrote.
        study: Folder with runs.parquet or runs.csv, whose columns miss_mm_lr, … and miss_deg_lr, … tell by what the
            tool would miss after its correction, as `femoreg study` writes them.
        covariance: In place of a study: a text file with 3 × 3 numbers (mm², LPS) or 6 × 6 (mm at the entry point, then
            degrees about it), or a result.json of `femoreg register`, which holds the covariance of its path.
        mean: With it, the mean of the errors, as [x, y, z] or six numbers; zeros if not given.
        draws: How many; as in the plan's settings if not given.
        seed: Of the draws.
        case: Folder of the case, if it is no longer where it was planned from.
        device: Where linear systems are solved, as for `femoreg plan`.
    """
    import numpy as np
    from rich.console import Console

    from femoreg_torch.case import RESULT_NAME, read_case
    from femoreg_torch.commands.telling import progress_report, tell_device
    from femoreg_torch.errors import InputError
    from femoreg_torch.files import write_json
    from femoreg_torch.planning.diffusion import NoMarrowError
    from femoreg_torch.planning.figures import robustness_figure, save
    from femoreg_torch.planning.offsets import check_run, normal_moves, read_covariance, study_moves
    from femoreg_torch.planning.replan import Replan
    from femoreg_torch.planning.report import read_plan

    console = Console()
    stored = read_plan(plan)
    count = stored.planning.robustness.draws if draws is None else draws
    if count < 1:
        raise InputError(f"--draws: 1 or more was expected, found {count}.")
    runs = None
    if (study is None) == (covariance is None):
        raise InputError("plan-robustness: either --study or --covariance was expected.")
    if study is not None:
        if mean is not None:
            raise InputError("--mean: belongs to --covariance; a study has its own.")
        moves, runs = study_moves(study, stored.side, count, seed)  # first: the femur takes a while
    else:
        assert covariance is not None  # one of the two
        variance = read_covariance(covariance)
        if covariance.name == RESULT_NAME:
            check_run(covariance, read_case(case or stored.case), stored.side)
        moves = normal_moves(np.zeros(len(variance)) if mean is None else np.array(mean), variance, count, seed)
    again = Replan(plan, case, tell_device(console, device))
    with progress_report(console, "draws") as report:
        outcomes, lost = [], 0
        for n, move in enumerate(moves):
            report(f"draw {n + 1} of {len(moves)}", n / len(moves))
            try:
                outcomes.append(again.at(move))
            except NoMarrowError:
                lost += 1
    if not outcomes:
        raise InputError(
            f"{plan}: in none of {lost} draws does every injection lie in marrow. The errors are too large."
        )
    gains = [again.gain(outcome.yield_load_n) for outcome in outcomes]
    low, middle, high = np.percentile(gains, [5, 50, 95])
    spread = {
        "gain_percent_p5": low,
        "gain_percent_median": middle,
        "gain_percent_p95": high,
        "draws_without_marrow": lost,
        "seed": seed,
    } | ({} if runs is None else {"study_runs": runs})
    write_json(plan / "robustness.json", again.content({"draws": outcomes}) | spread)
    save(robustness_figure(outcomes, again.baseline_n, again.planned_n), plan / "robustness.png")
    least = min(outcome.clearance_mm for outcome in outcomes)
    console.print(
        f"Modelled gain {again.gain(again.planned_n):+.1f} % as planned; under these errors {middle:+.1f} % "
        f"(5 to 95 %: {low:+.1f} to {high:+.1f} %). Least clearance {least:.1f} mm."
    )
    if runs is not None:
        console.print(
            f"The errors are those of {runs} trusted run{'' if runs == 1 else 's'} of the study"
            + (", drawn again and again." if runs > 1 else ": of one run they have no spread, whatever is told above.")
        )
    if lost:
        console.print(
            f"[bold red]In {lost} of {len(moves)} draws an injection finds no marrow[/]: they have no gain, and are "
            "not in these figures."
        )
