"""How far off the pelvis may start: success of the first view's stages against rotation, depth and shift."""

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from itertools import takewhile
from pathlib import Path
from typing import Any

import pandas as pd
import torch

from femoreg_torch.case import Case, read_case
from femoreg_torch.case.femoroplasty import PELVIS
from femoreg_torch.errors import InputError
from femoreg_torch.evaluation import ReferencePoints, errors, reference_points
from femoreg_torch.files import plain, temporary_file
from femoreg_torch.registration import Plan, prepare_scene, run_plan
from femoreg_torch.registration.plan import Stage
from femoreg_torch.registration.scene import Scene
from femoreg_torch.statistics.figures import write_figures
from femoreg_torch.statistics.formats import pipe_table
from femoreg_torch.statistics.rows import DONE, REFUSED, VARIED
from femoreg_torch.statistics.summary import Rate, independent
from sim.study.capture_figure import capture_figure, shading
from sim.study.cases import Stores
from sim.study.code import digest
from sim.study.conditions import Imaged, body_of, made_once
from sim.study.page import machine, write_section
from sim.study.procedures import Procedure
from sim.study.record import Record
from sim.study.starts import Offset, displaced
from sim.study.store import Run
from sim.study.study import Study
from sim.study.trial import kind
from sim.study.work import Setting

SUCCESS_MM, SUCCESS_DEG = 10.0, 2.0  # one view leaves millimetres of depth; the stages after it settle them
FULL = {"rotation": 30.0, "depth": 100.0, "lateral": 40.0}  # degrees, mm, mm
LEVELS = (0.2, 0.4, 0.6, 0.8, 1.0)  # shares of these, singly and, as `jointly`, all at once
_SHARES = (0.0, *LEVELS)
_OF_TRUTH = "rotation"  # the sweep among whose runs are those from the truth, where all sweeps begin
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


@dataclass(frozen=True)
class Displaced:
    """The first view's stages on kept cases, from starts off the truth that their runs tell by what is varied."""

    setting: Setting
    stores: Stores
    imaged: Imaged

    def __call__(self, procedure: Procedure, scratch: Path) -> Callable[[Run], Record]:
        setting = self.setting
        body = body_of(procedure, self.stores, self.imaged, scratch)
        case = read_case(made_once(setting.variation, procedure, setting.simulation, body, self.imaged))
        scene, points = prepare_scene(replace(case, views=case.views[:1])), reference_points(case)
        plan = first_stages(setting.plan)
        return lambda run: _started(case, scene, points, plan, dict(run.varied))


def _started(case: Case, scene: Scene, points: ReferencePoints, plan: Plan, varied: dict[str, Any]) -> Record:
    assert case.truth is not None  # of a simulated case
    truth, start = case.truth.first_views(1), varied["start"]
    by = offset(varied["sweep"], varied["share"])
    generator = torch.Generator().manual_seed(1000 * _SHARES.index(varied["share"]) + start)
    pose = displaced(truth.camera1_from[PELVIS], scene.objects[PELVIS].reference_point, by, generator)
    try:
        poses = run_plan(scene, plan, pose, start, lambda *_: None).poses
    except InputError as error:  # no defect: from there the images show nothing to go by, say
        return {"refused": str(error), "trusted": False, "reasons": []}
    found: Record = plain(
        {
            "refused": None,
            "trusted": False,
            "reasons": ["the first view's stages alone were run; nothing was assessed"],
            "asked": [PELVIS],
            "errors": {PELVIS: errors(truth, poses, points)[PELVIS]},
        }
    )
    return found


def plan_capture(setting: Setting, chosen: Sequence[Procedure], stores: Stores, imaged: Imaged, starts: int) -> Study:
    """`starts` runs at every level of every sweep, spread evenly over the procedures; the truth is one for all sweeps.

    Raises `InputError` for a plan that does not begin in view 1.
    """
    first_stages(setting.plan)
    runs = [
        Run(
            "capture_range",
            f"{sweep}{100 * share:.0f}_start{start}",
            procedure,
            digest(FULL, share, start, setting.digest),
            kind(procedure),
            setting.plan.preset,
            (("sweep", sweep), ("share", share), ("start", start), *asdict(offset(sweep, share)).items()),
        )
        for place, procedure in enumerate(chosen)
        for sweep in AXIS_LABELS
        for share in (_SHARES if sweep == _OF_TRUTH else LEVELS)
        for start in range(place, starts, len(chosen))
    ]
    return Study(runs, Displaced(setting, stores, imaged))


def success_rates(rows: pd.DataFrame) -> dict[str, list[tuple[float, Rate]]]:
    """(offset, rate of success) at every level of every sweep; each begins with the starts at the truth.

    Success: the pelvis within 10 mm and 2° of the truth; a start that is refused is none. Runs that a defect has ended
    are left out. Several starts on one procedure are not independent.
    """
    done = rows[rows["status"].isin((DONE, REFUSED))]
    share, sweep = done[f"{VARIED}share"], done[f"{VARIED}sweep"]
    good = done[f"{PELVIS}_mm"].le(SUCCESS_MM) & done[f"{PELVIS}_deg"].le(SUCCESS_DEG)
    rates: dict[str, list[tuple[float, Rate]]] = {}
    for name in AXIS_LABELS:
        rates[name] = []
        for level in _SHARES:
            here = share.eq(level) & (sweep.eq(name) | (level == 0))
            if here.any():
                rate = Rate(int(good[here].sum()), int(here.sum()), independent(done[here]))
                rates[name].append((level * FULL.get(name, 100.0), rate))
    return rates


def write_capture(rows: pd.DataFrame, plan: Plan, command: str, out: Path, docs: Path | None) -> str:
    """Write the figure into `out`, and a section with it into `docs`, if given. Returns the section.

    `command` is what made the rows.
    """
    rates = success_rates(rows)
    names = ", ".join(f"“{step.name}”" for step in first_stages(plan).steps)
    title = f"Capture range of the pelvis in view 1, {plan.preset}"
    (picture,) = write_figures([capture_figure(rates, AXIS_LABELS, f"capture_{plan.preset}", title)], out)
    lines = [
        [sweep, *(f"{value:g}: {rate.met} of {rate.of}" for value, rate in points)] for sweep, points in rates.items()
    ]
    text = "\n\n".join(
        [
            f"`{command}`: the stages of the first view ({names}) from starts off the "
            f"truth, on {rows['number'].nunique()} simulated procedures. Success: the middle of the pelvis within "
            f"{SUCCESS_MM:g} mm and its rotation within {SUCCESS_DEG:g}° afterwards; the femur starts as the CT has "
            f"it. {shading(rates)}",
            f"![Success rate against start offset](capture_{plan.preset}.png)",
            pipe_table(("offset: successes", *([""] * (len(LEVELS) + 1))), lines),
            f"Jointly: % of {FULL['rotation']:g}°, {FULL['depth']:g} mm and {FULL['lateral']:g} mm at once. "
            f"Measured on: {machine()}",
        ]
    )
    if docs:
        write_section(docs, f"Capture range: `{plan.preset}`", text)
        with temporary_file(docs / f"capture_{plan.preset}.png") as part:
            part.write_bytes(picture.png)
    return text
