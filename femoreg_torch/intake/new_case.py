"""A case folder made of the files that scanner, 3D Slicer, TotalSegmentator and C-arm leave: `femoreg new-case`."""

import re
import shutil
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, cast

import torch
import yaml
from torch import Tensor

from femoreg_torch.anatomy import HIP, LabelTable, label_table, label_table_names
from femoreg_torch.case.femoroplasty import (
    ANATOMY_IMAGES,
    DEVICE,
    DEVICE_END,
    DEVICE_IMAGES,
    DEVICE_POINTS,
    FEMUR,
    TEMPLATE,
    femoral_head,
    operated_femur,
)
from femoreg_torch.case.model import Intensity, Side
from femoreg_torch.case.nominal import ALONG_PATH, NominalPlace
from femoreg_torch.case.reading import CASE_NAME, VERSIONS
from femoreg_torch.case.writing import display_content
from femoreg_torch.errors import InputError
from femoreg_torch.files import new_folder, plain, write_text
from femoreg_torch.fluoro import (
    Display,
    Exposure,
    Source,
    carm_settings,
    may_be_image,
    nearest_side,
    other_patient,
    read_header,
)
from femoreg_torch.geometry import read_itk_transform
from femoreg_torch.intake.check import check_case
from femoreg_torch.intake.label_tables import table_of_map
from femoreg_torch.intake.volumes import header_warnings
from femoreg_torch.paths import why_unreadable
from femoreg_torch.segment import load_bone_network, propose_landmarks, segment_bones
from femoreg_torch.volume import (
    Volume,
    bone_labels,
    is_in_ras,
    patient_of,
    read_ct_told,
    read_labels_told,
    read_landmarks,
    read_mesh,
    read_path_points,
    write_landmarks,
    write_volume,
)
from femoreg_torch.volume.bones import nearest_label
from femoreg_torch.volume.dicom.headers import is_dicom
from femoreg_torch.volume.itk import DETACHED, read_itk
from femoreg_torch.volume.reading import write_image

NEEDED = ("ct", "labels", "landmarks", "plan", "images")
_COPIED = (".nii", ".nii.gz", ".nrrd", ".mha")  # volumes of one file, which are taken as they are
_OWN_TABLE = "femoreg"  # of label maps that are made here
_SAID_BY = {  # what a problem asks to write into `case.yaml`, and the options that write it
    "`display:": "--source, --mirrored, --turned or --ignore-header",
    "`frames:": "--frames",
    "`intensity:": "--intensity",
    "`carm:": "--carm",
}
_DEVICE_HU = 5000.0  # of the paper's device


@dataclass(frozen=True)
class NewCase:
    """What a case is made of; what is None or empty was not given. See the command's help."""

    ct: Path | None = None
    series: str | None = None
    labels: Path | None = None
    bones: str | None = None
    landmarks: Path | None = None
    plan: Path | None = None
    side: Side | None = None
    device: Path | None = None
    device_points: Path | None = None
    material: str | None = None
    hu: float | None = None
    guide: str | None = None
    before_entry_mm: float = 0.0
    turned_deg: float = 0.0
    in_front_mm: float = 0.0
    device_transform: Path | None = None
    images: tuple[Path, ...] = ()
    device_images: tuple[Path, ...] = ()
    carm: str | None = None
    intensity: Intensity | None = None
    frames: int | Literal["mean"] | None = None
    source: Source | None = None
    mirrored: bool = False
    turned: int = 0
    ignore_header: bool = False
    segment: bool = False  # labels and landmarks that are not given are found in the CT


def make_case(out: Path, given: NewCase) -> list[str]:
    """Make the case folder `out`, which must not be there yet, and return what was assumed or done, in words.

    Raises `InputError` that lists everything that is missing or wrong; then nothing is written.
    """
    out = Path(out)
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise InputError(f"{out}: is there already. Choose a new name for the case.")
    _check_given(given)
    notes: list[str] = []
    with new_folder(out) as folder:
        content = _content(folder, given, notes)
        text = yaml.safe_dump(plain(content), sort_keys=False, default_flow_style=None, width=120, allow_unicode=True)
        write_text(folder / "case.yaml", text)
        checked = check_case(folder, find_start=False)
        if checked.problems:
            sources = _sources(content, given)
            told = [_as_given(problem, folder, sources).replace(str(folder), str(out)) for problem in checked.problems]
            flags = [flag for key, flag in _SAID_BY.items() if any(key in problem for problem in told)]
            hint = f" To new-case, this is said by {', '.join(flags)}." if flags else ""
            raise InputError(_together(f"{out}: not written", told) + hint)
        notes += checked.warnings
    return notes


def _sources(content: dict[str, Any], given: NewCase) -> dict[str, Path]:
    """The files given, by the names that the case has for those that are read first when it is checked."""
    views = content["views"]
    sources = {view["anatomy"]: path for view, path in zip(views, _files(given.images, []), strict=True)}
    if given.device is not None:
        sources[content[DEVICE]["model"]] = given.device
        sources |= {view[DEVICE]: path for view, path in zip(views, _files(given.device_images, []), strict=False)}
    return sources


def _as_given(problem: str, folder: Path, sources: dict[str, Path]) -> str:
    """The problem with the files given in place of their copies in `folder`, which are not kept, nor is its form."""
    problem = re.sub(rf"\b({CASE_NAME}), line \d+", r"\1", problem)
    copies = rf"({re.escape(str(folder))}/)?\b({'|'.join(map(re.escape, sources))})(?!\w)"
    return re.sub(copies, lambda found: str(sources[found[2]]) if found[1] else _short(sources[found[2]]), problem)


def _check_given(given: NewCase) -> None:
    """Raises `InputError` for all flags that are missing, and files that are not there, at once."""
    found = ("labels", "landmarks") if given.segment else ()
    offer = {"labels": " (--segment finds the bones in the CT)", "landmarks": " (--segment proposes them)"}
    told = [
        f"--{name} is missing{offer.get(name, '')}" for name in NEEDED if name not in found and not getattr(given, name)
    ]
    paths = {name: getattr(given, name) for name in ("ct", "labels", "landmarks", "plan", "device", "device_points")}
    for name, path in {**paths, "device_transform": given.device_transform}.items():
        if path is not None and (why := why_unreadable(Path(path), expected="file or folder")) is not None:
            told.append(f"--{name.replace('_', '-')}: {path}: {why}")
    for flag, images in (("images", given.images), ("device-images", given.device_images)):
        wrong = ((path, why_unreadable(path, expected="file or folder")) for path in images)
        told += [f"--{flag}: {path}: {why}" for path, why in wrong if why is not None]
    if given.device is not None and given.device_points is None:
        told.append("--device-points is missing: the device's tip and base")
    if given.device is None and (given.device_images or given.device_points):
        told.append("--device is missing, the model that --device-images or --device-points are of")
    if given.material is not None and given.hu is not None:
        told.append("--material and --hu are both given: keep one")
    if given.guide is not None and given.device_transform is not None:
        told.append("--guide and --device-transform are both given: keep one")
    if told:
        raise InputError(_together("new-case", told))


def _together(what: str, told: list[str]) -> str:
    if len(told) == 1:
        return f"{what}: {told[0]}"
    return f"{what}, {len(told)} problems: " + " ".join(f"({n}) {one}" for n, one in enumerate(told, 1))


def _content(folder: Path, given: NewCase, notes: list[str]) -> dict[str, Any]:
    """What `case.yaml` is to hold; the files it names are copied into `folder`."""
    assert given.ct is not None  # seen by `_check_given`, as the others
    assert given.plan is not None
    ct, told = read_ct_told(given.ct, given.series)
    notes += told
    given_landmarks = None if given.landmarks is None else read_landmarks(given.landmarks)
    entry_point, target = read_path_points(given.plan)
    if given.labels is None:
        bones, (labels_name, labels) = label_table(_OWN_TABLE), _segmented(folder, ct, notes)
    else:
        bones, more = table_of_map(given.labels, given.bones)
        notes += more
        labels_name, labels = _labels(folder, given.labels, ct, bones, notes)
    landmarks = given_landmarks or _proposed(labels, ct, bones, notes)
    side = given.side or _side(labels, ct, bones, landmarks, entry_point, header_warnings(given.ct), notes)
    if femoral_head(side) not in landmarks:
        raise InputError(
            f"{given.landmarks or '--segment'}: {femoral_head(side)}, the head of the operated femur, is "
            "missing. Place it in 3D Slicer, in the centre of the head."
        )
    write_landmarks(folder / "landmarks.json", landmarks)
    content: dict[str, Any] = {
        "version": VERSIONS[-1],
        "template": TEMPLATE,
        "side": side,
        "ct": {"image": _ct(folder, given.ct, ct), "labels": labels_name, "bones": _told_bones(bones)},
        "landmarks": "landmarks.json",
        "plan": {"entry_point": entry_point, "target": "FH" if target is None else target},
    }
    if target is None:
        notes.append("the path's target is the femoral head, as the plan has no other")
    if given.device is not None:
        content[DEVICE] = _device(folder, given, notes)
    images, device_images = _files(given.images, notes), _files(given.device_images, notes)
    notes += _other_patient(given, images, device_images)
    content["carm"] = _carm(folder, given, images[0], notes)
    content |= _display(given, images, notes)
    content["views"] = _views(folder, images, device_images, given, notes)
    return content


def _segmented(folder: Path, ct: Volume, notes: list[str]) -> tuple[str, Volume]:
    """The name of the label map of the bones that the network finds in the CT, and the map."""
    found = segment_bones(ct, load_bone_network())
    write_volume(folder / "labels.nii.gz", found.labels)
    sure = ", ".join(f"{bone} {share:.2f}" for bone, share in found.confidence.items())
    notes.append(f"the bones were found in the CT by the shipped network (mean probability: {sure}): look at them")
    notes += found.warnings
    return "labels.nii.gz", found.labels


def _proposed(labels: Volume, ct: Volume, bones: LabelTable, notes: list[str]) -> dict[str, Tensor]:
    """Landmarks by the rules of `femoreg landmarks`."""
    found = propose_landmarks(ct, bone_labels(labels, ct, bones, HIP, {}))
    errors = ", ".join(f"{name} {error:.1f}" for name, error in found.expected_error_mm.items())
    notes.append(
        f"the landmarks are proposals by rules, with errors to expect of (mm) {errors}: correct landmarks.json"
    )
    notes += [f"no {name}: {why}" for name, why in found.left_out.items()]
    notes += found.warnings
    return found.points


def _ct(folder: Path, path: Path, ct: Volume) -> str:
    if path.is_file() and path.name.lower().endswith(_COPIED):
        return _copied(path, folder, "ct")
    write_volume(folder / "ct.nii.gz", ct)
    return "ct.nii.gz"


def _copied(path: Path, folder: Path, stem: str) -> str:
    """Copy a file under a name that says what it is, and return that name.

    A header whose values stand in a file of their own is written together with them.
    """
    if path.name.lower().endswith(DETACHED):
        write_image(folder / f"{stem}.mha", read_itk(path))
        return f"{stem}.mha"
    suffix = next((s for s in (".seg.nrrd", ".nii.gz") if path.name.lower().endswith(s)), path.suffix.lower())
    name = stem + (suffix or ".dcm")
    shutil.copyfile(path, folder / name)
    return name


def _told_bones(bones: LabelTable) -> str | dict[str, list[int]]:
    for name in label_table_names():
        if label_table(name) == bones:
            return name
    return {bone: list(ids) for bone, ids in bones.items()}


def _labels(folder: Path, path: Path, ct: Volume, bones: LabelTable, notes: list[str]) -> tuple[str, Volume]:
    """The name of the label map in `folder`, and the map on the grid of the CT."""
    ids = {n for of_bone in bones.values() for n in of_bone}
    labels, told = read_labels_told(path, ct, ids)
    if path.is_file() and path.name.lower().endswith(_COPIED):
        return _copied(path, folder, "labels"), labels  # what was done is done again, and told, whenever it is read
    notes += told
    write_volume(folder / "labels.nii.gz", labels)
    return "labels.nii.gz", labels


def _side(
    labels: Volume,
    ct: Volume,
    bones: LabelTable,
    landmarks: dict[str, Tensor],
    entry_point: Tensor,
    doubts: list[str],
    notes: list[str],
) -> Side:
    """The side whose femur the entry point lies on. Raises `InputError` if it lies on none, with `doubts` of the CT."""
    found = bone_labels(labels, ct, bones, HIP, landmarks)
    sides = {found.ids[operated_femur(side)]: side for side in ("left", "right") if operated_femur(side) in found.ids}
    label = nearest_label(found.labels, list(sides), entry_point) if sides else None
    if label is None:
        where = ", ".join(f"{v:.1f}" for v in entry_point.tolist())
        raise InputError(
            f"--side: is missing, and the entry point ({where}) mm LPS lies on no femur of the label map. Give the "
            "side, and check the plan's coordinate system (RAS or LPS)."
            + "".join(f" Of the CT, {doubt}." for doubt in doubts)
        )
    notes.append(f"the operated side is the {sides[label]} one, as the entry point lies on its femur")
    return cast(Side, sides[label])


def _device(folder: Path, given: NewCase, notes: list[str]) -> dict[str, Any]:
    assert given.device is not None
    assert given.device_points is not None
    if is_in_ras(given.device):
        raise InputError(
            f"{given.device}: says that it is in RAS, so points and transforms of 3D Slicer do not fit its values. "
            "Export it from 3D Slicer anew, with the coordinate system LPS."
        )
    points = read_landmarks(given.device_points, (*DEVICE_POINTS, DEVICE_END))
    if missing := [name for name in ("tip", "base") if name not in points]:
        raise InputError(f"{given.device_points}: lacks {' and '.join(missing)}. Name the points so in 3D Slicer.")
    if "center" not in points:
        points["center"] = torch.tensor(read_mesh(given.device).bounds.mean(0), dtype=torch.float64)
        notes.append("errors of the device are told at the middle of its box, as no point `center` is given")
    content: dict[str, Any] = {"model": _copied(given.device, folder, DEVICE)}
    if given.material is not None:
        content["material"] = given.material
    else:
        content["hu"] = _DEVICE_HU if given.hu is None else given.hu
        if given.hu is None:
            notes.append(f"the device is drawn with {_DEVICE_HU:g} HU, as neither --material nor --hu is given")
    content["points"] = points
    if given.device_transform is not None:
        return content | {f"{FEMUR}_from_{DEVICE}": read_itk_transform(given.device_transform)}
    place = NominalPlace(given.guide or ALONG_PATH, given.before_entry_mm, given.turned_deg, given.in_front_mm)
    if given.guide is None:
        mm, where = abs(given.before_entry_mm), "past" if given.before_entry_mm < 0 else "before"
        notes.append(f"the device starts {ALONG_PATH}, its tip {mm:g} mm {where} the entry point")
    return content | {"start": vars(place)}


def _files(paths: tuple[Path, ...], notes: list[str]) -> list[Path]:
    """The files themselves, and the images of folders, by name: numbers in names count as numbers."""
    found: list[Path] = []
    for path in paths:
        if not path.is_dir():
            found.append(path)
            continue
        files = [entry for entry in path.rglob("*") if entry.is_file() and not entry.name.startswith(".")]
        images = [entry for entry in files if may_be_image(entry)]
        found += sorted(images, key=_counted)
        if others := sorted(entry.name for entry in set(files) - set(images)):
            notes.append(f"{path}: passed over {', '.join(others)[:200]}, which hold no image")
    if paths and not found:
        raise InputError(f"{paths[0]}: a folder without images. Name images, or a folder of images.")
    return found


def _counted(path: Path) -> list[tuple[int, str]]:
    """A key by which `IM2` comes before `IM10`."""
    return [(int(word), "") if word.isdecimal() else (-1, word) for word in re.split(r"(\d+)", str(path))]


def _other_patient(given: NewCase, images: list[Path], device_images: list[Path]) -> list[str]:
    """In words, whether headers of images tell another patient than that of the CT, which the case does not keep."""
    assert given.ct is not None
    of_kinds = ((ANATOMY_IMAGES, images), (DEVICE_IMAGES, device_images))
    exposures = [
        Exposure(view, kind, _short(path), read_header(path))
        for kind, paths in of_kinds
        for view, path in enumerate(paths)
        if is_dicom(path)
    ]
    return other_patient(exposures, patient_of(given.ct, given.series))


def _views(
    folder: Path, images: list[Path], device_images: list[Path], given: NewCase, notes: list[str]
) -> list[dict[str, Any]]:
    if device_images and len(device_images) != len(images):
        raise InputError(
            f"--device-images: {len(device_images)} files, but there are {len(images)} images without the device. Give "
            "one of each for every C-arm pose, in the same order."
        )
    said = {"intensity": given.intensity, "frames": given.frames}
    views: list[dict[str, Any]] = []
    for number, path in enumerate(images, 1):
        view: dict[str, Any] = {"anatomy": _copied(path, folder, f"view{number}")}
        if device_images:
            view[DEVICE] = _copied(device_images[number - 1], folder, f"view{number}_device")
        views.append(view | {key: value for key, value in said.items() if value is not None})
    beside = [f", with the device {_short(path)}" for path in device_images] or [""] * len(images)
    notes += [f"view {n} is {_short(path)}{more}" for n, (path, more) in enumerate(zip(images, beside, strict=True), 1)]
    return views


def _short(path: Path) -> str:
    """The file with its folder, as images of several folders often bear the same names."""
    return str(Path(path.resolve().parent.name) / path.name)


def _carm(folder: Path, given: NewCase, image: Path, notes: list[str]) -> str | dict[str, Any]:
    """The preset's name, the copied YAML file's, or what the tags of a DICOM image say."""
    if given.carm is not None:
        if given.carm.endswith((".yaml", ".yml")):
            if (why := why_unreadable(Path(given.carm))) is not None:
                raise InputError(f"--carm: {given.carm}: {why}")
            return _copied(Path(given.carm), folder, "carm")
        return given.carm
    if not is_dicom(image):
        raise InputError(f"--carm: is missing, and {image.name} is no DICOM file whose tags could say it.")
    try:
        carm = carm_settings(image)
    except InputError as error:
        raise InputError(
            f"--carm: is missing. {error} A YAML file with these can be given: --carm my_carm.yaml."
        ) from error
    told = f"source to detector {carm['sdd_mm']:g} mm, pixels of {carm['pixel_mm'][0]:g} mm"
    notes.append(f"the C-arm is that of the tags of {image.name}: {told}. It should be calibrated")
    return carm


def _display(given: NewCase, images: list[Path], notes: list[str]) -> dict[str, Any]:
    """How pictures are stored: as the flags say, or else as the header of the first image does.

    What other images say is held against it when the case is checked.
    """
    source, tags = given.source, read_header(images[0]) if is_dicom(images[0]) else None
    known = None if given.ignore_header else tags
    if source is None and known is not None and known.source_deg is not None:
        source = nearest_side(known.source_deg)
        notes.append(f"the source stands on the patient's {source} side, by the header of {images[0].name}")
    display = Display(source or "anterior", given.mirrored, given.turned, given.ignore_header)
    told = None if known is None else known.display(display.source)
    if told is not None and told != display and not given.mirrored and not given.turned:
        display = told
        words = [
            *(["mirrored"] if told.mirrored else []),
            *([f"turned by {told.turned_deg}°"] if told.turned_deg else []),
        ]
        notes.append(f"the pictures are {' and '.join(words)}, by PatientOrientation in the header of {images[0].name}")
    if source is None:
        notes.append(
            "the source is taken to stand in front of the patient, as neither --source nor a header says where it is"
        )
    return display_content(display)
