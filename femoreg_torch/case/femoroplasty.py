"""The femoroplasty of the paper as a template of a case: pelvis, operated femur, and a device with a guide."""

from dataclasses import dataclass, replace
from pathlib import Path

from torch import Tensor

from femoreg_torch.case.model import Case, CaseObject, Model, PlannedPath, Side, Start

TEMPLATE = "femoroplasty"
PELVIS, FEMUR, DEVICE = "pelvis", "femur", "device"
ANATOMY_IMAGES, DEVICE_IMAGES = "anatomy", "device"  # kinds of images: without the device, and with it
DEVICE_POINTS = ("tip", "base", "center")  # guide axis: base → tip; center is where errors are reported
DEVICE_END = "end"  # optional: where the model ends along its guide, if that is not the tip


@dataclass(frozen=True, eq=False)
class Device:
    """A drilling or injection device. Points (3,) are mm in its own space."""

    model: Model
    points: dict[str, Tensor]  # those of DEVICE_POINTS, and DEVICE_END where it is told
    start: Start  # at a nominal pose in camera 1, or beside the femur


def operated_femur(side: Side) -> str:
    """The bone's name."""
    return f"femur_{side}"


def femoral_head(side: Side) -> str:
    """The landmark's name."""
    return f"FH-{side[0]}"


def femoroplasty_objects(side: Side, head: Tensor, device: Device | None) -> dict[str, CaseObject]:
    """Pelvis, placed by landmarks; the femur, which turns about the centre `head` (3,); and the device, if any."""
    objects = [
        CaseObject(PELVIS, bones=(PELVIS,)),
        CaseObject(FEMUR, bones=(operated_femur(side),), reference=head, start=Start(beside=PELVIS)),
    ]
    if device is not None:
        objects.append(_device_object(device))
    return {thing.name: thing for thing in objects}


def _device_object(device: Device) -> CaseObject:
    return CaseObject(
        DEVICE,
        model=device.model,
        reference=device.points["center"],
        points=device.points,
        images=(DEVICE_IMAGES,),
        start=device.start,
    )


def device_of(case: Case) -> Device | None:
    """The device of a femoroplasty, or None."""
    thing = case.objects.get(DEVICE)
    if thing is None or thing.model is None or thing.start.by_landmarks:
        return None
    return Device(thing.model, thing.points, thing.start)


def with_device(case: Case, device: Device) -> Case:
    """The case with this device in place of its own, and as the tool of its plan."""
    plan = None if case.plan is None else replace(case.plan, tool=DEVICE)
    return replace(case, objects={**case.objects, DEVICE: _device_object(device)}, plan=plan)


def planned(entry_point: Tensor, target: Tensor, device: Device | None, file: Path | None = None) -> PlannedPath:
    """The drill path (3,), (3,) through the operated femur; `file` is the plan.json that it is from."""
    return PlannedPath(FEMUR, entry_point, target, None if device is None else DEVICE, file)
