"""What single-view registration makes of a start pose: the first stages of a preset on one labelled image."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from torch import Tensor

from femoreg_torch.errors import InputError
from femoreg_torch.geometry import load_carm, transform_points
from femoreg_torch.registration import Plan, Scene, load_plan, run_plan
from femoreg_torch.registration.plan import Stage
from femoreg_torch.registration.prepare import anatomy_objects
from femoreg_torch.volume import read_ct, read_labels, read_landmarks
from sim.study.capture import first_stages
from training.measure import LabelledImage

_STRUCTURES = {"pelvis": (1, 2, 4), "femur_left": (5,), "femur_right": (6,)}
_CARM = "cios_fusion"  # of `sim.labelled_images`


def single_view_registration(folder: Path, preset: str) -> Callable[[LabelledImage, Tensor], Tensor]:
    """A function from an image and a start pose (4, 4) to the pose of the pelvis after the preset's first-view stages.

    `folder` holds ct.nii.gz, labels.nii.gz and landmarks.json of the patient. The femur that lies nearer to the middle
    of the image is drawn and registered with the pelvis.
    """
    ct = read_ct(folder / "ct.nii.gz")
    labels = read_labels(folder / "labels.nii.gz", ct)
    landmarks = read_landmarks(folder / "landmarks.json")
    heads = {"femur_left": landmarks["FH-l"], "femur_right": landmarks["FH-r"]}
    objects = {femur: anatomy_objects(ct, labels, _STRUCTURES, femur, head) for femur, head in heads.items()}
    carm, plan = load_carm(_CARM), first_stages(load_plan(preset))

    def register(image: LabelledImage, camera_from_ct: Tensor) -> Tensor:
        def off_axis(femur: str) -> float:
            return float(transform_points(camera_from_ct, heads[femur][None])[0, :2].norm())

        scene = Scene(
            replace(carm, camera=image.camera), objects[min(heads, key=off_axis)], {"anatomy": (image.attenuation,)}
        )
        binned = carm.camera.shape[0] // image.camera.shape[0]
        poses = run_plan(scene, _on_binned_images(plan, binned), camera_from_ct, 0, lambda *_: None).poses
        return poses.camera1_from["pelvis"]

    return register


def _on_binned_images(plan: Plan, factor: int) -> Plan:
    """The plan for images that are averaged over `factor` × `factor` pixels already."""

    def binned(stage: Stage) -> Stage:
        if stage.level.downsample % factor:
            raise InputError(f"step “{stage.name}”: downsample is not a multiple of the images' binning, {factor}.")
        return replace(stage, level=replace(stage.level, downsample=stage.level.downsample // factor))

    return replace(plan, steps=tuple(binned(step) for step in plan.steps if isinstance(step, Stage)))
