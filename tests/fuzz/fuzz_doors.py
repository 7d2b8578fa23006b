"""Every door by which a file comes in: a valid one, small, and what reads it."""

import json
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import h5py
import numpy as np
import pydicom
import SimpleITK as sitk
import torch
import trimesh
import yaml
from femoreg_torch.configs import load_preset
from pydicom.dataset import FileDataset, FileMetaDataset
from pydicom.uid import ExplicitVRLittleEndian, XRayAngiographicImageStorage
from safetensors.torch import save_file

from femoreg_torch.anatomy import HIP, label_table, load_anatomy
from femoreg_torch.beads import read_beads
from femoreg_torch.beads.given import read_marks
from femoreg_torch.case import read_case, read_result
from femoreg_torch.case.start_files import read_pixels, read_start_poses
from femoreg_torch.detect import load_network
from femoreg_torch.fluoro import read_image
from femoreg_torch.geometry import centred_camera, load_carm, read_itk_transform
from femoreg_torch.navigation import read_robot
from femoreg_torch.neighbours.deepfluoro import (
    is_full_resolution,
    read_pictures,
    read_preprocessed,
    read_specimen,
    specimens,
)
from femoreg_torch.neighbours.xreg import read_projections
from femoreg_torch.planning.report import CEMENT_NAME, read_plan
from femoreg_torch.planning.settings import load_planning
from femoreg_torch.registration.plan import load_plan
from femoreg_torch.registration.prepare.scene import prepare_scene
from femoreg_torch.volume import read_ct, read_label_map, read_landmarks, read_mesh
from femoreg_torch.volume.mesh_files import read_bodies
from femoreg_torch.volume.segments import segment_names
from models.kinds import NETWORKS
from models.weights import Weights, save_weights
from sim.labelled.deepfluoro import load_dataset_settings
from sim.labelled.image_files import read_labelled
from sim.labelled.settings import load_labelled_settings
from sim.patient.around_surfaces.surfaces import BONES, read_surfaces
from sim.study.protocol import load_protocol
from sim.theatre.settings import load_simulation
from training.checkpoints import read_checkpoint
from training.settings import read_settings

EYE = np.eye(4).tolist()
AT_600 = [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 600], [0, 0, 0, 1]]


@dataclass(frozen=True)
class Door:
    """One file that is broken, and what is then called; `content` where it is YAML or JSON."""

    name: str
    path: Path
    read: Callable[[], Any]
    content: Any = None

    @property
    def as_json(self) -> bool:
        return self.path.suffix == ".json"


def doors(folder: Path) -> list[Door]:
    """All doors, their valid files written below `folder`."""
    found: list[Door] = []
    for make in (_case, _whole, _points, _volumes, _images, _meshes, _presets, _networks, _others, _hdf5):
        (folder / make.__name__).mkdir()
        found += make(folder / make.__name__)
    return found


def _text(path: Path, content: Any) -> Any:
    text = json.dumps(content) if path.suffix == ".json" else yaml.safe_dump(content, sort_keys=False)
    path.write_text(text, encoding="utf-8")
    return content


def _case(folder: Path) -> Iterator[Door]:
    for name in ("ct.nii.gz", "labels.nii.gz", "device.stl", "a.tif", "a_device.tif", "b.tif", "wire.stl"):
        (folder / name).write_bytes(b"some")
    points = {name: [float(n), 10.0 * n, -5.0] for n, name in enumerate(HIP.landmark_names)}
    _text(folder / "landmarks.json", {"space": "LPS", "unit": "mm", "landmarks": points})
    truth = _text(
        folder / "truth.json",
        {"camera_from_pelvis": [AT_600, EYE], "camera1_from_femur": AT_600, "camera1_from_device": AT_600},
    )
    short = {
        "version": 2,
        "template": "femoroplasty",
        "side": "left",
        "ct": {"image": "ct.nii.gz", "labels": "labels.nii.gz", "bones": "totalsegmentator_v2"},
        "landmarks": "landmarks.json",
        "plan": {"entry_point": [1.0, 2.0, 3.0], "target": "FH"},
        "device": {
            "model": "device.stl",
            "hu": 5000,
            "points": {"tip": [0.0, 0.0, 9.0], "base": [0.0, 0.0, 0.0], "center": [0.0, 0.0, 4.0]},
            "camera1_from_device": AT_600,
        },
        "carm": "cios_fusion",
        "views": [
            {"anatomy": "a.tif", "device": "a_device.tif"},
            {"anatomy": "b.tif", "intensity": "log", "field": {"circle": {"centre": [5, 5], "radius": 4}}},
        ],
        "truth": "truth.json",
    }
    objects = {
        "version": 2,
        "ct": {"image": "ct.nii.gz", "labels": "labels.nii.gz", "bones": {"tibia": 3, "fibula": [4, 9]}},
        "landmarks": "landmarks.json",
        "anatomy": "hip",
        "objects": {
            "wire": {
                "parts": [{"model": "wire.stl", "material": "steel"}, {"model": "device.stl", "hu": 100}],
                "points": {"tip": [0.0, 0.0, 9.0], "base": [0.0, 0.0, 0.0]},
                "reference": "tip",
                "images": ["wire"],
                "start": {"camera1_from": AT_600},
            },
            "clamp": {"model": "wire.stl", "hu": 9000, "start": {"beside": "wire", "beside_from_object": EYE}},
        },
        "plan": {"object": "wire", "entry_point": [1, 2, 3], "target": "tip", "tool": "wire"},
        "carm": {
            "sdd_mm": 1100, "pixel_mm": [0.3, 0.3], "shape": [64, 64], "principal_point_px": [31, 32],
            "orbit_axis": [0, 1, 0], "uncertainty": {"sdd_percent": 1},
        },
        "views": [{"images": {"plain": "a.tif", "wire": "b.tif"}, "field": {"polygon": [[0, 0], [9, 0], [9, 9]]}}],
    }  # fmt: skip
    del objects["ct"], objects["anatomy"]
    first = {**short, "version": 1, "ct": {**short["ct"], "structures": {"pelvis": [1, 2], "femur_left": [5]}}}
    del first["template"], first["ct"]["bones"]
    for name, content in (("short", short), ("objects", objects), ("version 1", first)):
        yield _own_folder(folder, f"case, {name}", "case.yaml", content, read_case)
    (folder / "case.yaml").write_text(yaml.safe_dump(short), encoding="utf-8")
    yield Door("truth", folder / "truth.json", lambda: read_case(folder), truth)
    yield _written(
        "label table",
        folder / "t.yaml",
        lambda: label_table(folder / "t.yaml"),
        {"anatomy": "hip", "bones": {"hip_left": 1}},
    )
    beads = {
        "objects": {"wire": {"points": "beads.json", "diameter_mm": 1.5, "noise_mm": 0}},
        "image_noise_px": 0.5,
        "views": "all",
    }
    spots = {f"b{n}": [float(n), float(n * n), 3.0 * (n % 3)] for n in range(6)}
    _text(folder / "beads.json", {"space": "LPS", "unit": "mm", "landmarks": spots})
    hip = read_case(folder / "case, objects")
    yield _written("beads", folder / "beads.yaml", lambda: read_beads(folder / "beads.yaml", hip), beads)
    table = "image,bead,column_px,row_px\na.tif,b1,3.5,4.5\nb.tif,,7,8\n"
    yield _bytes("bead table", folder / "marks.csv", table.encode(), lambda path: read_marks(path, list(spots), hip))


def _whole(folder: Path) -> Iterator[Door]:
    """A case whose files are all there, small, opened as `femoreg register` opens them before it computes."""
    draw = np.random.default_rng(0)
    voxels = draw.integers(-900, 40, (40, 40, 40)).astype(np.int16)
    labels = np.zeros((40, 40, 40), np.uint8)
    for n, bone in enumerate((slice(4, 12), slice(14, 22), slice(26, 36)), 1):
        labels[bone, 8:30, 8:30] = n
    voxels[labels > 0] = 700
    for name, array in (("ct", voxels), ("labels", labels)):
        sitk.WriteImage(sitk.GetImageFromArray(array), str(folder / f"{name}.nii.gz"))
    trimesh.creation.box((6.0, 4.0, 20.0)).export(folder / "device.stl")
    for name in ("a", "a_device", "b", "b_device"):
        cv2.imwrite(str(folder / f"{name}.tif"), draw.integers(500, 4000, (48, 64), dtype=np.uint16))
    height = {"hip_left": 8.0, "hip_right": 18.0, "femur_left": 31.0, "femur_right": 31.0}
    points = {mark.name: [8.0 + n, 20.0, height[mark.bone]] for n, mark in enumerate(HIP.landmarks)}
    _text(folder / "landmarks.json", {"space": "LPS", "unit": "mm", "landmarks": points})
    content = {
        "version": 2,
        "template": "femoroplasty",
        "side": "left",
        "ct": {
            "image": "ct.nii.gz",
            "labels": "labels.nii.gz",
            "bones": {"hip_left": 1, "hip_right": 2, "femur_left": 3},
        },
        "landmarks": "landmarks.json",
        "plan": {"entry_point": [10.0, 20.0, 30.0], "target": "FH"},
        "device": {
            "model": "device.stl",
            "hu": 5000,
            "points": {"tip": [0.0, 0.0, 9.0], "base": [0.0, 0.0, -9.0], "center": [0.0, 0.0, 0.0]},
            "camera1_from_device": AT_600,
        },
        "carm": {"sdd_mm": 1000, "pixel_mm": [4.0, 4.0], "shape": [48, 64]},
        "views": [{"anatomy": "a.tif", "device": "a_device.tif"}, {"anatomy": "b.tif", "device": "b_device.tif"}],
    }

    def read() -> Any:
        return prepare_scene(read_case(folder))

    yield Door("whole case", folder / "case.yaml", read, _text(folder / "case.yaml", content))
    for name in ("ct.nii.gz", "labels.nii.gz", "a.tif", "device.stl", "landmarks.json"):
        yield Door(f"whole case, {name}", folder / name, read)


def _own_folder(parent: Path, name: str, file: str, content: Any, read: Callable[[Path], Any]) -> Door:
    """A door of a file in a copy of the folder `parent`."""
    folder = parent / name
    folder.mkdir()
    for other in parent.iterdir():
        if other.is_file():
            (folder / other.name).write_bytes(other.read_bytes())
    _text(folder / file, content)
    return Door(name, folder / file, lambda: read(folder), content)


def _written(name: str, path: Path, read: Callable[[], Any], content: Any) -> Door:
    return Door(name, path, read, _text(path, content))


def _bytes(name: str, path: Path, content: bytes, read: Callable[[Path], Any]) -> Door:
    path.write_bytes(content)
    return Door(name, path, lambda: read(path))


def _made(name: str, path: Path, read: Callable[[Path], Any]) -> Door:
    return Door(name, path, lambda: read(path))


def _points(folder: Path) -> Iterator[Door]:
    names = HIP.landmark_names[:5]
    plain = {"space": "LPS", "unit": "mm", "landmarks": {name: [1.0, 2.0, 3.5] for name in names}}
    yield Door(
        "landmarks", folder / "p.json", lambda: read_landmarks(folder / "p.json"), _text(folder / "p.json", plain)
    )
    controls = [{"id": "1", "label": name, "position": [1.0, 2.0, 3.0], "positionStatus": "defined"} for name in names]
    markup = {
        "@schema": "https://x#",
        "markups": [{"type": "Fiducial", "coordinateSystem": "LPS", "controlPoints": controls}],
    }
    path = folder / "p.mrk.json"
    yield Door("landmarks, mrk.json", path, lambda: read_landmarks(path), _text(path, markup))
    head = "# Markups fiducial file version = 4.11\n# CoordinateSystem = LPS\n# columns = id,x,y,z,ow,ox,oy,oz,vis,sel,"
    head += "lock,label,desc,associatedNodeID\n"
    rows = "".join(f"{n},1.0,2.0,3.0,0,0,0,1,1,1,0,{name},,\n" for n, name in enumerate(names))
    yield _bytes("landmarks, fcsv", folder / "p.fcsv", (head + rows).encode(), read_landmarks)
    rows = "".join(f"a.tif,{name},10.5,20.0,0.9,1\n" for name in names)
    table = f"image,landmark,column_px,row_px,confidence,visible\n{rows}"
    yield _bytes("landmarks, csv", folder / "p.csv", table.encode(), read_pixels)
    start = {"camera_from_pelvis": [AT_600, AT_600], "camera1_from_femur": AT_600}
    yield Door("start", folder / "s.json", lambda: read_start_poses(folder / "s.json"), _text(folder / "s.json", start))
    robot = "# of the robot\nbase_from_device\n1 0 0 500\n0 1 0 0\n0 0 1 0\n0 0 0 1\n"
    yield _bytes("calibration", folder / "r.txt", robot.encode(), lambda path: read_robot(path, "device"))
    transform = sitk.Euler3DTransform()
    transform.SetTranslation((100.0, 0.0, 900.0))
    for suffix in ("tfm", "h5", "mat"):
        sitk.WriteTransform(transform, str(folder / f"base_from_device.{suffix}"))
    yield _made("calibration, tfm", folder / "base_from_device.tfm", lambda path: read_robot(path, "device"))
    for suffix in ("h5", "mat"):
        yield _made(f"transform, {suffix}", folder / f"base_from_device.{suffix}", read_itk_transform)


def _volumes(folder: Path) -> Iterator[Door]:
    draw = np.random.default_rng(0)
    ct = sitk.GetImageFromArray(draw.integers(-1000, 1500, (6, 7, 8)).astype(np.int16))
    ct.SetSpacing((2.0, 2.0, 3.0))
    labels = sitk.GetImageFromArray(draw.integers(0, 4, (6, 7, 8)).astype(np.uint8))
    for suffix in ("nii", "nii.gz", "mha", "nrrd", "mhd"):
        sitk.WriteImage(ct, str(folder / f"ct.{suffix}"), useCompression=suffix == "nrrd")
        yield _made(f"CT, {suffix}", folder / f"ct.{suffix}", read_ct)
    sitk.WriteImage(sitk.Cast(ct, sitk.sitkFloat32), str(folder / "float.nii.gz"))
    yield _made("CT, float", folder / "float.nii.gz", read_ct)
    for suffix in ("nii.gz", "mha", "nrrd"):
        sitk.WriteImage(labels, str(folder / f"labels.{suffix}"))
        yield _made(f"labels, {suffix}", folder / f"labels.{suffix}", read_label_map)
    for n, name in enumerate(("hip_left", "femur")):
        labels.SetMetaData(f"Segment{n}_Name", name)
        labels.SetMetaData(f"Segment{n}_LabelValue", str(n + 1))
        labels.SetMetaData(f"Segment{n}_Layer", "0")
    sitk.WriteImage(labels, str(folder / "s.seg.nrrd"))
    yield _made("segmentation", folder / "s.seg.nrrd", segment_names)
    series = folder / "series"
    series.mkdir()
    for z in range(3):
        pixels = draw.integers(0, 2500, (5, 6)).astype(np.uint16)
        _dicom(
            series / f"{z}.dcm", pixels, Modality="CT", SeriesInstanceUID="1.2.9", StudyInstanceUID="1.2.8",
            SOPInstanceUID=f"1.2.{z + 1}", ImagePositionPatient=[0, 0, 2.0 * z], InstanceNumber=z,
            ImageOrientationPatient=[1, 0, 0, 0, 1, 0], PixelSpacing=[1.0, 1.0], RescaleSlope=1, RescaleIntercept=-1000,
            SliceThickness=2.0,
        )  # fmt: skip
    yield Door("DICOM series", series / "1.dcm", lambda: read_ct(series))


def _dicom(path: Path, pixels: np.ndarray, **fields: object) -> None:
    meta = FileMetaDataset()
    meta.MediaStorageSOPClassUID = XRayAngiographicImageStorage
    meta.MediaStorageSOPInstanceUID = "1.2.3"
    meta.TransferSyntaxUID = ExplicitVRLittleEndian
    dataset = FileDataset(str(path), {}, file_meta=meta, preamble=b"\0" * 128)
    settings = {
        "SOPClassUID": meta.MediaStorageSOPClassUID, "SOPInstanceUID": "1.2.3", "Rows": pixels.shape[0],
        "Columns": pixels.shape[1], "SamplesPerPixel": 1, "PhotometricInterpretation": "MONOCHROME2",
        "BitsAllocated": 16, "BitsStored": 12, "HighBit": 11, "PixelRepresentation": 0, "PixelData": pixels.tobytes(),
    } | fields  # fmt: skip
    for name, value in settings.items():
        setattr(dataset, name, value)
    pydicom.dcmwrite(path, dataset)


def _images(folder: Path) -> Iterator[Door]:
    pixels = np.random.default_rng(0).integers(0, 4000, (12, 10), dtype=np.uint16)
    for suffix in ("png", "tif"):
        cv2.imwrite(str(folder / f"view.{suffix}"), pixels)
        yield _made(f"image, {suffix}", folder / f"view.{suffix}", read_image)
    for suffix in ("mha", "nii.gz", "nrrd"):
        sitk.WriteImage(sitk.GetImageFromArray(pixels), str(folder / f"view.{suffix}"))
        yield _made(f"image, {suffix}", folder / f"view.{suffix}", read_image)
    _dicom(folder / "view.dcm", pixels)
    yield _made("image, DICOM", folder / "view.dcm", read_image)
    np.save(folder / "view.npy", pixels)
    yield _made("image, npy", folder / "view.npy", read_image)


def _meshes(folder: Path) -> Iterator[Door]:
    box = trimesh.creation.box((20.0, 10.0, 60.0))
    for suffix in ("stl", "ply", "obj", "off", "glb", "3mf"):
        box.export(folder / f"box.{suffix}")
        yield _made(f"mesh, {suffix}", folder / f"box.{suffix}", read_mesh)
    box.export(folder / "text.stl", file_type="stl_ascii")
    yield _made("mesh, STL as text", folder / "text.stl", read_mesh)
    yield _made("mesh, bodies", folder / "box.3mf", lambda path: read_bodies(path, ["a"]))


_READERS: Mapping[str, Callable[[str], Any]] = {
    "registration/fast": load_plan,
    "registration/paper": load_plan,
    "carm/cios_fusion": load_carm,
    "simulation/paper": load_simulation,
    "simulation/labelled": load_labelled_settings,
    "simulation/deepfluoro": load_dataset_settings,
    "training/hip14": read_settings,
    "study/paper": load_protocol,
    "study/conditions": load_protocol,
    "planning/default": load_planning,
    "anatomy/hip": load_anatomy,
}


def _presets(folder: Path) -> Iterator[Door]:
    for name, read in _READERS.items():
        path = folder / f"{name.replace('/', '_')}.yaml"
        content = load_preset(*name.split("/"))
        yield Door(f"preset, {name}", path, lambda read=read, path=path: read(str(path)), _text(path, content))


def _networks(folder: Path) -> Iterator[Door]:
    settings = {
        "classes": 1 + len(HIP.bones),
        "landmarks": len(HIP.landmarks),
        "channels": (2, 2),
        "convolutions": (1, 1),
    }
    network = NETWORKS["multitask_unet"](**settings).build()
    save_weights(folder / "w.safetensors", Weights("multitask_unet", settings, "hip", 1.25, network.state_dict()), {})
    yield _made("weights", folder / "w.safetensors", load_network)
    torch.save({"state_dict": network.state_dict(), "global_step": 3}, folder / "last.ckpt")
    yield _made("checkpoint", folder / "last.ckpt", read_checkpoint)
    n, marks = 2, len(HIP.landmarks)
    tensors = {
        "images": torch.ones((n, 8, 8), dtype=torch.uint16), "labels": torch.zeros((n, 4, 4), dtype=torch.uint8),
        "landmarks": torch.zeros(n, marks, 2), "landmarks_lps": torch.zeros(marks, 3).double(),
        "camera_from_lps": torch.eye(4).double().repeat(n, 1, 1), "device": torch.zeros(n, dtype=torch.bool),
        "camera_from_femur": torch.eye(4).double().repeat(n, 2, 1, 1), "one_hip": torch.zeros(n, dtype=torch.bool),
        "hips": torch.zeros((2, 2, 2), dtype=torch.uint8), "lps_from_hips": torch.eye(4).double(),
        "xray": torch.zeros(n, 1).double(),
    }  # fmt: skip
    camera = {"sdd_mm": 1000.0, "pixel_mm": [1.0, 1.0], "shape": [8, 8], "principal_point_px": [3.5, 3.5]}
    metadata = {"source": "x", "camera": json.dumps(camera), "xray": '["kvp"]'}
    save_file(tensors, folder / "views.safetensors", metadata=metadata)
    yield _made("measure file", folder / "views.safetensors", read_labelled)


def _result() -> dict[str, Any]:
    """What `femoreg register` writes, of two views and two objects."""
    view = {"view": 1, "similarity": 0.4, "gain": 0.02, "pull_mm": [0.1, -0.2]}
    quality = {
        "views": [view, {**view, "view": 2}], "in_plane_uncertainty_mm": 0.1, "common_pull": [0.02, 0.3],
        "rotation_deviation_deg": [0.1, 0.2, 0.3], "translation_deviation_mm": [0.1, 0.2, 0.4],
        "displacement": [1.0, 2.0], "trusted": True, "reason": "all views agree",
    }  # fmt: skip
    moment = {"evaluations": 1, "cost": 0.5, "camera1_from": {"device": EYE}}
    change = {"sdd_factor": 1.0, "principal_point_shift_mm": [0.0, 0.1]}
    stage = {
        "name": "all together", "view": None, "cost": 0.3, "evaluations": 12, "seconds": 1.5, "stop": "small step",
        "restarts": [{"cost": 0.01, "apart_deg": 2.0, "apart_mm": 3.0}], "camera_from_camera1": [EYE, EYE],
        "camera1_from": {"femur": AT_600, "device": AT_600}, "moments": [moment],
    }  # fmt: skip
    mark = {"pixel": [10.5, 20.25], "confidence": 0.9, "visible": True, "used": True}
    return {
        "version": 2, "camera_from_femur": [AT_600, AT_600], "camera1_from_device": AT_600, "femur_from_device": EYE,
        "carm_refined": [change, change], "points_camera1": {"entry_point": [1.0, 2.0, 3.0], "tip": [1.0, 2.0, 4.0]},
        "directions_camera1": {"path": [0.0, 0.0, 1.0], "guide": [0.0, 0.6, 0.8]},
        "quality": {"femur": quality, "device": quality}, "trusted": True, "reasons": [], "doubts": [],
        "skipped": ["there are no lateral images"], "stages": [stage],
        "start": {"source": "landmarks", "landmarks": {"FH-l": mark}, "camera1_from_femur": AT_600},
        "timings_s": {"total": 9.5}, "preset": "fast", "seed": 3, "versions": {"torch": "2"},
        "errors": {"relative_mm": 0.1}, "case": "../case",
    }  # fmt: skip


def _others(folder: Path) -> Iterator[Door]:
    run = folder / "run"
    run.mkdir()
    result = _result()
    yield Door("result", run / "result.json", lambda: read_result(run), _text(run / "result.json", result))
    plan = {
        "settings": load_preset("planning", "default"), "case": "../case", "baseline": {"yield_load_n": 1000.0},
        "plan": {"entry_point": [0.0, 1.0, 2.0], "target": [3.0, 4.0, 5.0]}, "planned": {"yield_load_n": 2000.0},
        "injections": [], "side": "left",
    }  # fmt: skip
    sitk.WriteImage(sitk.Image(3, 3, 3, sitk.sitkUInt8), str(folder / CEMENT_NAME))
    yield Door("plan", folder / "plan.json", lambda: read_plan(folder), _text(folder / "plan.json", plan))
    box = trimesh.creation.box((60.0, 50.0, 90.0))
    arrays = {f"{bone}_{part}": getattr(box, part) for bone in BONES for part in ("vertices", "faces")}
    np.savez(folder / "bones.npz", **arrays)
    yield _made("surfaces", folder / "bones.npz", read_surfaces)


def _hdf5(folder: Path) -> Iterator[Door]:
    """Both layouts of the DeepFluoro data set, and xReg's projections, small."""
    draw = np.random.default_rng(0)
    intrinsic, pose = np.diag([-500.0, -500.0, 1.0]), np.eye(4)
    intrinsic[:2, 2] = 60.0
    pose[2, 3] = -700.0
    with h5py.File(folder / "full.h5", "w") as file:
        for name, value in {
            "extrinsic": np.eye(4), "intrinsic": intrinsic, "num-cols": 120, "num-rows": 120,
            "pixel-col-spacing": 2.0, "pixel-row-spacing": 2.0,
        }.items():  # fmt: skip
            file[f"proj-params/{name}"] = value
        for name in ("vol", "vol-seg/image"):
            file[f"a/{name}/dir-mat"], file[f"a/{name}/origin"] = np.eye(3), np.zeros((3, 1))
            file[f"a/{name}/spacing"] = np.ones((3, 1))
            file[f"a/{name}/pixels"] = np.ones((4, 5, 6), np.float32)
        file["a/vol-landmarks/FH-l"] = np.ones((3, 1))
        one = file.create_group("a/projections/000")
        one["image/pixels"] = draw.integers(100, 60000, (120, 120)).astype(np.float32)
        one["gt-landmarks/FH-l"] = np.ones((2, 1))
        one["gt-poses/cam-to-pelvis-vol"], one["gt-poses/pelvis-good-fov"] = np.linalg.inv(pose), 1
        one["gt-seg/pixels"], one["rot-180-for-up"] = np.zeros((120, 120), np.uint8), 1

    def all_of(path: Path) -> Any:
        is_full_resolution(path)
        return [(read_specimen(path, name), list(read_pictures(path, name))) for name in specimens(path)]

    yield _made("DeepFluoro, full", folder / "full.h5", all_of)
    with h5py.File(folder / "ds.h5", "w") as file:
        file["land-names/num-lands"], file["land-names/land-00"] = 1, "FH-l"
        file["01/projs"] = draw.random((2, 45, 45), np.float32)
        file["01/segs"], file["01/lands"] = np.zeros((2, 45, 45), np.uint8), np.zeros((2, 2, 1), np.float32)
    detector = centred_camera(1020.0, (0.4, 0.4), (820, 820))
    yield _made("DeepFluoro, preprocessed", folder / "ds.h5", lambda path: list(read_preprocessed(path, detector)))
    with h5py.File(folder / "proj.h5", "w") as file:
        file["num-projs"] = 1
        cam = file.create_group("proj-000/cam")
        cam["intrinsic"], cam["extrinsic"], cam["num-rows"], cam["num-cols"] = intrinsic, np.eye(4), 12, 10
        cam["row-spacing"], cam["col-spacing"] = 2.0, 2.0
        cam["cam-coord-frame-type"] = "origin-at-focal-pt-det-neg-z"
        file["proj-000/img/pixels"] = np.ones((12, 10), np.float32)
        file["proj-000/landmarks/FH-l"], file["proj-000/rot-to-pat-up"] = np.ones((2, 1)), 180
    yield _made("xReg projections", folder / "proj.h5", read_projections)
