"""The fluoroscopic images of a case: attenuation, exposed fields, saturated pixels, and what is said of them."""

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from femoreg_torch.case import Case
from femoreg_torch.errors import InputError
from femoreg_torch.fluoro import (
    Circle,
    Distortion,
    Exposure,
    Polygon,
    Shutter,
    StoredImage,
    attenuation_image,
    below_zero,
    blank_lines,
    check_header,
    check_intensity,
    check_matches,
    find_distortion,
    find_shutter,
    intensity_of,
    other_patient,
    raised,
    read_image,
    read_stored,
    saturated,
    settled_intensity,
    shades,
    told_together,
    without_defects,
    without_penumbra,
)
from femoreg_torch.registration.scene import Kind
from femoreg_torch.volume import NOBODY, patient_of

_BLADE_SHARE = 0.01  # of the detector: what a blade that is missing shades at least

ByKind = dict[Kind, tuple[Tensor | None, ...]]  # something (H, W) of every view


def read_images(case: Case) -> tuple[ByKind, ByKind, tuple[str, ...]]:
    """Attenuation images (H, W) of all views by kind, None where a view lacks one, and their exposed fields, bool.

    A field is None where the whole detector is exposed. Last, in words, which images are missing, and which shutters
    were found. Raises `InputError` if a view lacks an image of the first kind.
    """
    found: dict[Kind, list[_Image | None]] = {}
    told = []
    wanted = dict.fromkeys((*case.kinds, *(kind for thing in case.objects.values() for kind in thing.images or ())))
    for kind in wanted:
        without = [number for number, view in enumerate(case.views, 1) if kind not in view.images]
        if without and kind == case.kinds[0]:
            raise InputError(f"{case.folder}/case.yaml, views[{without[0] - 1}].{kind}: missing.")
        if len(without) < len(case.views):
            found[kind] = [
                _read_image(case, i, kind) if kind in view.images else None for i, view in enumerate(case.views)
            ]
        if without:
            told.append(_told(case, kind, without))
    shutters = [one.shutter for read in found.values() for one in read if one is not None and one.shutter is not None]
    for kind, read in found.items():
        for index, one in enumerate(read):
            others = [] if one is None else _that_may_shade(one, shutters)
            again = _read_image(case, index, kind, others) if others else None
            if again is not None and again.shutter is not None:
                read[index] = again
    images = {kind: tuple(None if one is None else one.attenuation for one in read) for kind, read in found.items()}
    fields = {kind: tuple(None if one is None else one.field for one in read) for kind, read in found.items()}
    _check_different(case, images)
    remarks = _summed({kind: [() if one is None else one.told for one in read] for kind, read in found.items()})
    exposures = [one.exposure for read in found.values() for one in read if one is not None and one.exposure]
    return images, fields, (*remarks, *told, *_told_by_headers(exposures, case.ct_path))


def _summed(remarks: Mapping[Kind, Sequence[tuple[str, ...]]]) -> list[str]:
    """The remarks on the images of every kind and view, with the images that they are of; each of them once."""
    of: dict[str, list[tuple[Kind, int]]] = {}
    for kind, views in remarks.items():
        for number, told in enumerate(views, 1):
            for remark in told:
                of.setdefault(remark, []).append((kind, number))
    return [f"{_images(images)}: {remark}" for remark, images in of.items()]


def _images(images: Sequence[tuple[Kind, int]]) -> str:
    """Images by kind and view (from 1), in words."""
    if len(images) == 1:
        return f"view {images[0][1]}, {images[0][0]} image"
    by_kind = {kind: [number for each, number in images if each == kind] for kind, _ in images}
    return ", ".join(f"{kind} image{'s' * (len(of) > 1)} of {_views(of)}" for kind, of in by_kind.items())


def _that_may_shade(image: "_Image", shutters: Sequence[Shutter]) -> list[Shutter]:
    """Which shutters of other images one may show without that it was found, or whose blades were found but in part."""
    if image.shutter is None:
        return list(shutters) if image.field is None else []
    return [shutter for shutter in shutters if shutter.exposed < image.shutter.exposed - _BLADE_SHARE]


def _told_by_headers(exposures: Sequence[Exposure], ct: Path | None) -> list[str]:
    """Where headers of the images contradict one another, or that of the CT, in words."""
    told = told_together(exposures)
    if ct is None or all(one.tags.patient == NOBODY for one in exposures):
        return told
    return [*other_patient(exposures, patient_of(ct)), *told]


def read_with_saturated(case: Case) -> tuple[ByKind, ByKind, ByKind, tuple[str, ...]]:
    """As `read_images`, with the saturated pixels."""
    images, fields, told = read_images(case)
    bright = _saturated(images, fields)
    return images, fields, bright, (*told, *_told_saturated(bright))


def _saturated(images: ByKind, fields: ByKind) -> ByKind:
    """The saturated pixels of all images; None where one has none."""
    return {
        kind: tuple(
            None if image is None else saturated(image, field)
            for image, field in zip(images[kind], fields[kind], strict=True)
        )
        for kind in images
    }


def _told_saturated(found: ByKind) -> tuple[str, ...]:
    """What it means that pixels are saturated, in words; nothing where none is."""
    shares = [float(mask.double().mean()) for masks in found.values() for mask in masks if mask is not None]
    if not shares:
        return ()
    return (
        f"up to {100 * max(shares):.0f} % of an image is saturated: what is bent, broken, or of another size than it "
        "was told, whether pictures are bent or smeared, and what lies beside a device, was not asked there",
    )


def _check_different(case: Case, images: ByKind) -> None:
    """Raises `InputError` if one image is given twice: two exposures are never the same in every pixel."""
    there = [(kind, view, one) for kind, of in images.items() for view, one in enumerate(of) if one is not None]
    for (kind, view, one), (other_kind, other_view, other) in itertools.combinations(there, 2):
        if torch.equal(one, other):
            raise InputError(
                f"{case.folder}/case.yaml, views[{other_view}].{other_kind}: the same image as views[{view}].{kind}. "
                "Give every exposure its own image."
            )


def _told(case: Case, kind: Kind, without: list[int]) -> str:
    """What it means that some views (from 1) have no image of a kind."""
    has = [number for number in range(1, len(case.views) + 1) if number not in without]
    if not has:
        nowhere = [
            name for name, thing in case.objects.items() if thing.images and not set(thing.images) & set(case.kinds)
        ]
        return f"there are no {kind} images" + (f", so nothing shows the {_listed(nowhere)}" if nowhere else "")
    only = [name for name, thing in case.objects.items() if thing.images is not None and set(thing.images) == {kind}]
    told = f"{_views(without)} {'has' if len(without) == 1 else 'have'} no {kind} image"
    return told + (f": the {_listed(only)} was found in {_views(has)}" if only else "")


def _views(numbers: Sequence[int]) -> str:
    return f"view{'s' * (len(numbers) > 1)} {_listed(numbers)}"


def _listed(words: Sequence[object]) -> str:
    *most, last = map(str, words)
    return f"{', '.join(most)} and {last}" if most else last


@dataclass(frozen=True, eq=False)
class _Image:
    attenuation: Tensor  # (H, W)
    field: Tensor | None  # (H, W) bool: what is exposed; None: all
    told: tuple[str, ...]  # of a shutter that was found, and of the file, in words, without the image's own name
    shutter: Shutter | None  # that was found
    exposure: Exposure | None  # what the header of a DICOM file says


def _read_image(case: Case, index: int, kind: Kind, shutters: Sequence[Shutter] = ()) -> _Image:
    """One image of a view (from 0) as the source sees it, and its field: see `_field`."""
    view, display, camera = case.views[index], case.display_of(index), case.carm.camera
    where = f"{case.folder}/case.yaml, views[{index}].{kind}"
    stored = read_stored(view.images[kind], view.frames)
    as_stored = display.stored_camera(camera)
    check_matches(stored.values, as_stored, where)
    file = f"{where}: {view.images[kind].name}"
    check_header(stored.tags, as_stored, display, case.carm.uncertainty, file)
    intensity = settled_intensity(view.intensity, stored, file)
    logarithms, told_values = intensity == "log", stored.values_as(intensity)
    light = intensity_of(told_values) if logarithms else told_values
    values, mended = without_defects(told_values, light, as_stored.mean_pixel_mm)
    distortion = view_distortion(case, index)
    straight = values if distortion is None else distortion.straightened(values)
    image = display.to_camera(straight)
    raw = intensity_of(image) if logarithms else image
    lifted = None
    if not logarithms:
        check_intensity(raw, file)
        lifted = raised(raw)
    field, words, shutter = _field(case, index, stored, raw, distortion, shutters)
    if field is not None and not field.any():
        told_by = f"{case.folder}/case.yaml, views[{index}].field" if view.field is not None else f"{where}: its header"
        raise InputError(f"{told_by}: exposes no pixel of the image.")
    bent = [] if distortion is None else [_told_distortion(distortion)]
    dark = None if logarithms else below_zero(stored.values, stored.padding)
    remarks = (
        *bent,
        *(f"{view.images[kind].name} {remark}" for remark in (*stored.remarks, *filter(None, [dark, lifted, mended]))),
        *([words] if words else []),
    )
    attenuation = image if logarithms else attenuation_image(image, field)
    name, tags = view.images[kind].name, stored.tags
    exposure = None if tags is None else Exposure(index, kind, name, tags, view.frames)
    return _Image(attenuation, field, remarks, shutter, exposure)


def view_distortion(case: Case, index: int) -> Distortion | None:
    """What the grid image of a view (from 0) says of its image intensifier; None without one. Raises `InputError`."""
    grid = case.views[index].grid
    if grid is None:
        return None
    image, camera = read_image(grid.path), case.display_of(index).stored_camera(case.carm.camera)
    where = f"{case.folder}/case.yaml, views[{index}].grid"
    check_matches(image, camera, where)
    return find_distortion(image, camera, grid.pitch_mm, where)


def _told_distortion(found: Distortion) -> str:
    return (
        f"made straight by {found.spots} spots of its grid: moved by up to {found.greatest_mm:.1f} mm, "
        f"{found.residual_mm:.2f} mm left (root mean square)"
    )


def _field(
    case: Case,
    index: int,
    stored: StoredImage,
    raw: Tensor,
    distortion: Distortion | None,
    shutters: Sequence[Shutter],
) -> tuple[Tensor | None, str | None, Shutter | None]:
    """The exposed pixels (H, W) of an image `raw` of a view (from 0), None for all, and where they come from, in words.

    The field is what the case tells, or else what the header's shutter leaves, or else what a shutter in the image
    leaves, or one of the `shutters` of other images that this one shows too, or rows and columns without an image;
    pixels that hold no image are never exposed. Last, the shutter that was found in the image.
    """
    camera, display, told = case.carm.camera, case.display_of(index), case.views[index].field
    field, words = None, None

    def seen(mask: Tensor) -> Tensor:
        return display.to_camera(mask if distortion is None else distortion.straightened(mask))

    if told is not None:
        field = seen(_told_field(case, index, told))
    elif stored.tags is not None and stored.tags.field is not None:
        field = seen(stored.tags.field.exposed(display.stored_camera(camera).shape))
        words = f"a shutter by its header, {100 * float(field.double().mean()):.0f} % of the detector is exposed"
    if stored.padding is not None:
        image = ~seen(stored.padding)
        field = image if field is None else field & image
    if field is not None:
        return without_penumbra(field, camera), words, None
    if shutters:  # what this image shows by itself was looked for before
        shutter = next((one for one in shutters if shades(one, raw, camera)), None)
    else:
        shutter = find_shutter(raw, camera)
    if shutter is None:
        blank = blank_lines(raw)
        if blank is None:
            return None, None, None
        words = f"{100 * float(blank.double().mean()):.0f} % of it, whole rows or columns, hold no image"
        return without_penumbra(~blank, camera), words, None
    words = f"a {shutter.shape} shutter was found, {100 * shutter.exposed:.0f} % of the detector is exposed"
    return shutter.field, words, shutter


def _told_field(case: Case, index: int, field: Circle | Polygon | Path) -> Tensor:
    """The exposed pixels (H, W), as the images are stored, that a view (from 0) tells."""
    camera = case.display_of(index).stored_camera(case.carm.camera)
    if not isinstance(field, Path):
        return field.exposed(camera.shape)
    mask = read_image(field)
    check_matches(mask, camera, f"{case.folder}/case.yaml, views[{index}].field")
    return mask > 0
