"""What a file or folder holds, in words and as a picture: `femoreg inspect`."""

from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import torch
from torch import Tensor

from femoreg_torch.anatomy import HIP, bone_of_name, fitting_tables
from femoreg_torch.case import RESULT_NAME, read_case, read_result
from femoreg_torch.case.models import BODIES_SUFFIXES
from femoreg_torch.case.reading import CASE_NAME
from femoreg_torch.errors import InputError
from femoreg_torch.fluoro import Frames, nearest_side, read_stored
from femoreg_torch.geometry import read_itk_transform
from femoreg_torch.intake.planes import Picture, three_planes
from femoreg_torch.intake.volumes import (
    ct_warnings,
    described,
    header_warnings,
    looks_like_labels,
)
from femoreg_torch.paths import check_readable
from femoreg_torch.volume import (
    Volume,
    body_names,
    has_names,
    is_in_ras,
    read_label_map,
    read_landmarks,
    read_mesh,
    read_volume_told,
    segment_names,
)
from femoreg_torch.volume.borders import cut_bones
from femoreg_torch.volume.dicom.headers import damaged_header, is_dicom
from femoreg_torch.volume.dicom.series import series_in, told_apart
from femoreg_torch.volume.mesh_files import bounds_of
from femoreg_torch.volume.segments import SEGMENTATION_SUFFIX

_VOLUMES = (".nii", ".nii.gz", ".nrrd", ".nhdr", ".mha", ".mhd", ".hdr")
_MESHES = (".stl", ".ply", ".obj", ".off", ".3mf", ".glb", ".step", ".stp")
_POINTS = (".fcsv", ".json", ".csv", ".tsv")
_TRANSFORMS = (".tfm", ".h5", ".mat")
_PICTURES = (".png", ".tif", ".tiff", ".jpg", ".jpeg", ".bmp")
_BY_ONE_FILE = ("case", "result")  # kinds of folders that one file makes what they are
_BESIDE_A_RESULT = ("errors.json", "navigation.json", "overlay.png", "replay.gif", "report.html", "review.json")
_TRUTH_NAME = "truth.json"
_LISTED = 40  # entries of a folder
_ALONE = (SEGMENTATION_SUFFIX, ".mrk.json", ".fcsv", *_MESHES, *_TRANSFORMS)  # not found among masks of bones
_TINTS = (
    (255, 90, 60),
    (60, 160, 255),
    (240, 220, 60),
    (180, 90, 220),
    (60, 220, 160),
    (255, 150, 210),
    (150, 230, 90),
)


@dataclass(frozen=True, eq=False)
class Findings:
    """What something is, facts and warnings in words, and a picture (H, W, 3), blue, green, red, if there is one."""

    kind: str
    facts: tuple[str, ...]
    warnings: tuple[str, ...] = ()
    picture: Picture | None = None


def inspect_path(path: Path, series: str | None = None) -> Findings:
    """What a file or a folder is; `series` chooses among several DICOM series. Raises `InputError`."""
    path = Path(path)
    check_readable(path, expected="file or folder")
    if path.is_dir():
        return _folder(path, series)
    if path.name == CASE_NAME:
        return _case(path)
    if path.name == RESULT_NAME:
        return _run(path.parent)
    if path.name in _BESIDE_A_RESULT and (path.parent / RESULT_NAME).is_file():
        return Findings(f"part of the result in {path.parent}", ("`femoreg inspect` of the folder tells more",))
    if path.name == _TRUTH_NAME and (path.parent / CASE_NAME).is_file():
        return Findings(
            f"known poses of the case in {path.parent}", ("`femoreg evaluate` compares a result with them",)
        )
    name = path.name.lower()
    kinds: tuple[tuple[tuple[str, ...], Callable[[Path], Findings]], ...] = (
        ((SEGMENTATION_SUFFIX,), _segmentation),
        (_VOLUMES, _volume_or_slice),
        (_POINTS, _points),
        (_MESHES, _mesh),
        (_TRANSFORMS, _transform),
        (_PICTURES, _image),
    )
    for suffixes, look in kinds:
        if name.endswith(suffixes):
            return look(path)
    if is_dicom(path):
        return _dicom_file(path)
    raise InputError(
        f"{path}: nothing that is known here. CTs, label maps, landmarks, meshes, transforms, images, cases are."
    )


def _folder(path: Path, series: str | None) -> Findings:
    kind = _kind_of(path)
    if kind == "case":
        return _case(path)
    if kind == "result":
        return _run(path)
    if kind == "masks of bones":
        return _segmentation(path)
    if kind in ("several things", "images"):
        return _listed(path, kind)
    there = series_in(path)
    if not there and any(entry.is_dir() for entry in _entries(path)):
        return _listed(path, "several things")
    if not there:
        raise InputError(f"{path}: holds no case.yaml, no DICOM files, no images and no masks of bones.")
    facts = told_apart(there) if there[1:] else [one.told for one in there]
    volumes = [one for one in there if one.may_be_volume]
    if series is None and len(volumes) != 1:
        if len(there) == 1 and there[0].modality == "SEG":
            return _segmentation(path)
        hint = "none of them is a volume; give one file to see an image"
        if volumes:
            hint = "choose one with --series: its number, its UID or a part of its name"
        return Findings("DICOM folder", (*facts, hint))
    found = _volume(path, series)
    return Findings("DICOM folder", (*facts, *found.facts), found.warnings, found.picture)


def _listed(folder: Path, kind: str) -> Findings:
    entries = _entries(folder)
    facts = [_in_short(entry) for entry in entries[:_LISTED]]
    if len(entries) > _LISTED:
        facts.append(f"and {len(entries) - _LISTED} more")
    return Findings(f"folder of {kind}", tuple(facts))


def _entries(folder: Path) -> list[Path]:
    return sorted(entry for entry in folder.iterdir() if not entry.name.startswith("."))


def _kind_of(folder: Path) -> str:
    """What a folder is, by the names in it."""
    if (folder / CASE_NAME).is_file():
        return "case"
    if (folder / RESULT_NAME).is_file():
        return "result"
    names = [entry.name.lower() for entry in _entries(folder)]
    if any(name.endswith(_ALONE) for name in names):
        return "several things"
    if volumes := [name for name in names if name.endswith(_VOLUMES)]:
        # a CT beside its label map is no folder of masks, and neither is called by a bone
        return "masks of bones" if any(_named_after_a_bone(name) for name in volumes) else "several things"
    if names and all(name.endswith(_PICTURES) for name in names):
        return "images"
    return "DICOM files"


def _named_after_a_bone(name: str) -> bool:
    ending = max((suffix for suffix in _VOLUMES if name.endswith(suffix)), key=len)
    return bone_of_name(HIP, name.removesuffix(ending)) is not None


def _in_short(entry: Path) -> str:
    """One line on what stands in a folder beside other things."""
    if entry.is_dir():
        kind = _kind_of(entry)
        if kind == "DICOM files":
            told = "; ".join(one.told for one in series_in(entry))
            nothing = "more folders" if any(inner.is_dir() for inner in _entries(entry)) else "nothing known here"
            return f"{entry.name}: folder, {told or nothing}"
        return f"{entry.name}: {'' if kind in _BY_ONE_FILE else 'folder of '}{kind}"
    try:
        found = inspect_path(entry)
    except InputError as error:
        return f"{entry.name}: {str(error).removeprefix(f'{entry}: ').rstrip('.')}"
    count = len(found.warnings)
    warned = f"; {count} warning{'s' * (count > 1)}, which `femoreg inspect` of it by itself tells" if count else ""
    return f"{entry.name}: {found.kind}, {found.facts[0].rstrip(':')}{warned}"


def _dicom_file(path: Path) -> Findings:
    with damaged_header(path):
        return _of_dicom(path)


def _of_dicom(path: Path) -> Findings:
    import pydicom

    header = pydicom.dcmread(path, stop_before_pixels=True, force=True)
    if header.get("Modality") == "SEG":
        return _segmentation(path)
    if header.get("Modality") == "CT":
        found = _volume(path)
        return Findings(f"slice of a {found.kind}", found.facts, found.warnings, found.picture)
    words = []
    for tag, told in (
        ("Modality", "modality"),
        ("DistanceSourceToDetector", "source to detector, mm"),
        ("ImagerPixelSpacing", "pixel spacing on the detector, mm"),
        ("PixelSpacing", "pixel spacing, mm"),
        ("PositionerPrimaryAngle", "primary angle, °"),
        ("PositionerSecondaryAngle", "secondary angle, °"),
        ("PhotometricInterpretation", "photometric interpretation"),
        ("NumberOfFrames", "frames"),
    ):
        words.append(f"{told}: {header[tag].value}" if tag in header else f"{told}: not told")
    several = int(header.get("NumberOfFrames") or 1) > 1
    found = _image(path, (1,) if several else None)
    if several:
        words.append("shown: the first frame; a case says which are meant, as `frames: 1` or `frames: mean`")
    return Findings("DICOM image", (*found.facts, *words), found.warnings, found.picture)


def _volume_or_slice(path: Path) -> Findings:
    """A volume, or a fluoroscopic image in a file of its kind."""
    try:
        return _volume(path)
    except InputError:
        with suppress(InputError):
            return _image(path)
        raise


def _volume(path: Path, series: str | None = None) -> Findings:
    volume, told = read_volume_told(path, series)
    warnings = [*told, *header_warnings(path)]
    if looks_like_labels(volume):
        named = path.is_file() and not is_dicom(path) and has_names(path)
        return _labels(volume, segment_names(path) if named else {}, path, warnings)
    low, high = (float(v) for v in volume.data.aminmax())
    facts = (described(volume), f"values from {low:g} to {high:g}")
    return Findings("CT", facts, (*warnings, *ct_warnings(volume)), three_planes(volume, None, {}, {}))


def _segmentation(path: Path) -> Findings:
    assert has_names(path)
    return _labels(read_label_map(path), segment_names(path), path, [])


def _labels(volume: Volume, names: Mapping[str, tuple[int, ...]], path: Path, warnings: list[str]) -> Findings:
    data = volume.data.to(torch.int32)
    counts = torch.bincount(data.flatten())
    ids = [n for n in counts.nonzero()[:, 0].tolist() if n]
    ml = float(np.prod(volume.spacing_mm)) / 1000
    name_of = {n: name for name, of in names.items() for n in of}
    listed = [f"{n}{f' {name_of[n]}' if n in name_of else ''} ({float(counts[n]) * ml:.0f} ml)" for n in ids]
    facts = [described(volume), f"labels: {', '.join(listed[:40])}{', …' if len(listed) > 40 else ''}"]
    table = {bone: n for n, name in name_of.items() if n in ids and (bone := bone_of_name(HIP, name))}
    if names:
        facts.append(f"bones by name: {', '.join(table) or 'none'}")
        if empty := [name for name, of in names.items() if not set(of) & set(ids)]:
            warnings.append(f"empty: {', '.join(empty)[:200]}")
        if not table:
            warnings.append(f"no part is named after a bone; known names are, say, {', '.join(HIP.bone_names)}")
    else:
        fitting = fitting_tables(ids)
        facts.append(f"shipped tables whose hip bones and femora are there: {', '.join(fitting) or 'none'}")
    whole = Volume(data, volume.lps_from_index)
    if path.name.lower().endswith(SEGMENTATION_SUFFIX):
        facts.append("3D Slicer saves the box of the segments alone; `femoreg check` tells which bones the CT cuts")
    else:
        warnings += cut_bones(whole, table, list(table))
    tints = {n: HIP.bone(b).colour for b, n in table.items() if b in HIP.bone_names}
    colours = {n: tints.get(n, _TINTS[k % len(_TINTS)]) for k, n in enumerate(ids)}
    shown = {n: f"{n} {name_of.get(n, '')}" for n in ids}
    return Findings("label map", tuple(facts), tuple(warnings), three_planes(None, whole, colours, {}, names=shown))


def _points(path: Path) -> Findings:
    points = read_landmarks(path, None)
    facts = [f"{name}: ({', '.join(f'{v:.2f}' for v in point.tolist())}) mm LPS" for name, point in points.items()]
    if not points.keys() & set(HIP.landmark_names):
        facts.append(f"none of these names is one of the landmarks {', '.join(HIP.landmark_names)}")
        return Findings("points", tuple(facts))
    try:
        marks = read_landmarks(path)
    except InputError as error:
        return Findings("points", tuple(facts), (f"not a file of landmarks alone: {str(error).rstrip('.')}",))
    missing = [name for name in HIP.landmark_names if name not in marks]
    if missing:
        facts.append(f"without {', '.join(missing)}")
    return Findings("landmarks of the hip", tuple(facts), tuple(_sides_of(marks)))


def _sides_of(marks: Mapping[str, Tensor]) -> list[str]:
    """In words, whether left landmarks lie to the right of right ones."""
    pairs = [(name, f"{name[:-1]}r") for name in marks if name.endswith("-l") and f"{name[:-1]}r" in marks]
    wrong = [left for left, right in pairs if marks[left][0] < marks[right][0]]
    if not wrong:
        return []
    return [f"{', '.join(wrong)} lie to the right of their partners: sides are swapped, or RAS and LPS mixed up"]


def _mesh(path: Path) -> Findings:
    mesh = read_mesh(path)
    low, high = mesh.bounds
    facts = [
        f"{len(mesh.faces)} triangles, closed, {abs(float(mesh.volume)) / 1000:.2f} ml",
        f"from ({', '.join(f'{v:.1f}' for v in low)}) to ({', '.join(f'{v:.1f}' for v in high)}) mm",
    ]
    if path.suffix.lower() in BODIES_SUFFIXES and len(bodies := body_names(path)) > 1:
        facts.append(f"bodies: {', '.join(bodies)}. A case may name the material of each under `parts`")
    warnings = []
    if is_in_ras(path):
        warnings.append("the file says RAS: 3D Slicer shows it turned against its coordinates. Export it anew as LPS")
    try:
        bounds_of([mesh], str(path))
    except InputError as error:
        warnings.append(str(error).rstrip("."))
    return Findings("mesh", tuple(facts), tuple(warnings))


def _transform(path: Path) -> Findings:
    pose = read_itk_transform(path)
    rows = [" ".join(f"{value:12.6f}" for value in row) for row in pose.tolist()]
    said = "takes points of a model to where 3D Slicer shows it under this transform, LPS mm:"
    return Findings("rigid transform of ITK or 3D Slicer", (said, *rows))


def _image(path: Path, frames: Frames | None = None) -> Findings:
    stored = read_stored(path, frames)
    image = stored.values
    low, high = (float(v) for v in image.aminmax())
    facts = [f"{image.shape[1]} × {image.shape[0]} pixels, values from {low:g} to {high:g}"]
    if stored.tags is not None and stored.tags.source_deg is not None:
        facts.append(f"the source stands on the patient's {nearest_side(stored.tags.source_deg)} side, by the header")
    warnings = [*stored.remarks, *([stored.asks] if stored.asks else [])]
    if len(image.unique()) <= 256:
        warnings.append(
            "at most 256 grey values: a picture made for a screen, whose logarithm may not be a line integral"
        )
    grey = ((image - low) / max(high - low, 1e-9) * 255).numpy().astype(np.uint8)
    shrink = min(1.0, 768 / max(grey.shape))
    picture = cv2.resize(grey, None, fx=shrink, fy=shrink, interpolation=cv2.INTER_AREA)
    return Findings("image", tuple(facts), tuple(warnings), np.repeat(picture[..., None], 3, 2))


def _case(path: Path) -> Findings:
    case = read_case(path)
    objects = ", ".join(case.objects)
    kinds = [", ".join(f"{kind}: {image.name}" for kind, image in view.images.items()) for view in case.views]
    facts = [
        f"{case.template or 'objects written out'}{f', operated side: {case.side}' if case.side else ''}",
        f"objects: {objects}",
        f"{len(case.landmarks)} landmarks, bones: {', '.join(case.bones) or 'none'}",
        *(f"view {number}: {told}" for number, told in enumerate(kinds, 1)),
        "`femoreg check` lists what is wrong with it",
    ]
    return Findings("case", tuple(facts))


def _run(folder: Path) -> Findings:
    result = read_result(folder)
    facts = [
        f"objects: {', '.join(result.poses.camera1_from)}; {len(result.poses.camera_from_camera1)} views",
        f"preset {result.preset}, seed {result.seed}" + ("" if result.case is None else f", of the case {result.case}"),
        result.verdict.sentence if result.verdict.trusted else "not trusted",
        "`femoreg evaluate`, `replay`, `navigate`, `review` and `slicer` go on from it",
    ]
    return Findings("result of a registration", tuple(facts), () if result.verdict.trusted else result.verdict.reasons)
