"""Is a wrong registration flagged? Whole runs from starts that are meant to go wrong.

From landmarks every procedure of the accuracy study succeeds, so it cannot tell. Here the pelvis starts near the end of
the capture range or beyond it, or the device beyond what its search covers.
"""

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import torch

from femoreg_torch.case import read_case
from femoreg_torch.case.femoroplasty import DEVICE, PELVIS
from femoreg_torch.case.model import Start
from femoreg_torch.case.verdict import verdict_on
from femoreg_torch.errors import InputError
from femoreg_torch.evaluation import errors, reference_points
from femoreg_torch.files import plain, write_json
from femoreg_torch.registration import Plan, prepare_scene, run_plan
from femoreg_torch.registration.quality import Limits, assess
from sim.study.page import machine, table, write_section
from sim.study.starts import Offset, displaced
from sim.study.summary import confusion

_NONE = Offset(0, 0, 0)


@dataclass(frozen=True)
class Sabotage:
    """What is wrong with the start of a run."""

    name: str
    pelvis: Offset
    device: Offset


SABOTAGES = (
    Sabotage("pelvis 24°, 60 mm deep, 24 mm aside", Offset(24, 60, 24), _NONE),
    Sabotage("pelvis 45°, 100 mm deep, 40 mm aside", Offset(45, 100, 40), _NONE),
    Sabotage("device 15°, 30 mm deep, 15 mm aside", _NONE, Offset(15, 30, 15)),
    Sabotage("device 30°, 60 mm deep, 30 mm aside", _NONE, Offset(30, 60, 30)),
)


def sabotaged_runs(cases: Sequence[Path], plan: Plan, starts: int) -> list[dict[str, Any]]:
    """One record per run, `starts` of every sabotage, spread evenly over the cases."""
    records = []
    for number, folder in enumerate(cases):
        case = read_case(folder)
        if case.truth is None or DEVICE not in case.truth.camera1_from:
            raise InputError(f"{folder}: has no truth of pelvis and device to start from.")
        scene, points = prepare_scene(case), reference_points(case)
        for kind, sabotage in enumerate(SABOTAGES):
            for start in range(number, starts, len(cases)):
                generator = torch.Generator().manual_seed(1000 * kind + start)
                centres = {name: thing.reference_point for name, thing in scene.objects.items()}
                true = case.truth.camera1_from
                pelvis = displaced(true[PELVIS], centres[PELVIS], sabotage.pelvis, generator)
                device = displaced(true[DEVICE], centres[DEVICE], sabotage.device, generator)
                objects = {**scene.objects, DEVICE: replace(scene.objects[DEVICE], start=Start(camera1_from=device))}
                wrong = replace(scene, objects=objects)
                outcome = run_plan(wrong, plan, pelvis, start, lambda *_: None)
                quality = assess(wrong, outcome.poses, Limits(), plan.imaging, outcome.trace)
                record = {
                    "sabotage": sabotage.name,
                    "case": folder.name,
                    "start": start,
                    "refused": None,
                    "errors": errors(case.truth, outcome.poses, points),
                    "quality": {name: asdict(value) for name, value in quality.items()},
                    "trusted": verdict_on(tuple(outcome.poses.camera1_from), quality).trusted,
                }
                records.append(plain(record))
                print(f"{folder.name}: {sabotage.name}, start {start}", flush=True)
    return records


def write_trust(records: Sequence[dict[str, Any]], preset: str, out: Path, docs: Path | None) -> str:
    """Write the records into `out`, and a section into `docs`, if given. Returns the section."""
    out.mkdir(parents=True, exist_ok=True)
    write_json(out / f"trust_{preset}.json", {"preset": preset, "runs": list(records)})
    rows = []
    for sabotage in SABOTAGES:
        counts = confusion([record for record in records if record["sabotage"] == sabotage.name])
        rows.append([sabotage.name, *(str(value) for value in asdict(counts).values())])
    text = "\n\n".join(
        [
            f"`python -m sim.study trust --preset {preset}`: whole runs on "
            f"{len({record['case'] for record in records})} simulated procedures from starts that lie so far off the "
            "truth, in random directions. Wrong is off by more than 4 mm or 2°, as above.",
            table(("start", "right, trusted", "right, flagged", "**wrong, trusted**", "wrong, flagged"), rows),
            f"Measured on: {machine()}",
        ]
    )
    if docs:
        write_section(docs, f"Trust in sabotaged runs: `{preset}`", text)
    return text
