"""Images with the truth about them, to measure a landmark network on."""

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

from torch import Tensor

from femoreg_torch.anatomy import HIP
from femoreg_torch.fluoro import attenuation_image
from femoreg_torch.geometry import Camera
from femoreg_torch.registration.scene import Outline
from femoreg_torch.volume import Volume
from sim.labelled.image_files import read_labelled
from training.augmentation import inside


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


def images_of_file(path: Path) -> Iterable[LabelledImage]:
    """The images of a file of `sim.labelled.image_files`. Raises `InputError` if there is none, or it is another."""
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
        )
