"""What is worth knowing, and worth a warning, of a CT and of a label map."""

import re
from pathlib import Path
from typing import Any

import nibabel
import numpy as np
import torch

from femoreg_torch.arrays import opened
from femoreg_torch.volume import Volume
from femoreg_torch.volume.borders import touched_faces
from femoreg_torch.volume.contradictions import intercept_twice
from femoreg_torch.volume.nifti import NIFTI_SUFFIXES
from femoreg_torch.volume.text_headers import META_SUFFIXES, NRRD_SUFFIXES

_COARSE_MM, _COARSE_STEP_MM = 1.5, 3.0  # the registration takes voxels of 1 mm
_LEAST_LONG_MM, _MOST_LONG_MM = 80.0, 2500.0  # the longest edge: more than a femoral head with its neck; a whole body
_SOFT_HU, _BONE_HU, _METAL_HU = -50.0, 300.0, 2800.0
_LEAST_AIR = 0.005  # share of the voxels; beside every patient there is some
_METAL_ML = 1.0
_MOST_PADDING_HU = -3100.0
_SPACES_WITHOUT_A_PATIENT = tuple(
    name + time for name in (b"scanner-xyz", b"3d-right-handed", b"3d-left-handed") for time in (b"", b"-time")
)  # NRRD format, section 5.1
_HEADER = 2**16  # bytes that hold that of an NRRD file or MetaImage
_META_MATRIX = re.compile(rb"^(TransformMatrix|Rotation|Orientation)[ \t]*=", re.MULTILINE)
_META_LETTERS = re.compile(rb"^AnatomicalOrientation[ \t]*=[ \t]*([A-Za-z]{3})[ \t\r]*$", re.MULTILINE)
_LPS_BY_LETTERS = b"RAI"  # MetaImage names the sides that axes come from


def described(volume: Volume) -> str:
    """Size, spacing and orientation in one line."""
    size = " × ".join(str(n) for n in reversed(volume.data.shape))
    spacing = " × ".join(f"{s:.4g}" for s in volume.spacing_mm)
    cosines = volume.lps_from_index[:3, :3] / torch.tensor(volume.spacing_mm, dtype=torch.float64)
    turned = float(torch.rad2deg(torch.arccos(((cosines.trace() - 1) / 2).clamp(-1, 1))))
    low = ", ".join(f"{v:.1f}" for v in volume.lps_from_index[:3, 3].tolist())
    axes = "along the patient's axes" if turned < 0.05 else f"oblique by {turned:.1f}°"
    return f"{size} voxels of {spacing} mm, {axes}, first voxel at ({low}) mm LPS"


def ct_warnings(ct: Volume) -> list[str]:
    """In words, what may spoil a registration with this CT, HU."""
    told = []
    x, y, z = ct.spacing_mm
    longest = max(n * mm for n, mm in zip(ct.data.shape[::-1], ct.spacing_mm, strict=True))
    if not _LEAST_LONG_MM <= longest <= _MOST_LONG_MM:
        told.append(
            f"voxels of {x:.3g} × {y:.3g} × {z:.3g} mm make a CT that is {longest:.0f} mm long at most, which is no "
            "hip's: is their size in mm?"
        )
    _, within, between = sorted(ct.spacing_mm)  # slices may lie along any axis
    if within > _COARSE_MM or between > _COARSE_STEP_MM:
        told.append(f"coarse voxels ({x:.3g} × {y:.3g} × {z:.3g} mm): outlines of bones get blurred; 1 mm is meant")
    low, high = (float(v) for v in ct.data.aminmax())
    if low > _SOFT_HU or high < _BONE_HU:
        told.append(f"values from {low:g} to {high:g} are not HU of a hip: air is −1000, bone above {_BONE_HU:g}")
        return told
    if (dark := intercept_twice(ct)) is not None:
        told.append(dark)
    elif low == 0 or high > 60000 or low < _MOST_PADDING_HU:
        filled = low <= _MOST_PADDING_HU and float((ct.data < -1100).float().mean()) == float(
            (ct.data == low).float().mean()
        )
        told.append(
            f"values from {low:g} to {high:g}: what lies outside the scanner's circle seems to be filled with {low:g}"
            if filled
            else f"values from {low:g} to {high:g}: is the rescale of the scanner applied?"
        )
    air = float((ct.data < -500).float().mean())
    if air < _LEAST_AIR:
        told.append("hardly any air: the CT seems to be cropped inside the patient, so soft tissue is missing")
    metal = float((ct.data > _METAL_HU).sum()) * float(np.prod(ct.spacing_mm)) / 1000
    if metal > _METAL_ML:
        told.append(f"{metal:.1f} ml above {_METAL_HU:g} HU: metal, or its artefacts")
    for face in touched_faces(ct.data > _BONE_HU, least_mm2=400.0, spacing=ct.spacing_mm):
        if face in ("right", "left", "front", "back"):
            told.append(f"bone is cut at the {face} face of the CT")
    return told


def looks_like_labels(volume: Volume) -> bool:
    """Whether the values are few whole numbers from 0 on, as those of a label map are."""
    low, high = (float(v) for v in volume.data.aminmax())
    if low != 0 or high == 0 or high > 65535:
        return False
    sample = volume.data.flatten()[:: max(1, volume.data.numel() // 2_000_000)]
    return bool((sample == sample.round()).all()) and len(sample.unique()) <= 256


def header_warnings(path: Path) -> list[str]:
    """In words, where the header of a volume leaves open where the patient's left is, or contradicts itself."""
    if path.name.lower().endswith(META_SUFFIXES):
        return _of_meta_image(path)
    if path.name.lower().endswith(NRRD_SUFFIXES):
        with opened(path) as file:
            header = file.read(_HEADER).partition(b"\n\n")[0]
        told = re.search(rb"^space:[ \t]*(.*?)[ \t\r]*$", header, re.MULTILINE | re.IGNORECASE)
        if told is None:
            return ["the NRRD header names no `space`: its axes are assumed to run to the left, back and head"]
        if told[1].lower() in _SPACES_WITHOUT_A_PATIENT:
            return [
                f"the NRRD header names the `space` {told[1].decode()}, which says nothing of a patient: its axes are "
                "assumed to run to the left, back and head"
            ]
        return []
    if not path.name.lower().endswith(NIFTI_SUFFIXES):
        return []
    image: Any = nibabel.load(path)  # its declared type is that of all formats
    header = image.header
    codes = int(header["sform_code"]), int(header["qform_code"])
    if codes == (0, 0):
        return [
            "the NIfTI header has neither sform nor qform: its axes are taken to run to the left, back and head, as "
            "ITK and 3D Slicer take them; by the standard they run to the right, front and head"
        ]
    if min(codes) == 0:
        return []
    try:
        header.get_qform()
    except ValueError:  # a quaternion that is none
        return ["the qform of the NIfTI header is damaged, its sform was taken; other programs may take the first"]
    return []


def _of_meta_image(path: Path) -> list[str]:
    """ITK passes over AnatomicalOrientation, and without a matrix takes axes to run to the left, back and head."""
    with opened(path) as file:
        header = file.read(_HEADER).partition(b"ElementDataFile")[0]
    letters = _META_LETTERS.search(header)
    named = None if letters is None else letters[1].upper()
    if _META_MATRIX.search(header) or named == _LPS_BY_LETTERS:
        return []
    said = "" if named is None else f", and its AnatomicalOrientation, {named.decode()}, is passed over"
    return [
        "the MetaImage header has no `TransformMatrix`: its axes are assumed to run to the left, back and head" + said
    ]
