"""What is in the beam beside the patient: the device, of one material or of several, and parts of the table."""

from dataclasses import dataclass

import numpy as np
import trimesh

from femoreg_torch.errors import InputError
from sim.physics.line_integrals import Solid, solid_of
from sim.physics.materials import metal_density
from sim.theatre.device import PARTS, make_device_parts
from sim.theatre.settings import Acquisition

_SLEEVE = ("steel", "titanium", "cobalt chromium")  # a guide has to be hard
_OTHERS = ("steel", "titanium", "aluminium", "pmma", "peek")
_SAME_MM, _SAME_VOLUME = 0.01, 0.005  # of a device and of its parts together


@dataclass(frozen=True, eq=False)
class Metal:
    """Solids that are no part of the patient (some may be plastic)."""

    device: list[Solid]  # in CAD space
    table: list[Solid]  # in the frame of camera 1


def draw_materials(seed: int) -> dict[str, str]:
    """A material for each part of the device of this seed; the parts beside the sleeve are of two kinds at least."""
    rng = np.random.default_rng([seed, 1])
    materials = {"sleeve": str(rng.choice(_SLEEVE))}
    others = [name for name in PARTS if name != "sleeve"]
    drawn = rng.choice(_OTHERS, len(others))
    while len(set(drawn)) < 2:
        drawn = rng.choice(_OTHERS, len(others))
    return materials | dict(zip(others, map(str, drawn), strict=True))


def metal_in_beam(mesh: trimesh.Trimesh, seed: int, settings: Acquisition) -> Metal:
    """The device whose surface is `mesh`, and the table, as the settings say; `seed` is that of the device.

    Raises `InputError` if the device is to be of several materials, and `mesh` is not that of the seed.
    """
    return Metal(
        _mixed_device(mesh, seed)
        if settings.device_materials == "mixed"
        else [Solid("titanium", united(mesh), metal_density(settings.device_hu))],
        table_solids(seed) if settings.table_parts else [],
    )


def united(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    """A closed mesh whose bodies, where they overlap, are one: what lies in two of them is not twice as dense.

    A mesh with closed hollows is left as it is, and so is one of bodies that share edges: paths through bodies that
    only touch add up rightly.
    """
    bodies = mesh.split(only_watertight=False)
    if len(bodies) < 2 or not all(body.is_volume and body.volume > 0 for body in bodies):
        return mesh
    return trimesh.boolean.union(list(bodies))


def _mixed_device(mesh: trimesh.Trimesh, seed: int) -> list[Solid]:
    parts = make_device_parts(seed)
    bounds = np.array([part.bounds for part in parts.values()])
    apart = np.abs(np.array([bounds[:, 0].min(0), bounds[:, 1].max(0)]) - mesh.bounds).max()
    volume = sum(part.volume for part in parts.values())
    if apart > _SAME_MM or abs(volume / mesh.volume - 1) > _SAME_VOLUME:
        raise InputError(
            f"device_materials: mixed: the device is not that of seed {seed}, so its parts are unknown. Simulate with "
            "the seed that the device was made from, or take `device` out of the patient's case.yaml."
        )
    materials = draw_materials(seed)
    return [solid_of(part, materials[name]) for name, part in parts.items()]


def table_solids(seed: int) -> list[Solid]:
    """A steel wire along the table and an aluminium clamp with a steel screw, behind the patient, camera 1 frame, mm.

    The wire crosses the whole image of view 1 at one side, the clamp stands into it from the other.
    """
    rng = np.random.default_rng([seed, 2])
    side = rng.choice((-1, 1))
    depth, across, lean = rng.uniform(860, 890), rng.uniform(45, 95), rng.uniform(-15, 15)
    wire = trimesh.creation.cylinder(
        rng.uniform(0.6, 1.2), segment=[(side * across - lean, -170, depth), (side * across + lean, 170, depth)]
    )
    middle = np.array([-side * rng.uniform(100, 115), rng.uniform(-70, 70), depth])
    block = trimesh.creation.box((45, 32, 14), transform=trimesh.transformations.translation_matrix(middle))
    screw = trimesh.creation.cylinder(4, segment=middle + np.array([[12 * side, -24, 0], [12 * side, 24, 0]]))
    clamp = trimesh.boolean.difference([block, screw])
    return [solid_of(wire, "steel"), solid_of(clamp, "aluminium"), solid_of(screw, "steel")]
