"""What a run of a study is: a procedure simulated under a condition, registered, and measured."""

import shutil
import time
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import torch
from femoreg_torch.configs import load_preset
from torch import Tensor

from femoreg_torch.case import Case, Result, read_case
from femoreg_torch.case.femoroplasty import PELVIS
from femoreg_torch.detect import load_network
from femoreg_torch.errors import InputError
from femoreg_torch.geometry import load_carm
from femoreg_torch.registration import Plan, load_plan, prepare_scene
from femoreg_torch.settings import read_record
from sim.study.cases import Stores
from sim.study.closed_loop import ClosedLoop, run_rounds
from sim.study.code import digest
from sim.study.conditions import Body, make_case, simulation_of
from sim.study.detections import DetectionNoise, simulated_detector
from sim.study.procedures import Procedure
from sim.study.protocol import Protocol, Variation
from sim.study.record import Record
from sim.study.starts import displaced
from sim.study.store import Run
from sim.study.trial import check_views, first_views, register_case
from sim.theatre.settings import Simulation


@dataclass(frozen=True)
class Setting:
    """One condition of a protocol with all that it names read, so that a run depends on no other file."""

    variation: Variation
    plan: Plan
    simulation: dict[str, Any]  # content of a `Simulation`, to which the variation is still to be applied
    detections: DetectionNoise | None
    closed_loop: ClosedLoop | None

    @property
    def digest(self) -> str:
        """Of everything that its runs depend on beside procedure and code."""
        content = simulation_of(self.variation, self.simulation)
        carm = content.get("carm")
        return digest(
            asdict(replace(self.variation, varied={})),
            repr(self.plan),
            content,
            None if carm is None else repr(load_carm(carm)),
            None if self.detections is None else asdict(self.detections),
            None if self.closed_loop is None else asdict(self.closed_loop),
        )


def settings_of(protocol: Protocol, name: str) -> dict[str, Setting]:
    """The conditions of a protocol by name. Raises `InputError` for a preset that is not there or does not fit."""
    base = load_preset("simulation", protocol.simulation)
    plans = {preset: load_plan(preset) for preset in {v.preset or protocol.preset for v in protocol.vary}}
    found = {}
    for variation in protocol.vary:
        where = f"study {name}, {variation.name}"
        simulation = read_record(Simulation, simulation_of(variation, base), where)
        if not protocol.cases:
            check_views(variation.views, len(simulation.acquisition.orbit_deg), f"{where}, views")
        plan = plans[variation.preset or protocol.preset]
        detections = variation.detections or protocol.detections
        found[variation.name] = Setting(variation, plan, base, detections, protocol.closed_loop)
    return found


@dataclass(frozen=True)
class Simulated:
    """Runs on procedures that are simulated, with a picture of each result in `overlays`, but for closed loops.

    `keep` is a folder for their cases, which else are not kept.
    """

    settings: dict[str, Setting]
    stores: Stores
    overlays: Path
    keep: Path | None = None

    def __call__(self, procedure: Procedure, scratch: Path) -> Callable[[Run], Record]:
        body = Body(procedure, self.stores, scratch / "body")
        return lambda run: self._record(run, body, scratch)

    def _record(self, run: Run, body: Body, scratch: Path) -> Record:
        setting, procedure = self.settings[run.condition], run.procedure
        target = (self.keep or scratch) / run.name
        shutil.rmtree(target, ignore_errors=True)  # what was kept of an earlier try
        condition, base, loop = setting.variation, setting.simulation, setting.closed_loop
        if loop is not None:
            found = run_rounds(loop, condition, procedure, base, body, target, partial(registered, setting, procedure))
        else:
            began = time.perf_counter()
            make_case(condition, procedure, base, body, target)
            simulated = time.perf_counter() - began
            found, _ = registered(setting, procedure, target, overlay=picture_of(run, self.overlays))
            found["timings_s"] = found.get("timings_s", {}) | {"simulation": simulated}
        if self.keep is None:
            shutil.rmtree(target)
        return found


@dataclass(frozen=True)
class Recorded:
    """Runs on cases that are there, by the number of their procedure, with a picture of each result in `overlays`."""

    settings: dict[str, Setting]
    cases: dict[int, Path]
    overlays: Path

    def __call__(self, procedure: Procedure, scratch: Path) -> Callable[[Run], Record]:
        folder = self.cases[procedure.number]

        def record(run: Run) -> Record:
            return registered(self.settings[run.condition], procedure, folder, overlay=picture_of(run, self.overlays))[
                0
            ]

        return record


def picture_of(run: Run, overlays: Path) -> Path:
    """Where the picture of a run's result is."""
    return overlays / f"{run.name}.jpg"


def registered(
    setting: Setting,
    procedure: Procedure,
    folder: Path,
    start: Mapping[str, Tensor] | None = None,
    overlay: Path | None = None,
) -> tuple[Record, Result | None]:
    """Register the case in a folder as a condition says, from `start` poses (4, 4) if there are any.

    A picture of the result is written to `overlay`, if given.

    Raises `InputError` if the condition needs the truth of a case that has none.
    """
    variation = setting.variation
    case = first_views(read_case(folder), variation.views)
    find = scene = None
    if start is None and setting.detections is not None:
        find = simulated_detector(
            case.landmarks, _true_pelvis(case), setting.detections, procedure.seed, load_network()
        )
    if start is None and variation.start is not None:
        scene = prepare_scene(case)
        generator = torch.Generator().manual_seed(procedure.seed)
        centre = scene.objects[PELVIS].reference_point
        start = {PELVIS: displaced(_true_pelvis(case), centre, variation.start, generator)}
    return register_case(case, setting.plan, procedure.seed, find, start, scene, overlay)


def _true_pelvis(case: Case) -> Tensor:
    if case.truth is None or PELVIS not in case.truth.camera1_from:
        raise InputError(f"{case.folder}: has no truth of the pelvis, from which `start` and `detections` are drawn.")
    return case.truth.camera1_from[PELVIS]
