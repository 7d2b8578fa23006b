"""A case folder made of the files that scanner, 3D Slicer, TotalSegmentator and C-arm leave: `femoreg new-case`."""

import re
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

import torch
import yaml

from femoreg_torch.anatomy import label_table
from femoreg_torch.case.femoroplasty import (
    DEVICE,
    DEVICE_END,
    DEVICE_POINTS,
    FEMUR,
    TEMPLATE,
    femoral_head,
)
from femoreg_torch.case.nominal import ALONG_PATH, NominalPlace
from femoreg_torch.case.reading import CASE_NAME, VERSIONS
from femoreg_torch.errors import InputError
from femoreg_torch.files import new_folder, plain, write_text
from femoreg_torch.geometry import read_itk_transform
from femoreg_torch.intake.check import check_case
from femoreg_torch.intake.given import NewCase, copied, short_name
from femoreg_torch.intake.label_tables import table_of_map
from femoreg_torch.intake.new_anatomy import (
    operated_side,
    placed_ct,
    placed_labels,
    proposed_landmarks,
    segmented_labels,
    told_bones,
)
from femoreg_torch.intake.new_views import carm_content, display_of_images, image_files, notes_on_patients, placed_views
from femoreg_torch.intake.volumes import header_warnings
from femoreg_torch.paths import why_unreadable
from femoreg_torch.volume import (
    is_in_ras,
    read_ct_told,
    read_landmarks,
    read_mesh,
    read_path_points,
    write_landmarks,
)
from femoreg_torch.volume.materials import material_hu

T = TypeVar("T")
NEEDED = ("ct", "labels", "landmarks", "plan", "images")
_OWN_TABLE = "femoreg"  # of label maps that are made here
_SAID_BY = {  # what a problem asks to write into `case.yaml`, and the options that write it
    "`display:": "--source, --mirrored, --turned or --ignore-header",
    "`frames:": "--frames",
    "`intensity:": "--intensity",
    "`carm:": "--carm",
}
_DEVICE_HU = 5000.0  # of the paper's device


def make_case(out: Path, given: NewCase) -> tuple[list[str], tuple[str, ...]]:
    """Make the case folder `out`, which must not be there yet; return what was assumed or done, and warnings, in words.

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
    return notes, checked.warnings


def _sources(content: dict[str, Any], given: NewCase) -> dict[str, Path]:
    """The files given, by the names that the case has for those that are read first when it is checked."""
    views = content["views"]
    sources = {view["anatomy"]: path for view, path in zip(views, image_files(given.images, []), strict=True)}
    if str(content["carm"]).endswith((".yaml", ".yml")):
        sources[content["carm"]] = Path(str(given.carm))
    if given.device is not None:
        sources[content[DEVICE]["model"]] = given.device
        sources |= {view[DEVICE]: path for view, path in zip(views, image_files(given.device_images, []), strict=False)}
    return sources


def _as_given(problem: str, folder: Path, sources: dict[str, Path]) -> str:
    """The problem with the files given in place of their copies in `folder`, which are not kept, nor is its form."""
    problem = re.sub(rf"\b({CASE_NAME}), line \d+", r"\1", problem)
    copies = rf"({re.escape(str(folder))}/)?\b({'|'.join(map(re.escape, sources))})(?!\w)"
    return re.sub(copies, lambda found: str(sources[found[2]]) if found[1] else short_name(sources[found[2]]), problem)


def _check_given(given: NewCase) -> None:
    """Raises `InputError` for all flags that are missing, and files that are not there, at once."""
    found = ("labels", "landmarks") if given.segment else ()
    offer = {"labels": " (--segment finds the bones in the CT)", "landmarks": " (--segment proposes them)"}
    told = [
        f"--{name} is missing{offer.get(name, '')}" for name in NEEDED if name not in found and not getattr(given, name)
    ]
    paths = {name: getattr(given, name) for name in ("ct", "labels", "landmarks", "plan", "device", "device_points")}
    paths["device_transform"] = given.device_transform
    if given.carm is not None and Path(given.carm).suffix in (".yaml", ".yml"):  # else the name of a preset, or `dicom`
        paths["carm"] = Path(given.carm)
    for name, path in paths.items():
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
    by_words = ("guide", "before_entry_mm", "turned_deg", "in_front_mm")
    told += [
        f"--{name.replace('_', '-')} and --device-transform are both given: keep one"
        for name in by_words
        if given.device_transform is not None and getattr(given, name) is not None
    ]
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
    failed: list[str] = []

    def tried(read: Callable[[], T]) -> T | None:
        """What was read, or None; what is wrong is told at once with all else that is."""
        try:
            return read()
        except InputError as error:
            failed.append(str(error))
            return None

    read_ct = tried(partial(read_ct_told, given.ct, given.series))
    given_landmarks = None if given.landmarks is None else tried(partial(read_landmarks, given.landmarks))
    path = tried(partial(read_path_points, given.plan))
    device = None if given.device is None else tried(partial(_device, folder, given, notes))
    images, device_images = image_files(given.images, notes), image_files(given.device_images, notes)
    notes += tried(partial(notes_on_patients, given, images, device_images)) or []
    carm = tried(partial(carm_content, folder, given, images[0], notes))
    display = tried(partial(display_of_images, given, images, notes))
    views = tried(partial(placed_views, folder, images, device_images, given, notes))
    if failed or read_ct is None or path is None:
        raise InputError(_together("not written", failed))
    ct, told = read_ct
    entry_point, target = path
    notes += told
    if given.labels is None:
        bones, (labels_name, labels) = label_table(_OWN_TABLE), segmented_labels(folder, ct, notes)
    else:
        bones, more = table_of_map(given.labels, given.bones)
        notes += more
        labels_name, labels = placed_labels(folder, given.labels, ct, bones, notes)
    landmarks = given_landmarks or proposed_landmarks(labels, ct, bones, notes)
    side = given.side or operated_side(labels, ct, bones, landmarks, entry_point, header_warnings(given.ct), notes)
    if femoral_head(side) not in landmarks:
        raise InputError(
            f"{given.landmarks or '--segment'}: {femoral_head(side)}, the head of the operated femur, is "
            "missing. Place it in 3D Slicer, in the centre of the head."
        )
    write_landmarks(folder / "landmarks.json", landmarks)
    if target is None:
        notes.append("the path's target is the femoral head, as the plan has no other")
    return {
        "version": VERSIONS[-1],
        "template": TEMPLATE,
        "side": side,
        "ct": {"image": placed_ct(folder, given.ct, ct), "labels": labels_name, "bones": told_bones(bones)},
        "landmarks": "landmarks.json",
        "plan": {"entry_point": entry_point, "target": "FH" if target is None else target},
        **({} if device is None else {DEVICE: device}),
        "carm": carm,
        **(display or {}),
        "views": views,
    }


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
    content: dict[str, Any] = {"model": copied(given.device, folder, DEVICE)}
    if given.material is not None:
        material_hu(given.material)  # raises what is wrong with the name
        content["material"] = given.material
    else:
        content["hu"] = _DEVICE_HU if given.hu is None else given.hu
        if given.hu is None:
            notes.append(f"the device is drawn with {_DEVICE_HU:g} HU, as neither --material nor --hu is given")
    content["points"] = points
    if given.device_transform is not None:
        return content | {f"{FEMUR}_from_{DEVICE}": read_itk_transform(given.device_transform)}
    before, turned, front = given.before_entry_mm or 0.0, given.turned_deg or 0.0, given.in_front_mm or 0.0
    place = NominalPlace(given.guide or ALONG_PATH, before, turned, front)
    if given.guide is None:
        where = "past" if before < 0 else "before"
        note = f"the device starts {ALONG_PATH}, its tip {abs(before):g} mm {where} the entry point"
        note += f", turned by {turned:g}°" if turned else ""
        note += f", and all of it {front:g} mm in front of there" if front else ""
        notes.append(note)
    return content | {"start": vars(place)}
