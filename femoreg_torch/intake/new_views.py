"""Fluoroscopic images and C-arm of a new case."""

import re
from pathlib import Path
from typing import Any

from femoreg_torch.case.femoroplasty import ANATOMY_IMAGES, DEVICE, DEVICE_IMAGES
from femoreg_torch.case.writing import display_content
from femoreg_torch.errors import InputError
from femoreg_torch.fluoro import (
    Display,
    Exposure,
    carm_settings,
    may_be_image,
    nearest_side,
    other_patient,
    read_header,
)
from femoreg_torch.geometry import load_carm
from femoreg_torch.intake.given import NewCase, copied, short_name
from femoreg_torch.paths import why_unreadable
from femoreg_torch.volume import patient_of
from femoreg_torch.volume.dicom.headers import is_dicom


def image_files(paths: tuple[Path, ...], notes: list[str]) -> list[Path]:
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


def notes_on_patients(given: NewCase, images: list[Path], device_images: list[Path]) -> list[str]:
    """In words, whether headers of images tell another patient than that of the CT, which the case does not keep."""
    assert given.ct is not None
    of_kinds = ((ANATOMY_IMAGES, images), (DEVICE_IMAGES, device_images))
    exposures = [
        Exposure(view, kind, short_name(path), read_header(path))
        for kind, paths in of_kinds
        for view, path in enumerate(paths)
        if is_dicom(path)
    ]
    return other_patient(exposures, patient_of(given.ct, given.series))


def placed_views(
    folder: Path, images: list[Path], device_images: list[Path], given: NewCase, notes: list[str]
) -> list[dict[str, Any]]:
    """The views of `case.yaml`, whose images are copied into `folder`.

    Raises `InputError` where there are more images of one kind than of the other.
    """
    if device_images and len(device_images) != len(images):
        raise InputError(
            f"--device-images: {len(device_images)} files, but there are {len(images)} images without the device. Give "
            "one of each for every C-arm pose, in the same order."
        )
    said = {"intensity": given.intensity, "frames": given.frames}
    views: list[dict[str, Any]] = []
    for number, path in enumerate(images, 1):
        view: dict[str, Any] = {"anatomy": copied(path, folder, f"view{number}")}
        if device_images:
            view[DEVICE] = copied(device_images[number - 1], folder, f"view{number}_device")
        views.append(view | {key: value for key, value in said.items() if value is not None})
    beside = [f", with the device {short_name(path)}" for path in device_images] or [""] * len(images)
    notes += [
        f"view {n} is {short_name(path)}{more}" for n, (path, more) in enumerate(zip(images, beside, strict=True), 1)
    ]
    return views


def carm_content(folder: Path, given: NewCase, image: Path, notes: list[str]) -> str | dict[str, Any]:
    """The preset's name, the copied YAML file's, or what the tags of a DICOM image say."""
    if given.carm is not None:
        if given.carm.endswith((".yaml", ".yml")):
            if (why := why_unreadable(Path(given.carm))) is not None:
                raise InputError(f"--carm: {given.carm}: {why}")
            load_carm(given.carm)  # raises what is wrong in it
            return copied(Path(given.carm), folder, "carm")
        load_carm(given.carm)
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


def display_of_images(given: NewCase, images: list[Path], notes: list[str]) -> dict[str, Any]:
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
