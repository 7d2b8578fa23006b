"""What the images of a procedure say of every unknown: their Fisher information, at the true poses.

Derivatives are those of the library's own projector. Two kinds of images: those of the simulator (polychromatic,
scatter, soft tissue), and those that the registration itself would draw.

What is taken into account is the noise of the quanta and of the electronics. The scintillator blurs signal and quantum
noise alike, so that it takes no information away where quanta are what is noisy; it is left out. So is what the
detector's gain pattern leaves. Scattered light is light without information. Soft tissue informs of no pose: a
patient's moves by itself.
"""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from femoreg_torch.case.femoroplasty import ANATOMY_IMAGES, DEVICE, DEVICE_IMAGES, FEMUR, PELVIS
from femoreg_torch.drr import project_with_jacobian
from femoreg_torch.errors import InputError
from femoreg_torch.evaluation import ReferencePoints
from femoreg_torch.geometry import Camera, Poses
from femoreg_torch.geometry.rigid import skew
from femoreg_torch.registration.imaging import Imaging, tissue_integrals
from femoreg_torch.registration.scene import Scene
from femoreg_torch.volume import Volume, sharpened
from sim.physics.beam import open_beam, shutter
from sim.physics.fluoroscopy import XrayModel, photons_per_pixel, scattered, transmission
from sim.physics.line_integrals import Solid, together
from sim.physics.materials import WATER_PER_BONE
from sim.study.information import Information, image_information
from sim.study.responses import centres_in, view_block
from sim.theatre.posed_tissue import PosedTissue, areal_posed_tissue

DISTANCE = "source distance"
_WAVES = 6  # half waves across the detector, along rows and columns, of soft tissue whose shape is unknown
_DEVICE_MM = 0.5  # voxels that the device is drawn on: photons have to change smoothly as it moves


def image_name(kind: str, view: int) -> str:
    """What the image of a kind in a view (from 0) is called in tables."""
    return f"{kind} {view + 1}"


def principal_block(view: int) -> str:
    """The name of the unknown principal point of a view (from 0)."""
    return f"principal point {view + 1}"


@dataclass(frozen=True, eq=False)
class Drawn:
    """An image without its noise, and how it changes with all that is unknown."""

    kind: str
    view: int  # from 0
    expected: Tensor  # (H, W) photons
    variance: Tensor  # (H, W) of their number, electronic noise included
    changes: dict[str, Tensor]  # (w, H, W) of the expected photons, by the unknowns of each block

    @property
    def information(self) -> Information:
        """Its Fisher information about the unknowns."""
        rows = {block: part.flatten(1) for block, part in self.changes.items()}
        return image_information(image_name(self.kind, self.view), rows, self.variance.flatten())


@dataclass(frozen=True, eq=False)
class Theatre:
    """A simulated procedure before its images are made."""

    tissue: PosedTissue  # whose `apart` holds the pelvis alone
    device: Sequence[Solid]  # in CAD space
    poses: Poses  # true
    points: ReferencePoints
    camera: Camera
    binned: int  # rows and columns of the detector's pixels in one of `camera`
    step_mm: float
    model: XrayModel


def simulated_images(theatre: Theatre) -> Iterator[Drawn]:
    """All images of a procedure as the simulator makes them.

    Raises `InputError` for settings whose effect on the information is not known here.
    """
    model = theatre.model
    for key in ("motion_mm", "glare", "vignetting", "collimator_mm"):
        if getattr(model, key):
            raise InputError(f"bound: what `{key}: {getattr(model, key):g}` of the X-rays costs is not known here.")
    densities = [(solid.material, sharpened(solid.voxels(_DEVICE_MM))) for solid in theatre.device]
    for view in range(len(theatre.poses.camera_from_camera1)):
        yield from _of_view(theatre, view, densities)


def _of_view(theatre: Theatre, view: int, densities: Sequence[tuple[str, Volume]]) -> Iterator[Drawn]:
    camera, poses, step_mm = theatre.camera, theatre.poses, theatre.step_mm
    tissue = areal_posed_tissue(theatre.tissue, poses.camera_from(PELVIS)[view], camera, step_mm)
    centres = centres_in(poses, theatre.points, view)
    bones = {
        PELVIS: _shadow(theatre.tissue.apart[0], poses.camera_from(PELVIS)[view], camera, centres[PELVIS], step_mm),
        # the femur lies in the CT's space as the pelvis does
        FEMUR: _shadow(theatre.tissue.femur, poses.camera_from(FEMUR)[view], camera, centres[FEMUR], step_mm),
    }
    solids = [
        (material, _shadow(density, poses.camera_from(DEVICE)[view], camera, centres[DEVICE], step_mm))
        for material, density in densities
    ]
    on_device = together(*({material: shadow[0]} for material, shadow in solids))
    yield _of_image(theatre, view, ANATOMY_IMAGES, tissue, bones, [])
    yield _of_image(theatre, view, DEVICE_IMAGES, together(tissue, on_device), bones, solids)


def _of_image(
    theatre: Theatre,
    view: int,
    kind: str,
    areal: Mapping[str, Tensor],
    bones: Mapping[str, Tensor],
    solids: Sequence[tuple[str, Tensor]],
) -> Drawn:
    """Of `areal` (H, W) in g/cm², and shadows (10, H, W) of the objects that are shown."""
    camera, model, name = theatre.camera, theatre.model, image_name(kind, view)
    leaves = {material: mass.clone().requires_grad_() for material, mass in areal.items()}
    share = transmission(leaves, model)
    slopes = dict(zip(leaves, torch.autograd.grad(share.sum(), list(leaves.values())), strict=True))
    primary = share.detach()
    beam = open_beam(camera, model.inverse_square, model.heel, model.collimator_mm)
    if model.shutter_width_mm and model.shutter_height_mm:
        beam = beam * shutter(camera, model.shutter_width_mm, model.shutter_height_mm, model.shutter_deg)
    quanta = photons_per_pixel(model, camera)
    light, haze = quanta * beam, quanta * scattered(primary, model, camera, beam)
    expected = light * primary + haze
    instead = light * (slopes["bone"] - WATER_PER_BONE * slopes["water"])  # bone takes the place of soft tissue
    moving = {name: instead * shadow[1:] for name, shadow in bones.items()}
    changes = {f"{name} density": instead * shadow[:1] for name, shadow in bones.items()}
    for number, (material, shadow) in enumerate(solids, 1):
        darker = light * slopes[material]
        moving[DEVICE] = moving.get(DEVICE, 0) + darker * shadow[1:]
        changes[f"device part {number} density"] = darker * shadow[:1]
    filled = areal["water"] + WATER_PER_BONE * areal["bone"]
    changes |= {
        f"exposure {name}": expected[None],
        f"scatter {name}": haze[None],
        f"tissue {view + 1}": (light * slopes["water"] * filled)[None],
        f"tissue shape {view + 1}": light * primary * _waves(camera),
    }
    changes |= pose_changes(moving, theatre.poses, theatre.points, view)
    per_count = quanta / theatre.binned**2 / model.open_beam_counts  # photons of one digital value
    electronics = (model.electronic_noise * camera.pixel_mm[1] / theatre.binned) ** 2 + per_count**2 / 12
    return Drawn(kind, view, expected, expected + theatre.binned**2 * electronics, changes)


def drawn_images(
    scene: Scene, poses: Poses, points: ReferencePoints, step_mm: float, imaging: Imaging, photons: float
) -> list[Drawn]:
    """All images of a scene as the registration draws them, with so many photons on a pixel of the open beam."""
    found = []
    for kind, view in scene.there(scene.images, range(scene.views)):
        camera, name = scene.camera(poses, view), image_name(kind, view)
        centres, shadows = centres_in(poses, points, view), {}
        for thing in scene.shown(poses.camera1_from, kind):
            pose = poses.camera_from(thing)[view]
            shadows[thing] = 10 * _shadow(scene.objects[thing].volume, pose, camera, centres[thing], step_mm)
        light = photons * behind_tissue(scene, poses, view, camera, imaging)
        primary = light * torch.exp(-torch.stack([shadow[0] for shadow in shadows.values()]).sum(0))
        expected = primary + imaging.scatter * light
        changes = pose_changes({thing: -primary * shadow[1:] for thing, shadow in shadows.items()}, poses, points, view)
        changes |= {f"exposure {name}": expected[None], f"scatter {name}": light[None]}
        changes |= {f"{thing} density": -primary * shadow[:1] for thing, shadow in shadows.items()}
        found.append(Drawn(kind, view, expected, expected, changes))
    return found


def with_noise(scene: Scene, images: Sequence[Drawn], photons: float, generator: torch.Generator) -> Scene:
    """The scene with these images, attenuation of drawn numbers of photons, in place of its own."""
    attenuation: dict[str, list[Tensor | None]] = {kind: [None] * scene.views for kind in scene.images}
    for image in images:
        counts = torch.poisson(image.expected, generator=generator)
        attenuation[image.kind][image.view] = -(counts.clamp_min(0.5) / photons).log()
    return replace(scene, images={kind: tuple(of_views) for kind, of_views in attenuation.items()}, fields={})


def behind_tissue(scene: Scene, poses: Poses, view: int, camera: Camera, imaging: Imaging) -> Tensor:
    """Share (H, W) of the light that the soft tissue of a scene lets pass, as the registration draws it."""
    if not imaging.tissue or scene.tissue is None:
        return torch.ones(camera.shape)
    return torch.exp(-imaging.tissue * tissue_integrals(scene.tissue, poses.camera_from(scene.anchor)[view], camera))


def pose_changes(moving: Mapping[str, Tensor], poses: Poses, points: ReferencePoints, view: int) -> dict[str, Tensor]:
    """Changes (w, H, W) of an image by the unknown poses, and by the camera, from those (9, H, W) by its objects.

    The latter are by a twist of each object in the camera of the view, about its reference point, and by the
    intrinsics, as `project_with_jacobian` gives them. Poses are those of `error_responses`.
    """
    centres = centres_in(poses, points, view)
    turn = torch.block_diag(*[poses.camera_from_camera1[view, :3, :3]] * 2)
    found = {name: _by(planes[:6], turn) for name, planes in moving.items()}
    if view:
        anchor = centres[next(iter(poses.camera1_from))]
        found[view_block(view)] = sum(
            (_by(planes[:6], _carried(centres[name] - anchor)) for name, planes in moving.items()), torch.zeros(())
        )
    cameras = sum((planes[6:] for planes in moving.values()), torch.zeros(()))
    return found | {DISTANCE: cameras[:1], principal_block(view): cameras[1:]}


def _by(planes: Tensor, twists: Tensor) -> Tensor:
    """Changes (6, H, W) by unknown twists that give an object `twists` (6, 6) of its own."""
    return torch.tensordot(twists.T.to(planes.dtype), planes, 1)


def _carried(arm: Tensor) -> Tensor:
    """The twist (6, 6) of an object whose reference point lies at `arm` (3,) from the centre of another twist."""
    twist = torch.eye(6, dtype=torch.float64)
    twist[3:, :3] = -skew(arm)
    return twist


def _shadow(volume: Volume, pose: Tensor, camera: Camera, centre: Tensor, step_mm: float) -> Tensor:
    """Mass per area in g/cm² of a density in g/cm³, and its changes by twist and intrinsics: (10, H, W)."""
    image, changes = project_with_jacobian(volume, pose[None], camera, centre, step_mm, intrinsics=True)
    return torch.cat([image, changes[0].movedim(-1, 0)]) / 10  # mm · g/cm³ to g/cm²


def _waves(camera: Camera) -> Tensor:
    """Cosines (n, H, W) along rows and columns of the detector, of all lengths down to so many half waves."""
    rows, columns = (
        torch.cos(math.pi * torch.arange(_WAVES)[:, None] * (torch.arange(n) + 0.5) / n) for n in camera.shape
    )
    return (rows[:, None, :, None] * columns[None, :, None, :]).flatten(0, 1)[1:]  # the constant one is the exposure
