"""From a case on disk to a femur under its pads."""

import dataclasses
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from femoreg_torch.case import Case
from femoreg_torch.drr import CPU
from femoreg_torch.errors import InputError
from femoreg_torch.planning.calibration import calibrate
from femoreg_torch.planning.curve import Curve, Press
from femoreg_torch.planning.femur import cut_out
from femoreg_torch.planning.laws import Material
from femoreg_torch.planning.loading import make_loading
from femoreg_torch.planning.model import Bone, Model, make_bone, make_model, with_cement
from femoreg_torch.planning.settings import Planning
from femoreg_torch.registration.prepare.bones import read_bones
from femoreg_torch.volume import Volume

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Prepared:
    """A femur, its finite-element model and its loading; `ct` is the whole CT, for files on its grid."""

    ct: Volume
    bone: Bone
    model: Model
    press: Press
    planning: Planning

    def curve(self, cement: Array | None = None) -> Curve:
        """The curve of the femur with cement as shares (X, Y, Z) of the voxels' pores, or without."""
        return self.press.curve(self.material(cement), self.planning.curve)

    def material(self, cement: Array | None) -> Material:
        """Of the elements with that cement, or without."""
        if cement is None or not cement.any():
            return self.model.material
        return with_cement(self.model, self.bone, cement, self.planning.cement)

    def on_elements(self, size_mm: float) -> "Prepared":
        """The same femur on elements of another size. Raises `InputError` if they are too many."""
        if size_mm == self.model.mesh.size_mm:
            return self
        model, press = _pressed(self.bone, self.planning, size_mm, self.press.device)
        return dataclasses.replace(self, model=model, press=press)

    def on_ct(self, cement: Array) -> Volume:
        """The label map (0 or 1) of voxels with half of their pores or more in cement, on the grid of the whole CT."""
        data = np.zeros(self.ct.data.shape[::-1], np.uint8)
        box = tuple(
            slice(start, start + size) for start, size in zip(self.bone.femur.corner, cement.shape, strict=True)
        )
        data[box] = cement >= 0.5
        return self.ct.with_data(torch.from_numpy(np.ascontiguousarray(data.transpose(2, 1, 0))))


def prepare(case: Case, planning: Planning, device: torch.device = CPU) -> Prepared:
    """Read CT and labels of a case and build the model of the femur of its side; `device` solves its linear systems.

    The model has elements of `planning.mesh.size_mm`.

    Raises `InputError` for a case without side or head centre, and for what its CT and label map do not allow.
    """
    if case.side is None:
        raise InputError(f"{case.folder}/case.yaml, side: missing. Which femur is planned for, left or right?")
    name = f"FH-{case.side[0]}"
    if name not in case.landmarks:
        raise InputError(f"{case.folder}: landmark {name}, the centre of the {case.side} femoral head, is missing.")
    ct, bones = read_bones(case)
    (number,) = bones.of([f"femur_{case.side}"], case.anatomy)
    head = case.landmarks[name].numpy()
    femur = cut_out(ct, bones.labels, number, head, case.side, planning.mesh.shaft_mm)
    bone = make_bone(femur, calibrate(ct.data.numpy(), planning.calibration), planning)
    model, press = _pressed(bone, planning, planning.mesh.size_mm, device)
    return Prepared(ct, bone, model, press, planning)


def _pressed(bone: Bone, planning: Planning, size_mm: float, device: torch.device) -> tuple[Model, Press]:
    """A bone's model on elements of some size, and its pads."""
    model = make_model(bone, planning, size_mm)
    loading = make_loading(model, bone.femur, planning.load)
    return model, Press(model.mesh, loading, planning.bone.poisson, device)
