"""From a case on disk to the scene that is registered."""

from collections.abc import Mapping

from torch import Tensor

from femoreg_torch.case import Case, Device, View
from femoreg_torch.errors import InputError
from femoreg_torch.fluoro import attenuation_image, check_matches, read_image
from femoreg_torch.registration.scene import Kind, RigidObject, Scene
from femoreg_torch.registration.silhouette import hip_mask
from femoreg_torch.volume import (
    Volume,
    check_inside,
    hu_to_attenuation,
    label_box_centre,
    labelled_device,
    read_ct,
    read_labels,
    read_mesh,
    resample_isotropic,
    scanned_device,
    structure_attenuation,
    voxelise_mesh,
)

REGISTRATION_SPACING_MM = 1.0  # the paper resamples the CT to 1 mm (section III-A)
_CLASSES = {"pelvis": (1, 2, 4), "femur_left": (5,), "femur_right": (6,)}  # of the landmark network's segmentation
TISSUE_SPACING_MM = 3.0  # soft tissue is smooth
SOFT_HU = 50.0  # what is above is drawn as bone
DEVICE_SPACING_MM = 0.5  # a sleeve's wall is thinner than a CT voxel


def prepare_scene(case: Case) -> Scene:
    """Volumes, reference points and images of a case. Raises `InputError` for every input that does not fit."""
    if not case.views:
        raise InputError(f"{case.folder}/case.yaml, views: empty. At least one fluoroscopic image is needed.")
    images = read_images(case)
    if case.labels_path is None:
        raise InputError(f"{case.folder}/case.yaml, ct.labels: missing. Give a label map with pelvis and femora.")
    ct = read_ct(case.ct_path)
    labels = read_labels(case.labels_path, ct)
    check_inside(case.landmarks, ct)
    objects = anatomy_objects(ct, labels, case.structures, case.femur, case.femoral_head)
    if case.device is not None:
        device, centre = device_attenuation(case.device), case.device.points["center"]
        objects["device"] = RigidObject(device, centre, ("device",), case.device.camera1_from_device)
    soft = hu_to_attenuation(ct.data.float().clamp_max(SOFT_HU), -1000.0)
    tissue = resample_isotropic(ct.with_data(soft), TISSUE_SPACING_MM)
    return Scene(case.carm, objects, images, tissue=tissue, hips=hip_mask(labels, case.structures["pelvis"]))


def anatomy_objects(
    ct: Volume, labels: Volume, structures: Mapping[str, tuple[int, ...]], femur: str, femoral_head: Tensor
) -> dict[str, RigidObject]:
    """Pelvis and one femur (`femur_left` or `femur_right`) of a CT in HU with a label map on the same grid."""
    middle = label_box_centre(labels, structures["pelvis"])
    if max(abs(s - REGISTRATION_SPACING_MM) for s in ct.spacing_mm) > 1e-3:
        labels = resample_isotropic(labels, REGISTRATION_SPACING_MM, nearest=True)
        ct = resample_isotropic(ct, REGISTRATION_SPACING_MM)
    pelvis, bone = (
        structure_attenuation(ct, labels, structures[name], offset_hu=SOFT_HU) for name in ("pelvis", femur)
    )
    always: tuple[Kind, ...] = ("anatomy", "device")
    return {
        "pelvis": RigidObject(pelvis, middle, always, classes=_CLASSES["pelvis"]),
        "femur": RigidObject(bone, femoral_head, always, classes=_CLASSES[femur]),
    }


def device_attenuation(device: Device) -> Volume:
    """Attenuation (1/mm) of a device in its own space. Raises `InputError` for a mesh or volume that does not fit."""
    if device.hu is None:
        return scanned_device(device.model_path)
    if device.labels is not None:
        return labelled_device(device.model_path, device.labels, device.hu, DEVICE_SPACING_MM)
    return voxelise_mesh(read_mesh(device.model_path), DEVICE_SPACING_MM, device.hu)


def read_images(case: Case) -> dict[Kind, tuple[Tensor, ...]]:
    """Attenuation images (H, W) of all views; those with the device only if every view has one."""
    images: dict[Kind, tuple[Tensor, ...]] = {
        "anatomy": tuple(_attenuation(case, i, view, "anatomy") for i, view in enumerate(case.views))
    }
    if case.device is not None and all(view.device for view in case.views):
        images["device"] = tuple(_attenuation(case, i, view, "device") for i, view in enumerate(case.views))
    return images


def _attenuation(case: Case, index: int, view: View, kind: Kind) -> Tensor:
    path = view.anatomy if kind == "anatomy" else view.device
    if path is None:
        raise InputError(f"{case.folder}/case.yaml, views[{index}].{kind}: missing.")
    image = read_image(path)
    check_matches(image, case.carm.camera, f"{case.folder}/case.yaml, views[{index}].{kind}")
    return attenuation_image(image) if view.intensity == "raw" else image
