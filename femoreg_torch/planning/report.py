"""A plan on disk: `plan.json`, and what a reader, a robot's planner and 3D Slicer take from it."""

import dataclasses
from pathlib import Path as File
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

import femoreg_torch
from femoreg_torch.case import Case
from femoreg_torch.case.fields import Fields
from femoreg_torch.case.model import Side
from femoreg_torch.case.objects import check_frame
from femoreg_torch.errors import InputError
from femoreg_torch.files import read_json, temporary_file, write_json
from femoreg_torch.planning.curve import Curve
from femoreg_torch.planning.path import Ellipsoid, Path
from femoreg_torch.planning.plan import FemoroplastyPlan
from femoreg_torch.planning.prepare import Prepared
from femoreg_torch.planning.response import Response, response_content
from femoreg_torch.planning.settings import Planning
from femoreg_torch.settings import read_record
from femoreg_torch.volume import read_label_map, write_volume

Array = NDArray[np.float64]

PLAN_NAME = "plan.json"
# What is computed of a plan afterwards.
ROBUSTNESS_NAMES = ("offsets.json", "offsets.png", "robustness.json", "robustness.png")
CEMENT_NAME, OPTIMUM_NAME = "cement.nii.gz", "optimum.nii.gz"
NOTICE = "Research software, not a medical device. Loads are those of a model that no test of bones has confirmed."


def plan_content(case: Case, prepared: Prepared, plan: FemoroplastyPlan, seed: int) -> dict[str, Any]:
    """What stands in `plan.json`. Points are LPS mm, in the frame of the case's CT."""
    femur, planning = prepared.bone.femur, prepared.planning
    calibration = prepared.bone.calibration
    path, rate = plan.path, planning.diffusion.rate_ml_min
    return {
        "version": 1,
        "notice": NOTICE,
        "femoreg_torch": femoreg_torch.__version__,
        "case": str(case.folder.resolve()),
        "side": femur.side,
        "space": "LPS",
        "unit": "mm",
        "plan": {"entry_point": path.entry, "target": path.target},  # as case.yaml takes it
        "direction": path.direction,
        "length_mm": path.length_mm,
        "clearances": dataclasses.asdict(plan.clearances),
        "volume_ml": plan.volume_ml,
        "injections": [
            dataclasses.asdict(e) | {"point": i.point, "minutes": e.volume_ml / rate}
            for e, i in zip(path.ellipsoids, path.injections(), strict=True)
        ],
        "calibration": dataclasses.asdict(calibration),
        "calibrated": calibration.kind == "phantom",
        "elements": len(prepared.model.mesh.elements),
        "baseline": curve_content(plan.baseline),
        "optimum": curve_content(plan.optimum_curve) | {"gain": plan.optimum_gain, "loads_n": plan.optimum.loads_n},
        "planned": curve_content(plan.curve)
        | {"gain": plan.gain, "tried_n": plan.tried_n, "compared_n": plan.compared_n},
        "frame": {
            "head": femur.frame.head,
            "head_radius": femur.frame.head_radius,
            "proximal": femur.frame.proximal,
            "lateral": femur.frame.lateral,
            "posterior": femur.frame.posterior,
        },
        "force_direction": prepared.model.mesh.axes @ prepared.press.loading.direction,
        "settings": dataclasses.asdict(planning),
        "seed": seed,
    }


def curve_content(curve: Curve) -> dict[str, Any]:
    """A curve and its numbers."""
    return {
        "yield_load_n": curve.yield_load_n,
        "yield_mm": curve.yield_mm,
        "yield_energy_nmm": curve.yield_energy_nmm,
        "stiffness_n_mm": curve.stiffness_n_mm,
        "most_n": curve.most_n,
        "displacement_mm": curve.displacement_mm,
        "load_n": curve.load_n,
    }


def write_plan(folder: File, case: Case, prepared: Prepared, plan: FemoroplastyPlan, seed: int) -> None:
    """Write all files of a plan into a folder that exists."""
    write_json(folder / PLAN_NAME, plan_content(case, prepared, plan, seed))
    write_volume(folder / CEMENT_NAME, prepared.on_ct(plan.cement))
    write_volume(folder / OPTIMUM_NAME, prepared.on_ct(plan.optimum.cement))
    write_json(folder / "path.mrk.json", _markup(plan.path))
    _write_surfaces(folder, prepared, plan)
    _write_fields(folder / "fields.vtu", prepared, plan)


@dataclasses.dataclass(frozen=True, eq=False)
class StoredPlan:
    """What is read back of a plan."""

    case: File
    side: Side
    path: Path
    planning: Planning
    baseline_n: float
    planned_n: float
    cement: Array  # (X, Y, Z) 0 or 1, of the whole CT


def add_response(folder: File, response: Response) -> None:
    """Keep in a plan how its gain answers to small errors, in place of what it held of that."""
    content = read_json(folder / PLAN_NAME)
    write_json(folder / PLAN_NAME, content | {"response": response_content(response)})


def read_plan(folder: File) -> StoredPlan:
    """A plan that `write_plan` wrote. Raises `InputError` for a file that is missing or holds something else."""
    folder = File(folder)
    if not (folder / PLAN_NAME).is_file():
        raise InputError(f"{folder}: holds no {PLAN_NAME}. Give the folder that `femoreg plan` wrote.")
    content = read_json(folder / PLAN_NAME)
    where = f"{folder / PLAN_NAME}"
    try:
        planning = read_record(Planning, content["settings"], f"{where}, settings")
        ellipsoids = tuple(
            Ellipsoid(**{field.name: float(part[field.name]) for field in dataclasses.fields(Ellipsoid)})
            for part in content["injections"]
        )
        plan = Fields(content, where).mapping("plan")
        entry, target = (plan.point(key).numpy() for key in ("entry_point", "target"))
        loads = [Fields(content, where).mapping(key).number("yield_load_n") for key in ("baseline", "planned")]
        check_frame(Fields(content, where))
        case = File(content["case"])
        side = cast(Side, Fields(content, where).choice("side", ("left", "right")))
    except InputError:
        raise
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(f"{where}: is no plan of `femoreg plan` ({error} is missing or wrong).") from error
    cement = read_label_map(folder / CEMENT_NAME).data.numpy().transpose(2, 1, 0)
    return StoredPlan(case, side, Path(entry, target, ellipsoids), planning, loads[0], loads[1], cement.astype(float))


def _markup(path: Path) -> dict[str, Any]:
    """The path as a line of 3D Slicer."""
    points = [
        {"id": str(n), "label": label, "position": point, "positionStatus": "defined"}
        for n, (label, point) in enumerate((("entry point", path.entry), ("target", path.target)), 1)
    ]
    schema = "https://raw.githubusercontent.com/slicer/slicer/master/Modules/Loadable/Markups/Resources/Schema/markups-schema-v1.0.3.json#"
    line = {"type": "Line", "coordinateSystem": "LPS", "coordinateUnits": "mm", "controlPoints": points}
    return {"@schema": schema, "markups": [line]}


def _write_surfaces(folder: File, prepared: Prepared, plan: FemoroplastyPlan) -> None:
    """`cement.stl`, the surface of the cement's voxels, and `path.stl`, a rod of 2.5 mm radius; LPS mm."""
    import trimesh

    rod = trimesh.creation.cylinder(radius=2.5, segment=np.stack([plan.path.entry, plan.path.target]), sections=32)
    boxes = trimesh.voxel.ops.matrix_to_marching_cubes(np.pad(plan.cement >= 0.5, 1))
    boxes.apply_translation([-1, -1, -1])
    boxes.apply_transform(prepared.bone.femur.lps_from_index)
    for name, mesh in (("path.stl", rod), ("cement.stl", boxes)):
        with temporary_file(folder / name) as part:
            mesh.export(part)


def _write_fields(file: File, prepared: Prepared, plan: FemoroplastyPlan) -> None:
    """Elements with density, stiffness, cement and plastic strain, for ParaView and the like."""
    import meshio

    order = [0, 4, 6, 2, 1, 5, 7, 3]  # of VTK's hexahedron, from corners counted with z fastest
    mesh, model = prepared.model.mesh, prepared.model
    cells = {
        "fill": model.fill.mean(1),
        "ash_g_cc": model.ash,
        "modulus_mpa": model.material.modulus.mean(1),
        "strength_mpa": model.material.tension.mean(1),
        "cement": model.cement_share(plan.cement).mean(1),
        "optimum": model.cement_share(plan.optimum.cement).mean(1),
        "plastic_strain_without": plan.baseline.plastic.mean(1),
        "plastic_strain_planned": plan.curve.plastic.mean(1),
    }
    written = meshio.Mesh(
        mesh.points,
        [("hexahedron", mesh.elements[:, order])],
        cell_data={name: [values] for name, values in cells.items()},
        point_data={
            "displacement_without": plan.baseline.last.u @ mesh.axes.T,
            "displacement_planned": plan.curve.last.u @ mesh.axes.T,
        },
    )
    with temporary_file(file) as part:
        written.write(part)
