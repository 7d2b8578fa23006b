"""How far off the pelvis may start: success of the first view's stages against rotation, depth and shift."""

from collections.abc import Sequence
from dataclasses import asdict, replace
from itertools import takewhile
from pathlib import Path
from typing import Any

import torch

from femoreg_torch.case import read_case
from femoreg_torch.case.femoroplasty import PELVIS
from femoreg_torch.errors import InputError
from femoreg_torch.evaluation import errors, reference_points
from femoreg_torch.files import temporary_file, write_json
from femoreg_torch.registration import Plan, prepare_scene, run_plan
from femoreg_torch.registration.plan import Stage
from femoreg_torch.statistics.figures import write_figures
from femoreg_torch.statistics.formats import pipe_table
from sim.study.capture_figure import capture_figure
from sim.study.page import machine, write_section
from sim.study.starts import Offset, displaced

SUCCESS_MM, SUCCESS_DEG = 10.0, 2.0  # one view leaves millimetres of depth; the stages after it settle them
FULL = {"rotation": 30.0, "depth": 100.0, "lateral": 40.0}  # degrees, mm, mm
LEVELS = (0.2, 0.4, 0.6, 0.8, 1.0)  # shares of these, singly and, as `jointly`, all at once
AXIS_LABELS = {
    "rotation": "rotation, °",
    "depth": "depth, mm",
    "lateral": "shift in the image, mm",
    "jointly": "% of all three",
}


def offset(sweep: str, share: float) -> Offset:
    """The offset of one sweep at a share of its full size."""
    size = {name: share * full if sweep in (name, "jointly") else 0.0 for name, full in FULL.items()}
    return Offset(size["rotation"], size["depth"], size["lateral"])


def first_stages(plan: Plan) -> Plan:
    """The stages of a plan before it looks at any view but the first. Raises `InputError` if there are none."""
    steps = tuple(takewhile(lambda step: isinstance(step, Stage) and step.images == "first", plan.steps))
    if not steps:
        raise InputError(f"registration preset {plan.preset}: its first step looks at other views than the first.")
    return replace(plan, steps=steps)


def sweep_starts(cases: Sequence[Path], plan: Plan, starts: int) -> list[dict[str, Any]]:
    """One record per start: `starts` of them at every level of every sweep, spread evenly over the cases.

    A record holds sweep, share, case, the offset and the errors of the pelvis afterwards.
    """
    plan = first_stages(plan)
    records = []
    for number, folder in enumerate(cases):
        case = read_case(folder)
        if case.truth is None:
            raise InputError(f"{folder}: has no truth to start from.")
        one_view = replace(case, views=case.views[:1])
        scene = prepare_scene(one_view)
        points = reference_points(case)
        truth = case.truth.first_views(1)
        for sweep in AXIS_LABELS:
            for level, share in enumerate((0.0, *LEVELS)):
                if share == 0 and sweep != "rotation":
                    continue  # the truth is the same start in every sweep
                by = offset(sweep, share)
                for start in range(number, starts, len(cases)):
                    generator = torch.Generator().manual_seed(1000 * level + start)
                    centre = scene.objects[PELVIS].reference_point
                    pose = displaced(truth.camera1_from[PELVIS], centre, by, generator)
                    poses = run_plan(scene, plan, pose, start, lambda *_: None).poses
                    row = errors(truth, poses, points)[PELVIS]
                    records.append({"sweep": sweep, "share": share, "case": folder.name, **asdict(by), "pelvis": row})
            print(f"{folder.name}: {sweep} done", flush=True)
    return records


def succeeded(record: dict[str, Any]) -> bool:
    """Whether the pelvis came within 10 mm and 2° of the truth."""
    return record["pelvis"]["mm"] <= SUCCESS_MM and record["pelvis"]["deg"] <= SUCCESS_DEG


def success_rates(records: Sequence[dict[str, Any]]) -> dict[str, list[tuple[float, int, int]]]:
    """(offset, successes, starts) of every level of every sweep; each begins with the starts at the truth."""
    rates: dict[str, list[tuple[float, int, int]]] = {}
    for sweep in AXIS_LABELS:
        rates[sweep] = []
        for share in (0.0, *LEVELS):
            here = [r for r in records if r["share"] == share and (r["sweep"] == sweep or share == 0)]
            if here:
                rates[sweep].append((share * FULL.get(sweep, 100.0), sum(map(succeeded, here)), len(here)))
    return rates


def write_capture(records: Sequence[dict[str, Any]], plan: Plan, out: Path, docs: Path | None) -> str:
    """Write records and figure into `out`, and a section with the figure into `docs`, if given. Returns the section."""
    out.mkdir(parents=True, exist_ok=True)
    rates = success_rates(records)
    names = ", ".join(f"“{step.name}”" for step in first_stages(plan).steps)
    cases = sorted({record["case"] for record in records})
    title = f"Capture range of the pelvis in view 1, {plan.preset}"
    (picture,) = write_figures([capture_figure(rates, AXIS_LABELS, f"capture_{plan.preset}", title)], out)
    write_json(out / f"capture_{plan.preset}.json", {"preset": plan.preset, "starts": list(records)})
    rows = [
        [sweep, *(f"{value:g}: {good} of {starts}" for value, good, starts in points)]
        for sweep, points in rates.items()
    ]
    text = "\n\n".join(
        [
            f"`make capture-range PRESET={plan.preset}`: the stages of the first view ({names}) from starts off the "
            f"truth, on {len(cases)} simulated procedures. Success: the middle of the pelvis within {SUCCESS_MM:g} mm "
            f"and its rotation within {SUCCESS_DEG:g}° afterwards; the femur starts as the CT has it. Shaded: 95 % "
            "interval.",
            f"![Success rate against start offset](capture_{plan.preset}.png)",
            pipe_table(("offset: successes", *([""] * (len(LEVELS) + 1))), rows),
            f"Jointly: % of {FULL['rotation']:g}°, {FULL['depth']:g} mm and {FULL['lateral']:g} mm at once. "
            f"Measured on: {machine()}",
        ]
    )
    if docs:
        write_section(docs, f"Capture range: `{plan.preset}`", text)
        with temporary_file(docs / f"capture_{plan.preset}.png") as part:
            part.write_bytes(picture.png)
    return text
