"""Images with the truth about them, to measure a landmark network on.

Those of the public DeepFluoro data set lose 50 pixels at each border, as there (Grupp et al. 2020).
"""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

import torch
from torch import Tensor

from femoreg_torch.anatomy import HIP, LabelTable
from femoreg_torch.detect import filled, image_from_network
from femoreg_torch.detect.grid import NETWORK_SIZE
from femoreg_torch.fluoro import Display, attenuation_image, exposed_field, nearest_source
from femoreg_torch.geometry import Camera, centred_camera
from femoreg_torch.neighbours.deepfluoro import (
    BONES,
    Picture,
    is_full_resolution,
    read_pictures,
    read_preprocessed,
    read_specimen,
    specimens,
)
from femoreg_torch.registration.prepare.outline import outline_of
from femoreg_torch.registration.scene import Outline
from femoreg_torch.volume import BoneLabels, Volume, bone_labels
from sim.labelled.image_files import read_labelled
from training.augmentation import inside

_BORDER_PX = 50  # of a DeepFluoro picture: the rim of the collimator
_DETECTOR = centred_camera(1020.0, (0.194, 0.194), (1536, 1536))  # of the Cios Fusion that took them


@dataclass(frozen=True, eq=False)
class LabelledImage:
    """An image and the truth about it; landmarks and classes are those of the hip, in order."""

    patient: str
    attenuation: Tensor  # (H, W)
    camera: Camera
    landmarks: Tensor  # (L, 2) column, row, also outside of the image
    labels: Tensor  # (h, w) uint8, the class that is seen; on the network's grid or, half as fine, that of its output
    visible: Tensor  # (L,) bool
    points: Tensor  # (L, 3) LPS mm
    camera_from_lps: Tensor  # (4, 4) rigid
    outline: Outline | None = None  # of the bones that a start pose is checked by
    display: Display = field(default_factory=Display)  # of the picture; the image is as the source sees it
    posed: bool = True  # whether `points` and `camera_from_lps` are known


def images_of_file(path: Path) -> Iterable[LabelledImage]:
    """The images of a file of `sim.labelled.image_files`, or of a DeepFluoro file (`.h5`).

    Raises `InputError` if there is none, or it is another.
    """
    if path.suffix.lower() in (".h5", ".hdf5"):
        yield from deepfluoro_images(path)
        return
    content = read_labelled(path)
    outline = Outline(Volume(content.hips.float() / 255, content.lps_from_hips), HIP.outline)
    for n in range(len(content.images)):
        yield LabelledImage(
            patient=content.source,
            attenuation=attenuation_image(content.images[n].float()),
            camera=content.camera,
            landmarks=content.landmarks[n],
            labels=content.labels[n],
            visible=inside(content.landmarks[n], content.camera.shape),
            points=content.landmarks_lps,
            camera_from_lps=content.camera_from_lps[n],
            outline=outline,
            display=Display(nearest_source(content.camera_from_lps[n][2, :3])),
        )


@dataclass(frozen=True, eq=False)
class Cadaver:
    """A specimen of the full-resolution DeepFluoro data, ready to be registered."""

    name: str
    ct: Volume  # HU
    bones: BoneLabels
    landmarks: dict[str, Tensor]  # (3,) LPS mm
    images: Iterable[LabelledImage]


def cadavers(path: Path) -> Iterator[Cadaver]:
    """The specimens of a full-resolution file, one after the other. Raises `InputError`."""
    table: LabelTable = {bone: (n,) for n, bone in enumerate(BONES, 1)}
    for name in specimens(path):
        specimen = read_specimen(path, name)
        landmarks = {mark: specimen.landmarks[mark] for mark in HIP.landmark_names if mark in specimen.landmarks}
        bones = bone_labels(specimen.labels, specimen.ct, table, HIP, landmarks)
        outline = outline_of(bones, HIP)
        images = (labelled_picture(picture, landmarks, outline) for picture in read_pictures(path, name))
        yield Cadaver(name, specimen.ct, bones, landmarks, images)


def deepfluoro_images(path: Path) -> Iterator[LabelledImage]:
    """The images of a DeepFluoro file of either layout. Raises `InputError`."""
    if is_full_resolution(path):
        for cadaver in cadavers(path):
            yield from cadaver.images
    else:
        for picture in read_preprocessed(path, _DETECTOR):
            yield labelled_picture(picture, {}, None)


def labelled_picture(picture: Picture, points: dict[str, Tensor], outline: Outline | None) -> LabelledImage:
    """A picture as the source sees it; `points` (3,) are the landmarks of its CT."""
    camera, display = picture.display.camera(picture.camera), picture.display
    image = display.to_camera(picture.image)
    labels = None if picture.labels is None else display.to_camera(picture.labels)
    nowhere = torch.full((2,), torch.nan, dtype=torch.float64)
    stored = torch.stack([picture.landmarks.get(name, nowhere) for name in HIP.landmark_names])
    pixels = display.pixels_to_camera(stored, camera)
    if picture.intensity == "raw":
        rows, columns = (slice(_BORDER_PX, n - _BORDER_PX) for n in camera.shape)
        image, labels = image[rows, columns], None if labels is None else labels[rows, columns]
        pixels, camera = pixels - _BORDER_PX, camera.window(rows, columns)
        exposed = exposed_field(image, camera)
        image = attenuation_image(image, exposed)
        image = image if exposed is None else filled(image, exposed)
    posed = "pelvis" in picture.camera_from and all(name in points for name in HIP.landmark_names)
    return LabelledImage(
        patient=picture.specimen,
        attenuation=image,
        camera=camera,
        landmarks=pixels,
        labels=_on_network_grid(torch.zeros(camera.shape, dtype=torch.uint8) if labels is None else labels, camera),
        visible=inside(pixels, camera.shape),
        points=torch.stack([points.get(name, torch.zeros(3, dtype=torch.float64)) for name in HIP.landmark_names]),
        camera_from_lps=picture.camera_from.get("pelvis", torch.eye(4, dtype=torch.float64)),
        outline=outline,
        display=display,
        posed=posed,
    )


def _on_network_grid(labels: Tensor, camera: Camera) -> Tensor:
    """Labels (H, W) of an image at the nearest pixels of the network's grid; 0 beyond the image."""
    axis = torch.arange(NETWORK_SIZE, dtype=torch.float64)
    row, column = torch.meshgrid(axis, axis, indexing="ij")
    columns, rows = image_from_network(torch.stack([column, row], -1), camera).round().long().unbind(-1)
    height, width = camera.shape
    there = (columns >= 0) & (columns < width) & (rows >= 0) & (rows < height)
    return labels[rows.clamp(0, height - 1), columns.clamp(0, width - 1)] * there
