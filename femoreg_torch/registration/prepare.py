"""From a case on disk to the scene that is registered."""

import itertools
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path

import torch
from torch import Tensor

from femoreg_torch.anatomy import Anatomy
from femoreg_torch.case import Case, CaseObject, Model
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
from femoreg_torch.registration.models import ModelVolumes, model_attenuation, told_of_middle
from femoreg_torch.registration.plan_and_landmarks import (
    doubts_about_the_files,
    heads_near_landmarks,
    notes_on_the_slices,
)
from femoreg_torch.registration.roundness import Axis, round_axis
from femoreg_torch.registration.scene import Kind, RigidObject, Scene
from femoreg_torch.registration.silhouette import outline_of
from femoreg_torch.volume import (
    NOBODY,
    BoneLabels,
    Volume,
    bone_labels,
    check_inside,
    densities,
    hu_to_attenuation,
    label_box_centre,
    landmarks_without_bones,
    merged_bones,
    mostly_stray,
    patient_of,
    read_ct_told,
    read_labels_told,
    resample_isotropic,
    soft_bones,
    structure_attenuation,
    swapped_sides,
)

REGISTRATION_SPACING_MM = 1.0  # the paper resamples the CT to 1 mm (section III-A)
TISSUE_SPACING_MM = 3.0  # soft tissue is smooth
_MOST_BEYOND_MM = 500.0  # of an object's points from the box of its model: a guide may be longer than the sleeve
_NEAREST = 0.1  # of the source distance, of a start pose: the housing of a tube is longer
SOFT_HU = 50.0  # what is above is drawn as bone
ByKind = dict[Kind, tuple[Tensor | None, ...]]  # something (H, W) of every view


def prepare_scene(case: Case) -> Scene:
    """Volumes, reference points and images of a case. Raises `InputError` for every input that does not fit."""
    if not case.views:
        raise InputError(f"{case.folder}/case.yaml, views: empty. At least one fluoroscopic image is needed.")
    from_ct = [thing for thing in case.objects.values() if thing.model is None]
    objects: dict[str, RigidObject] = {}
    tissue = outline = None
    contradictions: tuple[str, ...] = ()
    with ThreadPoolExecutor(max_workers=2) as beside:  # images and models are read while the CT is
        reading = beside.submit(_read_with_saturated, case)
        making = {
            thing.name: beside.submit(_read_model, case, thing, thing.model)
            for thing in case.objects.values()
            if thing.model
        }
        if from_ct:
            ct, bones = read_bones(case)
            outlining = beside.submit(outline_of, bones, case.anatomy)
            looking = beside.submit(_told_of_files, case, ct, bones)
            check_inside(case.landmarks, ct)
            told_of_ct = (*bones.notes, *_check_anatomy(case, ct, bones))
            _check_path(case, ct)
            soft = resample_isotropic(ct.with_data(ct.data.clamp_max(SOFT_HU)), TISSUE_SPACING_MM)
            tissue = soft.with_data(hu_to_attenuation(soft.data, -1000.0))
        images, fields, bright, told = reading.result()
        if from_ct:
            contradictions, told_of_slices = looking.result()
            told = (*told_of_ct, *told_of_slices, *told)
            objects = ct_objects(ct, bones, from_ct, case.anatomy, tuple(images))
            outline = outlining.result()
        made = {name: model.result() for name, model in making.items()}
    for name, (volumes, axis) in made.items():
        thing = case.objects[name]
        assert thing.model is not None
        told = (*told, *told_of_middle(name, volumes.volume, thing.points))
        objects[name] = RigidObject(
            volumes.volume,
            volumes.volume.centre() if thing.reference is None else thing.reference,
            thing.images or tuple(images),
            thing.start,
            parts=volumes.parts,
            axis=axis,
            guide=(thing.points["base"], thing.points["tip"]) if {"base", "tip"} <= set(thing.points) else None,
            materials_known=thing.model.materials_known,
            sharp=bool(thing.model.solids),
        )
    known = case.views[-1].camera_from_camera1 is not None
    identity = torch.eye(4, dtype=torch.float64)
    cameras = [identity if v.camera_from_camera1 is None else v.camera_from_camera1 for v in case.views]
    check_starts(objects, case.carm.camera.sdd_mm, f"{case.folder}/case.yaml")
    return Scene(
        case.carm,
        {name: objects[name] for name in case.objects},
        images,
        fields=fields,
        saturated=bright,
        tissue=tissue,
        outline=outline,
        camera_from_camera1=torch.stack(cameras) if known else None,
        left_on_left=tuple(view for view in range(len(case.views)) if case.display_of(view).left_on_left),
        missing=told,
        contradictions=contradictions,
    )


def _check_anatomy(case: Case, ct: Volume, bones: BoneLabels) -> tuple[str, ...]:
    """What is strange of CT and label map, in words.

    Raises `InputError` if they and the landmarks contradict one another.
    """
    asked = bones, case.landmarks, case.anatomy
    told = swapped_sides(*asked) or merged_bones(*asked) or mostly_stray(*asked)
    seen = densities(ct, bones.labels)
    if wrong := [*told, *filter(None, [seen.unscaled])]:
        raise InputError(f"{case.folder}: {'; '.join(wrong)}.")
    elsewhere = seen.light or seen.elsewhere or soft_bones(ct, bones.labels, bones.ids)
    return (*filter(None, [elsewhere, seen.windowed]), *landmarks_without_bones(bones, case.landmarks, case.anatomy))


def _told_of_files(case: Case, ct: Volume, bones: BoneLabels) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """What speaks against CT, label map, landmarks and plan, and what is noted of the slices, in words."""
    heads = heads_near_landmarks(case, bones)
    return doubts_about_the_files(case, ct, bones, heads), notes_on_the_slices(bones, heads)


def _check_path(case: Case, ct: Volume) -> None:
    """Raises `InputError` if a path through bones of the CT leaves the CT."""
    if case.plan is not None and case.objects[case.plan.object].model is None:
        check_inside({"entry_point of the plan": case.plan.entry_point, "target of the plan": case.plan.target}, ct)


def _named_points(thing: CaseObject) -> dict[str, Tensor]:
    """All points (3,) of an object that have a name, its reference too if it is given."""
    return thing.points if thing.reference is None else {**thing.points, "reference": thing.reference}


def _read_model(case: Case, thing: CaseObject, model: Model) -> tuple[ModelVolumes, Axis | None]:
    """An object's model as volumes, and its axis if it is round. Raises `InputError` for what does not fit.

    Where its reference lies does not matter for that: of a round object deviations are told on the axis.
    """
    volumes = model_attenuation(model)
    _check_points(case, thing, volumes.volume)
    elsewhere = [p for p in thing.points.values() if thing.reference is None or not torch.equal(p, thing.reference)]
    return volumes, round_axis(volumes.volume, volumes.parts, elsewhere)


def _check_points(case: Case, thing: CaseObject, volume: Volume) -> None:
    """Raises `InputError` for a point (3,) of an object that lies nowhere near its model."""
    for name, point in _named_points(thing).items():
        beyond = volume.beyond_mm(point)
        if beyond > _MOST_BEYOND_MM:
            raise InputError(
                f"{case.folder}/case.yaml, {thing.name}: its point {name} lies {beyond:.0f} mm outside its model. Are "
                "both in mm, and in the same space?"
            )


def check_starts(objects: Mapping[str, RigidObject], sdd_mm: float, where: str) -> None:
    """Raises `InputError` that starts with `where` for a nominal pose that is not between source and detector."""
    for name, thing in objects.items():
        check_start(name, thing.start.camera1_from, thing.reference_point, sdd_mm, where)


def check_start(name: str, camera1_from: Tensor | None, point: Tensor, sdd_mm: float, where: str) -> None:
    """Raises `InputError` if a nominal pose (4, 4) puts a point (3,) of an object not between source and detector."""
    if camera1_from is None:
        return
    depth = (camera1_from[:3, :3] @ point + camera1_from[:3, 3])[2].item()
    if not _NEAREST * sdd_mm < depth < sdd_mm:
        place = "behind the source" if depth <= 0 else "at the source" if depth < sdd_mm else "behind the detector"
        raise InputError(
            f"{where}: the start pose puts {name} {place}, {depth:.3g} mm along the beam from the source (it has "
            f"{sdd_mm:.0f} mm to the detector). Give the transform from its space to camera 1, in mm, and not its "
            "inverse."
        )


def read_bones(case: Case) -> tuple[Volume, BoneLabels]:
    """The CT of a case, HU, and its bones on the same grid. Raises `InputError`."""
    if case.ct_path is None:
        raise InputError(f"{case.folder}/case.yaml, ct.image: missing. Bones are taken from a CT.")
    if case.labels_path is None:
        raise InputError(
            f"{case.folder}/case.yaml, ct.labels: missing. Give a label map of the bones; "
            "`femoreg segment` makes one of the CT, `femoreg new-case --segment` the whole case."
        )
    ct, told = read_ct_told(case.ct_path)
    labels, done = read_labels_told(case.labels_path, ct, {n for ids in case.bones.values() for n in ids})
    bones = bone_labels(labels, ct, case.bones, case.anatomy, case.landmarks)
    return ct, replace(bones, notes=(*told, *done))


def ct_objects(
    ct: Volume, bones: BoneLabels, things: Sequence[CaseObject], anatomy: Anatomy | None, kinds: tuple[Kind, ...]
) -> dict[str, RigidObject]:
    """Objects that are bones of a CT in HU, with attenuation on voxels of 1 mm; `kinds` are all kinds of images."""
    ids = {thing.name: bones.of(thing.bones, anatomy) for thing in things}
    centres = {
        thing.name: label_box_centre(bones.labels, ids[thing.name]) if thing.reference is None else thing.reference
        for thing in things
    }
    labels = bones.labels
    if max(abs(s - REGISTRATION_SPACING_MM) for s in ct.spacing_mm) > 1e-3:
        labels = resample_isotropic(labels, REGISTRATION_SPACING_MM, nearest=True)
        ct = resample_isotropic(ct, REGISTRATION_SPACING_MM)
    return {
        thing.name: RigidObject(
            structure_attenuation(ct, labels, ids[thing.name], offset_hu=SOFT_HU),
            centres[thing.name],
            thing.images or kinds,
            thing.start,
            anatomy.classes(thing.bones) if anatomy else (),
        )
        for thing in things
    }


def reference_point(case: Case, name: str, bones: BoneLabels | None) -> Tensor:
    """Where the errors of an object are told, (3,) mm in its space."""
    thing = case.objects[name]
    if thing.reference is not None:
        return thing.reference
    if thing.model is not None:
        return model_attenuation(thing.model).volume.centre()
    if bones is None:
        raise InputError(f"{case.folder}: has no label map to find the middle of {name}. Add `ct.labels`.")
    return label_box_centre(bones.labels, bones.of(thing.bones, case.anatomy))


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
            if one is not None and one.field is None and shutters:
                read[index] = _read_image(case, index, kind, shutters)
    images = {kind: tuple(None if one is None else one.attenuation for one in read) for kind, read in found.items()}
    fields = {kind: tuple(None if one is None else one.field for one in read) for kind, read in found.items()}
    _check_different(case, images)
    remarks = [remark for read in found.values() for one in read if one is not None for remark in one.told]
    exposures = [one.exposure for read in found.values() for one in read if one is not None and one.exposure]
    return images, fields, (*remarks, *told, *_told_by_headers(exposures, case.ct_path))


def _told_by_headers(exposures: Sequence[Exposure], ct: Path | None) -> list[str]:
    """Where headers of the images contradict one another, or that of the CT, in words."""
    told = told_together(exposures)
    if ct is None or all(one.tags.patient == NOBODY for one in exposures):
        return told
    return [*other_patient(exposures, patient_of(ct)), *told]


def _read_with_saturated(case: Case) -> tuple[ByKind, ByKind, ByKind, tuple[str, ...]]:
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
        f"up to {100 * max(shares):.0f} % of an image is saturated: whether something is bent or broken, and what else "
        "lies beside a device, was not asked there",
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
    told: tuple[str, ...]  # of a shutter that was found, and of the file, in words
    shutter: Shutter | None  # that was found
    exposure: Exposure | None  # what the header of a DICOM file says


def _read_image(case: Case, index: int, kind: Kind, shutters: Sequence[Shutter] = ()) -> _Image:
    """One image of a view (from 0) as the source sees it, and its field: see `_field`."""
    view, display, camera = case.views[index], case.display_of(index), case.carm.camera
    where, told = f"{case.folder}/case.yaml, views[{index}].{kind}", f"view {index + 1}, {kind} image: "
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
    return _Image(attenuation, field, tuple(told + remark for remark in remarks), shutter, exposure)


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
