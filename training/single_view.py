"""What single-view registration makes of a start pose: the first stages of a preset on one labelled image."""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

from torch import Tensor

from femoreg_torch.anatomy import HIP
from femoreg_torch.case.femoroplasty import ANATOMY_IMAGES, PELVIS, femoral_head, femoroplasty_objects
from femoreg_torch.case.model import Side
from femoreg_torch.geometry import load_carm, transform_points
from femoreg_torch.registration import Scene, load_plan, run_plan
from femoreg_torch.registration.prepare.bones import ct_objects
from femoreg_torch.volume import BoneLabels, Volume
from sim.labelled.patient_folders import find_patient, read_patient
from sim.study.capture import first_stages
from training.labelled import LabelledImage
from training.measure import Registration

_CARM = "cios_fusion"  # of `sim.labelled.image_files`
_SIDES: tuple[Side, ...] = ("left", "right")


def single_view_registration(folder: Path, preset: str) -> Registration:
    """The `registration_of` the patient in `folder`, see `sim.labelled.patient_folders`. Raises `InputError`."""
    patient = read_patient(find_patient(folder))
    return registration_of(patient.ct, patient.bones, patient.landmarks, preset)


def registration_of(ct: Volume, bones: BoneLabels, landmarks: Mapping[str, Tensor], preset: str) -> Registration:
    """A function from an image and a start pose (4, 4) to the pose of the pelvis after the preset's first-view stages.

    The femur that lies nearer to the middle of the image is drawn and registered with the pelvis. `ct` is in HU,
    `landmarks` (3,) in LPS mm.
    """
    heads = {side: landmarks[femoral_head(side)] for side in _SIDES}
    objects = {
        side: ct_objects(ct, bones, list(femoroplasty_objects(side, head, None).values()), HIP, (ANATOMY_IMAGES,))
        for side, head in heads.items()
    }
    carm, plan = load_carm(_CARM), first_stages(load_plan(preset))

    def register(image: LabelledImage, camera_from_ct: Tensor) -> Tensor:
        def off_axis(side: Side) -> float:
            return float(transform_points(camera_from_ct, heads[side][None])[0, :2].norm())

        scene = Scene(
            replace(carm, camera=image.camera),
            objects[min(_SIDES, key=off_axis)],
            {ANATOMY_IMAGES: (image.attenuation,)},
        )
        return run_plan(scene, plan, camera_from_ct, 0, lambda *_: None).poses.camera1_from[PELVIS]

    return register
