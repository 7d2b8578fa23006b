"""Pelvis and both femora in a fixed biplane: objects of one's own in `case.yaml`, C-arm poses known.

The patient is synthetic, the images are simulated (line integrals of the whole CT with its femora turned, and noise).
"""

import sys
import tempfile
from pathlib import Path
from typing import Any

import torch
import yaml
from torch import Tensor

import femoreg_torch as femoreg
from femoreg_torch.anatomy import HIP
from femoreg_torch.fluoro import write_image
from femoreg_torch.geometry import about_point, exp_so3, pose_difference, project_points, rigid, transform_points
from femoreg_torch.registration.prepare.bones import read_bones
from femoreg_torch.registration.prepare.reference import reference_point
from femoreg_torch.volume import hu_to_attenuation, structure_attenuation, write_landmarks, write_volume
from sim.patient import make_patient

CARM = {"sdd_mm": 1020, "pixel_mm": [0.776, 0.776], "shape": [384, 384]}
CASE: dict[str, Any] = {
    "version": 2,
    "anatomy": "hip",
    "ct": {"image": "ct.nii.gz", "labels": "labels.nii.gz", "bones": "femoreg"},
    "landmarks": "landmarks.json",
    "objects": {
        "pelvis": {"bones": "pelvis", "start": "landmarks"},
        "femur_left": {"bones": "femur_left", "reference": "FH-l", "start": {"beside": "pelvis"}},
        "femur_right": {"bones": "femur_right", "reference": "FH-r", "start": {"beside": "pelvis"}},
    },
    "carm": CARM,
    "views": [{"image": "frontal.tif"}, {"image": "oblique.tif"}],
}
HEADS = {"femur_left": "FH-l", "femur_right": "FH-r"}


def write_case(folder: Path) -> femoreg.Poses:
    """A synthetic patient with both femora turned, seen from two sides; returns the true poses."""
    patient = make_patient(seed=2, spacing_mm=2.0)
    write_volume(folder / "ct.nii.gz", patient.ct)
    write_volume(folder / "labels.nii.gz", patient.labels)
    write_landmarks(folder / "landmarks.json", patient.landmarks)
    camera = femoreg.Camera(1020.0, (0.776, 0.776), (384, 384), (191.5, 191.5))

    middle = (patient.landmarks["FH-l"] + patient.landmarks["FH-r"]) / 2
    ap = torch.tensor([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]], dtype=torch.float64)  # the source in front of the patient
    pelvis = rigid(ap, torch.tensor([0.0, 20.0, 740.0], dtype=torch.float64) - ap @ middle)
    turns = {"femur_left": (0.05, -0.04, 0.03), "femur_right": (-0.06, 0.03, 0.05)}
    placed = {
        name: pelvis
        @ about_point(rigid(exp_so3(torch.tensor(turn, dtype=torch.float64))), patient.landmarks[HEADS[name]])
        for name, turn in turns.items()
    }
    axis = torch.tensor([0.0, torch.pi / 3, 0.0], dtype=torch.float64)  # the second tube stands 60° further
    oblique = about_point(rigid(exp_so3(axis)), torch.tensor([0.0, 0.0, 740.0], dtype=torch.float64))
    truth = femoreg.Poses(torch.stack([torch.eye(4, dtype=torch.float64), oblique]), {"pelvis": pelvis, **placed})

    content = dict(CASE, views=[dict(view) for view in CASE["views"]])
    content["views"][1]["camera_from_camera1"] = oblique.tolist()
    for view, name in enumerate(("frontal.tif", "oblique.tif")):
        write_image(folder / name, photograph(patient, truth, view, camera))
    (folder / "case.yaml").write_text(yaml.safe_dump(content, sort_keys=False), encoding="utf-8")
    return truth


def photograph(patient: Any, truth: femoreg.Poses, view: int, camera: femoreg.Camera) -> Tensor:
    """Counts (H, W) uint16 of one view: all that is no femur moves with the pelvis."""
    remaining = patient.ct.with_data(hu_to_attenuation(patient.ct.data.float(), -1000.0))
    volumes, poses = [], []
    for bone in HEADS:
        (label,) = HIP.classes([bone])
        femur = structure_attenuation(patient.ct, patient.labels, [label], grow_voxels=1, offset_hu=50.0)
        low = (torch.linalg.inv(remaining.lps_from_index) @ femur.lps_from_index[:, 3]).round().int().tolist()
        depth, height, width = femur.data.shape
        remaining.data[low[2] : low[2] + depth, low[1] : low[1] + height, low[0] : low[0] + width] -= femur.data
        volumes.append(femur)
        poses.append(truth.camera_from(bone)[view])
    integrals = femoreg.project(
        [remaining, *volumes], torch.stack([truth.camera_from("pelvis")[view], *poses])[None], camera, step_mm=0.7
    )[0]
    generator = torch.Generator().manual_seed(view)
    return torch.poisson(60_000 * (-0.75 * integrals).exp(), generator=generator).clamp(1, 65535).to(torch.uint16)


def pixels_of(case: femoreg.Case, truth: femoreg.Poses) -> dict[str, Tensor]:
    """Landmarks as a person would pick them in the first image: 2 mm off on the detector."""
    generator = torch.Generator().manual_seed(7)
    camera = case.carm.camera
    points = transform_points(truth.camera1_from["pelvis"], torch.stack(list(case.landmarks.values())))
    seen = project_points(camera, points)
    picked = seen + 2 / camera.pixel_mm[0] * torch.randn(seen.shape, generator=generator, dtype=torch.float64)
    return dict(zip(case.landmarks, picked, strict=True))


def main(folder: Path) -> dict[str, Any]:
    """Make the case, register it, and return the errors of each bone."""
    truth = write_case(folder)
    case = femoreg.read_case(folder)
    result = femoreg.register(case, "rigid", landmarks=pixels_of(case, truth))
    print(result.verdict.sentence)
    errors = {}
    bones = read_bones(case)[1]
    for name, pose in result.poses.camera1_from.items():
        point = reference_point(case, name, bones)
        deg, mm = pose_difference(truth.camera1_from[name], pose, point)
        errors[name] = {"mm": mm, "deg": deg}
        print(f"{name}: {mm:.2f} mm, {deg:.2f}°")
    return errors


if __name__ == "__main__":
    if len(sys.argv) > 1:
        out = Path(sys.argv[1])
        out.mkdir(parents=True, exist_ok=True)
        main(out)
    else:
        with tempfile.TemporaryDirectory() as temporary:
            main(Path(temporary))
