"""A small operating room: three rigid objects, three views, images rendered more finely than they are registered."""

import math
from collections.abc import Callable
from dataclasses import replace
from functools import cache

import torch
from scipy import ndimage
from torch import Tensor
from torch.nn import functional as F

from femoreg_torch.case import Start
from femoreg_torch.drr import project
from femoreg_torch.geometry import Camera, CArm, Poses, about_point, centred_camera, exp_se3, rigid, rotation_angle
from femoreg_torch.optimize import LevenbergMarquardt
from femoreg_torch.registration import OrbitSearch, Plan, Stage, Step
from femoreg_torch.registration.imaging import PLAIN, draw_still
from femoreg_torch.registration.materials.calibration import Calibration
from femoreg_torch.registration.scene import Kind, RigidObject, Scene, Segmentation
from femoreg_torch.registration.turn_search import TurnSearch
from femoreg_torch.volume import Volume, axis_aligned

CARM = CArm(centred_camera(1020.0, (3.0, 3.0), (88, 88)), (0.0, 0.0, 632.0), (0.0, 1.0, 0.0))
VOXEL_MM = 3.0
VIEW_ANGLES_DEG = (0.0, 10.0, -15.0, 22.0)


def float64(*values: float) -> Tensor:
    return torch.tensor(values, dtype=torch.float64)


def bone(seed: int, voxels: tuple[int, int, int], mu: float, middle: tuple[float, ...] = (0, 0, 0)) -> Volume:
    """A lumpy hollow object without any symmetry, with its middle at a given place of its own space."""
    generator = torch.Generator().manual_seed(seed)
    noise = torch.from_numpy(ndimage.gaussian_filter(torch.rand(*voxels, generator=generator).numpy(), 2.0))
    edge = torch.zeros(voxels)
    edge[3:-3, 3:-3, 3:-3] = 1
    filled = (noise > noise.quantile(0.65)) & edge.bool()
    shell = filled.numpy() & ~ndimage.binary_erosion(filled.numpy())
    soft = torch.from_numpy(ndimage.gaussian_filter(shell.astype("float32"), 0.5)) * mu
    origin = [m - (n - 1) / 2 * VOXEL_MM for m, n in zip(middle, voxels[::-1], strict=True)]
    return Volume(soft, axis_aligned((VOXEL_MM,) * 3, (origin[0], origin[1], origin[2])))


VOLUMES = {
    "pelvis": bone(1, (44, 34, 52), 0.06),
    "femur": bone(2, (36, 20, 18), 0.06, (70, 0, 20)),  # in the same space: one CT holds both
    "device": bone(3, (12, 12, 30), 0.2),
}
STARTS = {"pelvis": Start(), "femur": Start(beside="pelvis")}
CLASSES = {"pelvis": (1, 2), "femur": (3,)}  # of a segmentation with four classes
REFERENCE_POINTS = {"pelvis": float64(0, 0, 0), "femur": float64(64, 0, -20), "device": float64(0, 0, 0)}
KINDS = {"anatomy": ("pelvis", "femur"), "device": ("pelvis", "femur", "device")}
KINK_DEG = (5.0, -4.0, 0.0)  # of a broken object, along the axes of camera 1


def true_poses(views: tuple[int, ...] = (0, 1, 2)) -> Poses:
    """Pelvis and femur 740 mm from the source, the device in front of them; views a little off the orbit."""
    off_orbit = [
        rigid(),
        exp_se3(float64(0.004, -0.005, 0.004, 1, -0.8, 3)),
        exp_se3(float64(-0.004, 0.004, -0.006, -0.5, 1, -3)),
        exp_se3(float64(0.005, 0.003, 0.002, 1, -1, 2)),
    ]
    orbit = CARM.orbit(float64(*VIEW_ANGLES_DEG) * math.pi / 180)
    pelvis = exp_se3(float64(0.1, -0.2, 0.05, 0, 0, 0)) + _shift(-24, -8, 740)
    return Poses(
        torch.stack([off_orbit[view] @ orbit[view] for view in views]),
        {
            "pelvis": pelvis,
            "femur": off(pelvis, REFERENCE_POINTS["femur"], (6, -5, 8), (0, 0, 0)),
            "device": exp_se3(float64(0.2, 0.9, 0.3, 0, 0, 0)) + _shift(10, 12, 560),
        },
    )


def _shift(x: float, y: float, z: float) -> Tensor:
    matrix = torch.zeros(4, 4, dtype=torch.float64)
    matrix[:3, 3] = float64(x, y, z)
    return matrix


def line_integrals(poses: Poses, view: int, names: tuple[str, ...]) -> Tensor:
    """Line integrals (H, W) on a grid four times as fine and averaged, with a step of 0.3 mm."""
    drawn = [_of_one(name, tuple(poses.camera_from(name)[view].flatten().tolist())) for name in names]
    return torch.stack(drawn).sum(0)


@cache  # most tests look at the same objects at the same poses
def _of_one(name: str, camera_from_object: tuple[float, ...]) -> Tensor:
    fine = centred_camera(1020.0, (0.75, 0.75), (352, 352))
    integrals = project([VOLUMES[name]], float64(*camera_from_object).view(1, 1, 4, 4), fine, 0.3)
    return torch.nn.functional.avg_pool2d(integrals[None], 4)[0, 0]


def make_scene(
    poses: Poses,
    seed: int = 0,
    with_device: bool = True,
    noise: float = 0.003,
    camera1_from_device: Tensor | None = None,
) -> Scene:
    """Noisy images of all views with all objects at `poses`; the device starts at its own unless told otherwise."""
    generator = torch.Generator().manual_seed(seed)

    def image(view: int, names: tuple[str, ...]) -> Tensor:
        exact = line_integrals(poses, view, names)
        return exact + noise * torch.randn(exact.shape, generator=generator)

    views = range(len(poses.camera_from_camera1))
    images: dict[Kind, tuple[Tensor, ...]] = {"anatomy": tuple(image(v, ("pelvis", "femur")) for v in views)}
    if with_device:
        images["device"] = tuple(image(v, ("pelvis", "femur", "device")) for v in views)
    always: tuple[Kind, ...] = ("anatomy", "device")
    objects = {
        name: RigidObject(VOLUMES[name], REFERENCE_POINTS[name], always, STARTS[name], classes)
        for name, classes in CLASSES.items()
    }
    start = poses.camera1_from["device"] if camera1_from_device is None else camera1_from_device
    objects["device"] = RigidObject(VOLUMES["device"], REFERENCE_POINTS["device"], ("device",), Start(start))
    return Scene(CARM, objects, images)


def segmentations(poses: Poses) -> tuple[Segmentation, ...]:
    """What a faultless network sees in every view, on a coarser grid: background, two halves of the pelvis, femur."""
    camera = CARM.camera.downsampled(2)
    left = torch.arange(camera.shape[1]) < camera.shape[1] // 2

    def seen(view: int) -> Segmentation:
        pelvis, femur = (
            torch.nn.functional.max_pool2d(line_integrals(poses, view, (name,))[None], 2)[0] > 0.01
            for name in ("pelvis", "femur")
        )
        labels = torch.where(femur, 3, torch.where(pelvis, torch.where(left, 1, 2), 0))
        return Segmentation(torch.nn.functional.one_hot(labels, 4).movedim(-1, 0).float(), camera)

    return tuple(seen(view) for view in range(len(poses.camera_from_camera1)))


def off(pose: Tensor, point: Tensor, rotation_deg: tuple[float, ...], translation_mm: tuple[float, ...]) -> Tensor:
    """A pose (4, 4) turned about one of the object's own points (3,) and shifted, in camera axes."""
    twist = torch.cat([float64(*rotation_deg) * math.pi / 180, float64(*translation_mm)])
    return about_point(exp_se3(twist), (pose @ torch.cat([point, float64(1)]))[:3]) @ pose


def halves(volume: Volume, axis: int) -> tuple[Volume, Volume]:
    """A volume's lower and upper half along an axis of its array."""
    low = torch.zeros_like(volume.data)
    half = volume.data.shape[axis] // 2
    low.narrow(axis, 0, half).copy_(volume.data.narrow(axis, 0, half))
    return volume.with_data(low), volume.with_data(volume.data - low)


def images_of_broken(
    name: str, axis: int, poses: Poses, kinds: dict[str, tuple[str, ...]]
) -> dict[Kind, tuple[Tensor | None, ...]]:
    """Images, finer than they are registered and averaged, with the upper half of an object turned by the kink."""
    turned = off(poses.camera1_from[name], REFERENCE_POINTS[name], KINK_DEG, (0, 0, 0))
    fine = centred_camera(1020.0, (1.5, 1.5), (176, 176))

    def image(view: int, names: tuple[str, ...]) -> Tensor:
        parts: list[Volume] = []
        places: list[Tensor] = []
        for each in names:
            camera = poses.camera_from_camera1[view]
            if each == name:
                parts += halves(VOLUMES[each], axis)
                places += [camera @ poses.camera1_from[each], camera @ turned]
            else:
                parts.append(VOLUMES[each])
                places.append(camera @ poses.camera1_from[each])
        return F.avg_pool2d(project(parts, torch.stack(places)[None], fine, 0.5)[None], 2)[0, 0]

    return {kind: tuple(image(view, names) for view in range(3)) for kind, names in kinds.items()}


def error(estimate: Tensor, truth: Tensor, point: Tensor) -> tuple[float, float]:
    """Displacement in mm of one of the object's points, and the angle in degrees, between two poses (4, 4)."""
    homogeneous = torch.cat([point, float64(1)])
    angle = rotation_angle(estimate[:3, :3] @ truth[:3, :3].T)
    return float(((estimate - truth) @ homogeneous).norm()), math.degrees(float(angle))


def quicker(plan: Plan) -> Plan:
    """The same plan with a fifth of the random candidates, at most two starts, and 3 mm along the rays.

    It draws nothing but the objects, as these images show nothing else.
    """

    def changed(step: Step) -> Step:
        if isinstance(step, Calibration | TurnSearch):
            return step
        assert isinstance(step, Stage | OrbitSearch)
        step = replace(step, level=replace(step.level, step_mm=3.0))
        if isinstance(step, OrbitSearch):
            return step
        assert isinstance(step.optimiser, LevenbergMarquardt)
        fewer = replace(step.optimiser, candidates=step.optimiser.candidates // 5, starts=min(step.optimiser.starts, 2))
        return replace(step, optimiser=fewer, imaging=PLAIN)

    return replace(plan, steps=tuple(changed(step) for step in plan.steps))


def alone(scene: Scene, view: int, camera: Camera) -> Callable[[str], Tensor]:
    """What each object by itself shows to a camera of a view (from 0), at its true pose."""
    return lambda name: draw_still(scene.objects[name], true_poses().camera_from(name)[view], camera, 1.0)
