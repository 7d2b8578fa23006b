"""Is the objective right on a device? Value, gradient and curvature against plain torch in float64, on the CPU.

The projector's march and the similarity's formulas without any compiled code give the truth: the gradient by automatic
differentiation through both, the curvature from central differences of the march.
"""

from dataclasses import dataclass

import torch
from torch import Tensor

from femoreg_torch.drr.reference import march
from femoreg_torch.drr.sampling import middle_of, offsets_of
from femoreg_torch.geometry import CArm, Poses, centred_camera, exp_se3
from femoreg_torch.registration.costs import image_costs
from femoreg_torch.registration.level import Level
from femoreg_torch.registration.objective import stage_objective
from femoreg_torch.registration.scene import Body, RigidObject, Scene
from femoreg_torch.similarity import GradNcc
from femoreg_torch.volume import Volume, axis_aligned

_CAMERA = centred_camera(1020.0, (5.0, 5.0), (40, 40))
_CARM = CArm(_CAMERA, (0.0, 0.0, 632.0), (0.0, 1.0, 0.0))
_LEVEL = Level(pixel_mm=5.0, step_mm=3.0)
_SIMILARITY = GradNcc(patch_radius=4)
_STRIDE = 4  # of the patches that the curvature is summed over, as Grad-NCC does
_VOXELS, _SPACING_MM = 36, 3.0
_SCALE = torch.tensor([0.02, 0.02, 0.02, 1.0, 1.0, 4.0], dtype=torch.float64)
_DELTA = torch.tensor([0.4, -0.3, 0.5, 0.6, -0.4, 0.8], dtype=torch.float64)
_STEP = 1e-4
# Of the value; of the gradient's and the curvature's length. float32 has some 1e-5.
MOST_VALUE, MOST_GRADIENT, MOST_CURVATURE = 1e-4, 1e-3, 1e-3


@dataclass(frozen=True)
class ObjectiveParity:
    """Deviations from the truth, relative to it."""

    value: float
    gradient: float
    curvature: float

    @property
    def holds(self) -> bool:
        """Whether the objective is right; nan counts as wrong."""
        return self.value <= MOST_VALUE and self.gradient <= MOST_GRADIENT and self.curvature <= MOST_CURVATURE


def objective_parity(device: torch.device) -> ObjectiveParity:
    """Compare the objective of a stage, one object in one image, on a device with plain torch."""
    thing, pose = _lumps(), _pose()
    body = Body(("object",), 0, pose[:3, 3], _SCALE)
    image = _marched(thing, pose[None])[0].float()
    scene = Scene(
        _CARM, {"object": RigidObject(thing, torch.zeros(3, dtype=torch.float64), ("plain",))}, {"plain": (image,)}
    ).to(device)
    poses = Poses(torch.eye(4, dtype=torch.float64)[None], {"object": pose})
    costs = image_costs(scene, poses, (body,), ["object"], [("plain", 0)], _LEVEL, _SIMILARITY)
    objective = stage_objective(costs, (body,), None)
    model = objective.quadratic(_DELTA)
    value = objective.values(_DELTA[None])[0]

    similarity = _SIMILARITY.against(image)
    delta = _DELTA.clone().requires_grad_()
    drawn = _marched(thing, body.motion(delta[None]) @ pose)
    true_value = similarity(drawn)[0]
    (true_gradient,) = torch.autograd.grad(true_value, delta)
    with torch.no_grad():
        steps = _STEP * torch.eye(6, dtype=torch.float64)
        above, below = (_marched(thing, body.motion(_DELTA + way) @ pose) for way in (steps, -steps))
        true_curvature = similarity.curvature(drawn[0], (above - below) / (2 * _STEP), _STRIDE)
    exact = float(true_value.detach())
    return ObjectiveParity(
        max(abs(model.value - exact), abs(float(value) - exact)) / exact,
        _apart(model.gradient, true_gradient),
        _apart(model.hessian, true_curvature),
    )


def _lumps() -> Volume:
    """Seven balls of different size, Gaussian and cut off, so that nothing is symmetric and most voxels are empty."""
    generator = torch.Generator().manual_seed(5)
    axis = (torch.arange(_VOXELS) - (_VOXELS - 1) / 2) * _SPACING_MM
    z, y, x = torch.meshgrid(axis, axis, axis, indexing="ij")
    data = torch.zeros(_VOXELS, _VOXELS, _VOXELS)
    for _ in range(7):
        where = 30 * (2 * torch.rand(3, generator=generator) - 1)
        sigma = 5 + 5 * torch.rand((), generator=generator)
        squared = (x - where[0]) ** 2 + (y - where[1]) ** 2 + (z - where[2]) ** 2
        data += 0.03 * torch.exp(-squared / (2 * sigma**2))
    data = torch.where(data > 1e-3, data, torch.zeros(()))
    data[[0, -1]] = data[:, [0, -1]] = data[:, :, [0, -1]] = 0
    return Volume(data, axis_aligned((_SPACING_MM,) * 3, (-(_VOXELS - 1) / 2 * _SPACING_MM,) * 3))


def _pose() -> Tensor:
    """The pose (4, 4) of the object at the start of the objective."""
    return exp_se3(torch.tensor([0.2, -0.4, 0.3, 3.0, -5.0, 640.0], dtype=torch.float64))


def _marched(volume: Volume, poses: Tensor) -> Tensor:
    """Line integrals (B, H, W) float64 for poses (B, 4, 4)."""
    index_from_camera = torch.linalg.inv(poses @ volume.lps_from_index)
    offsets = offsets_of(middle_of(volume, poses), _LEVEL.step_mm)
    return march(volume.data, index_from_camera, _CAMERA, offsets, _LEVEL.step_mm)


def _apart(found: Tensor, exact: Tensor) -> float:
    return float((found - exact).norm() / exact.norm())
