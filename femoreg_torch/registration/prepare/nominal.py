"""Do nominal poses and named points lie where they can?"""

from collections.abc import Mapping

from torch import Tensor

from femoreg_torch.case import Case, CaseObject
from femoreg_torch.errors import InputError
from femoreg_torch.registration.scene import RigidObject
from femoreg_torch.volume import Volume

_MOST_BEYOND_MM = 500.0  # of an object's points from the box of its model: a guide may be longer than the sleeve
_NEAREST = 0.1  # of the source distance, of a start pose: the housing of a tube is longer


def _named_points(thing: CaseObject) -> dict[str, Tensor]:
    """All points (3,) of an object that have a name, its reference too if it is given."""
    return thing.points if thing.reference is None else {**thing.points, "reference": thing.reference}


def check_points(case: Case, thing: CaseObject, volume: Volume) -> None:
    """Raises `InputError` for a point (3,) of an object that lies nowhere near its model."""
    for name, point in _named_points(thing).items():
        beyond = volume.beyond_mm(point)
        if beyond > _MOST_BEYOND_MM:
            raise InputError(
                f"{case.folder}/case.yaml, {thing.name}: its point {name} lies {beyond:.0f} mm outside its model. Are "
                "both in mm, and in the same space?"
            )


def check_starts(objects: Mapping[str, RigidObject], sdd_mm: float, where: str) -> None:
    """Raises `InputError` that starts with `where` for a nominal pose that is not between source and detector."""
    for name, thing in objects.items():
        check_start(name, thing.start.camera1_from, thing.reference_point, sdd_mm, where)


def check_start(name: str, camera1_from: Tensor | None, point: Tensor, sdd_mm: float, where: str) -> None:
    """Raises `InputError` if a nominal pose (4, 4) puts a point (3,) of an object not between source and detector."""
    if camera1_from is None:
        return
    depth = (camera1_from[:3, :3] @ point + camera1_from[:3, 3])[2].item()
    if not _NEAREST * sdd_mm < depth < sdd_mm:
        place = "behind the source" if depth <= 0 else "at the source" if depth < sdd_mm else "behind the detector"
        raise InputError(
            f"{where}: the start pose puts {name} {place}, {depth:.3g} mm along the beam from the source (it has "
            f"{sdd_mm:.0f} mm to the detector). Give the transform from its space to camera 1, in mm, and not its "
            "inverse."
        )
