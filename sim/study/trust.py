"""Is a wrong registration flagged? Whole runs from starts that are meant to go wrong.

From landmarks every procedure of the accuracy study succeeds, so it cannot tell. Here the pelvis starts near the end of
the capture range or beyond it, or the device beyond what its search covers.
"""

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import pandas as pd
import torch

from femoreg_torch.case import Case, read_case
from femoreg_torch.case.femoroplasty import DEVICE, PELVIS
from femoreg_torch.registration import Plan, prepare_scene
from femoreg_torch.registration.scene import Scene
from femoreg_torch.statistics.formats import pipe_table
from femoreg_torch.statistics.outcome import WRONG_DEG, WRONG_MM
from femoreg_torch.statistics.rows import VARIED
from femoreg_torch.statistics.summary import confusion
from sim.study.accuracy_page import confusion_cells
from sim.study.cases import Stores
from sim.study.code import digest
from sim.study.conditions import Imaged, body_of, made_once
from sim.study.page import machine, write_section
from sim.study.procedures import Procedure
from sim.study.record import Record
from sim.study.starts import Offset, displaced
from sim.study.store import Run
from sim.study.study import Study
from sim.study.trial import kind, register_case
from sim.study.work import Setting

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
_NAMES = [sabotage.name for sabotage in SABOTAGES]


@dataclass(frozen=True)
class Sabotaged:
    """Whole runs on kept cases, from the starts that their runs tell by what is varied."""

    setting: Setting
    stores: Stores
    imaged: Imaged

    def __call__(self, procedure: Procedure, scratch: Path) -> Callable[[Run], Record]:
        setting = self.setting
        body = body_of(procedure, self.stores, self.imaged, scratch)
        folder = made_once(setting.variation, procedure, setting.simulation, body, self.imaged)
        case = read_case(folder)
        scene = prepare_scene(case)
        return lambda run: _sabotaged(case, scene, setting.plan, dict(run.varied))


def _sabotaged(case: Case, scene: Scene, plan: Plan, varied: dict[str, Any]) -> Record:
    assert case.truth is not None  # of a simulated case
    place, seed = _NAMES.index(varied["sabotage"]), varied["start"]
    generator = torch.Generator().manual_seed(1000 * place + seed)
    start = {
        name: displaced(case.truth.camera1_from[name], scene.objects[name].reference_point, by, generator)
        for name, by in ((PELVIS, SABOTAGES[place].pelvis), (DEVICE, SABOTAGES[place].device))
    }
    return register_case(case, plan, seed, start=start, scene=scene)[0]


def plan_trust(setting: Setting, chosen: Sequence[Procedure], stores: Stores, imaged: Imaged, starts: int) -> Study:
    """`starts` runs of every sabotage, spread evenly over the procedures."""
    runs = [
        Run(
            "trust",
            f"sabotage{number}_start{start}",
            procedure,
            digest(asdict(sabotage), start, setting.digest),
            kind(procedure),
            setting.plan.preset,
            (("sabotage", sabotage.name), ("start", start)),
        )
        for place, procedure in enumerate(chosen)
        for number, sabotage in enumerate(SABOTAGES, 1)
        for start in range(place, starts, len(chosen))
    ]
    return Study(runs, Sabotaged(setting, stores, imaged))


def write_trust(rows: pd.DataFrame, preset: str, docs: Path | None) -> str:
    """Put the section of these runs into `docs`, if given. Returns the section."""
    lines = []
    for name in _NAMES:
        counts = confusion(rows[rows[f"{VARIED}sabotage"].eq(name)])
        assert counts is not None  # of whole runs there always is one
        lines.append([name, *confusion_cells(counts)])
    text = "\n\n".join(
        [
            f"`python -m sim.study trust --preset {preset}`: whole runs on {rows['number'].nunique()} simulated "
            "procedures from starts that lie so far off the truth, in random directions. Wrong is off by more than "
            f"{WRONG_MM:g} mm or {WRONG_DEG:g}°, as above.",
            pipe_table(("start", "right, trusted", "right, flagged", "**wrong, trusted**", "wrong, flagged"), lines),
            f"Measured on: {machine()}",
        ]
    )
    if docs:
        write_section(docs, f"Trust in sabotaged runs: `{preset}`", text)
    return text
