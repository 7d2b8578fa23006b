"""Procedures from behind the patient, stored in several ways, and from a side: from images to femur and device."""

from dataclasses import replace
from pathlib import Path

import pydicom
import pytest
import torch
import yaml
from pydicom.dataset import FileDataset, FileMetaDataset
from pydicom.uid import ExplicitVRLittleEndian, XRayAngiographicImageStorage
from torch import Tensor

from femoreg_torch.case import Case, Result, read_case, write_case
from femoreg_torch.case.femoroplasty import DEVICE, FEMUR, PELVIS
from femoreg_torch.evaluation import evaluate
from femoreg_torch.fluoro import Display, read_image
from femoreg_torch.geometry import project_points, transform_points
from femoreg_torch.registration.run import register_scene
from sim.theatre.case_folders import write_phantom, write_simulation

_CARM = {"sdd_mm": 1020, "pixel_mm": [0.388, 0.388], "shape": [768, 768], "isocentre_mm": [0, 0, 690]}
_SAME_MM = 0.1


@pytest.fixture(scope="module")
def simulated(tmp_path_factory: pytest.TempPathFactory) -> Case:
    """Six images with the source behind the patient, as the source sees them."""
    folder = tmp_path_factory.mktemp("behind")
    write_phantom(folder / "patient", 31, "left", 1.0)
    (folder / "carm.yaml").write_text(yaml.safe_dump(_CARM | {"orbit_axis": [0, 1, 0]}), encoding="utf-8")
    settings = {"extends": "paper", "carm": str(folder / "carm.yaml")}
    # the device stands beyond the patient, between him and the detector
    orbit = {"acquisition": {"orbit_deg": [[180, 0], [190, 3], [165, 3]], "device_depth_mm": 820}}
    (folder / "sim.yaml").write_text(yaml.safe_dump(settings | orbit), encoding="utf-8")
    write_simulation(folder / "patient", folder / "case", 5, "left", str(folder / "sim.yaml"), lambda _: None)
    return read_case(folder / "case")


def write_dicom(path: Path, pixels: Tensor, photometric: str, **tags: object) -> Path:
    meta = FileMetaDataset()
    meta.MediaStorageSOPClassUID, meta.MediaStorageSOPInstanceUID = XRayAngiographicImageStorage, "1.2.3"
    meta.TransferSyntaxUID = ExplicitVRLittleEndian
    dataset = FileDataset(str(path), {}, file_meta=meta, preamble=b"\0" * 128)
    stored = pixels if photometric == "MONOCHROME2" else 65535 - pixels
    content = {
        "SOPClassUID": meta.MediaStorageSOPClassUID,
        "SOPInstanceUID": "1.2.3",
        "Modality": "XA",
        "Rows": pixels.shape[0],
        "Columns": pixels.shape[1],
        "SamplesPerPixel": 1,
        "PhotometricInterpretation": photometric,
        "BitsAllocated": 16,
        "BitsStored": 16,
        "HighBit": 15,
        "PixelRepresentation": 0,
        "PixelData": stored.round().to(torch.int32).numpy().astype("<u2").tobytes(),
    }
    for name, value in (content | tags).items():
        setattr(dataset, name, value)
    pydicom.dcmwrite(path, dataset)
    return path


def stored(case: Case, folder: Path, display: Display, photometric: str, binning: int) -> Case:
    """The case as a C-arm that shows and bins its pictures so would have left it, with what its header says."""
    folder.mkdir()
    camera = case.carm.camera.downsampled(binning)
    turned = display.stored_camera(camera)
    tags = {
        "DistanceSourceToDetector": camera.sdd_mm,
        "ImagerPixelSpacing": list(turned.pixel_mm),
        "PositionerPrimaryAngle": {"posterior": 0, "right": 90}[display.source],  # of the detector, from the front
    }
    views = []
    for number, view in enumerate(case.views):
        paths = {}
        for kind, path in view.images.items():
            image = torch.nn.functional.avg_pool2d(read_image(path)[None], binning)[0]
            name = folder / f"view{number}_{kind}.dcm"
            paths[kind] = write_dicom(name, display.to_stored(image), photometric, **tags)
        views.append(replace(view, images=paths, intensity=None))
    carm = replace(case.carm, camera=camera)
    write_case(folder, replace(case, folder=folder, carm=carm, views=tuple(views), display=display))
    return read_case(folder)


def moved_mm(case: Case, one: Result, other: Result) -> float:
    """By how much entry point and tip lie elsewhere in the frame of the first view."""
    assert case.plan is not None
    places = {FEMUR: case.plan.entry_point, DEVICE: case.objects[DEVICE].points["tip"]}
    poses = [result.poses.camera1_from for result in (one, other)]
    apart = [
        transform_points(poses[0][name], point[None]) - transform_points(poses[1][name], point[None])
        for name, point in places.items()
    ]
    return max(float(step.norm()) for step in apart)


@pytest.mark.long
def test_a_procedure_from_behind_is_found_however_it_is_stored(simulated: Case, tmp_path: Path) -> None:
    forms = {
        "usual": (Display("posterior"), "MONOCHROME2", 1),
        "turned": (Display("posterior", mirrored=True, turned_deg=270), "MONOCHROME1", 1),
        "binned": (Display("posterior", turned_deg=180), "MONOCHROME2", 2),
    }
    found = {}
    for name, form in forms.items():
        case = stored(simulated, tmp_path / name, *form)
        result, scene = register_scene(case, None, "fast", seed=0)
        errors = evaluate(case, result, scene)
        assert result.verdict.trusted, result.verdict.sentence
        assert errors["entry_point_mm"] < 0.5
        assert errors["tip_mm"] < 0.5
        found[name] = result
    apart = {name: moved_mm(simulated, found["usual"], found[name]) for name in ("turned", "binned")}
    assert max(apart.values()) < _SAME_MM


@pytest.mark.long
def test_a_first_view_from_a_side_starts_from_landmarks_picked_by_hand(tmp_path: Path) -> None:
    write_phantom(tmp_path / "patient", 31, "left", 1.0)
    carm = _CARM | {"isocentre_mm": [0, 0, 640], "orbit_axis": [0, 1, 0]}
    (tmp_path / "carm.yaml").write_text(yaml.safe_dump(carm), encoding="utf-8")
    orbit = {"orbit_deg": [[95, 3], [122, 2], [68, 2]], "head_depth_mm": 660, "device_depth_mm": 600}
    settings = {"extends": "paper", "carm": str(tmp_path / "carm.yaml"), "acquisition": orbit}
    (tmp_path / "sim.yaml").write_text(yaml.safe_dump(settings), encoding="utf-8")
    write_simulation(tmp_path / "patient", tmp_path / "case", 5, "left", str(tmp_path / "sim.yaml"), lambda _: None)
    case = stored(read_case(tmp_path / "case"), tmp_path / "stored", Display("right"), "MONOCHROME2", 1)
    assert case.truth is not None
    camera, points = case.carm.camera, torch.stack(list(case.landmarks.values()))
    seen = project_points(camera, transform_points(case.truth.camera1_from[PELVIS], points))
    seen = seen + 3 * torch.randn(seen.shape, generator=torch.Generator().manual_seed(0), dtype=seen.dtype)
    inside = ((seen > 0) & (seen < camera.shape[0])).all(1)
    pixels = case.display.pixels_to_stored(seen, camera)
    picked = {name: pixel for name, pixel, there in zip(case.landmarks, pixels, inside, strict=True) if there}
    result, scene = register_scene(case, None, "fast", seed=0, landmarks=picked)
    errors = evaluate(case, result, scene)
    assert result.verdict.trusted, result.verdict.sentence
    assert errors["entry_point_mm"] < 1
    assert errors["tip_mm"] < 1
