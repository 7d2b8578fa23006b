"""What becomes of the start pose in an altered image: a good start, a refusal, or a silent failure."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from femoreg_torch.detect import image_from_network
from femoreg_torch.detect.grid import NETWORK_SIZE
from training.accuracy import COARSE
from training.labelled import LabelledImage
from training.measure import Reading

_NARROW = 0.55  # share of the image's width that a crop to one hip leaves


def turned(image: LabelledImage) -> LabelledImage:
    """The image turned by 180°, and the patient's pose about the central ray with it."""
    rows, columns = image.camera.shape
    last = torch.tensor([columns - 1, rows - 1], dtype=image.landmarks.dtype)
    half_turn = torch.diag(torch.tensor([-1.0, -1.0, 1.0, 1.0], dtype=torch.float64))
    column, row = image.camera.principal_point_px
    camera = replace(image.camera, principal_point_px=(columns - 1 - column, rows - 1 - row))
    return replace(
        image,
        attenuation=image.attenuation.rot90(2),
        landmarks=last - image.landmarks,
        labels=image.labels.rot90(2),
        camera=camera,
        camera_from_lps=half_turn @ image.camera_from_lps,
    )


def inverted(image: LabelledImage) -> LabelledImage:
    """Raw intensities inverted between their extremes before the logarithm, as by a wrong window of the display."""
    raw = torch.exp(-image.attenuation.double())
    exchanged = (raw.max() + raw.min() - raw).clamp_min(1e-3 * raw.max().item())
    return replace(image, attenuation=-torch.log(exchanged).float())


def cropped_to_one_hip(image: LabelledImage) -> LabelledImage:
    """Shutters leave the side that shows more landmarks; what they cover is as dark as the densest part."""
    columns = image.camera.shape[1]
    keep = round(_NARROW * columns)
    right = image.landmarks[image.visible, 0].median() > (columns - 1) / 2 if image.visible.any() else True
    low = columns - keep if right else 0
    covered = (torch.arange(columns) < low) | (torch.arange(columns) >= low + keep)
    attenuation = image.attenuation.masked_fill(covered, image.attenuation.max().item())
    hidden = (image.landmarks[:, 0] < low) | (image.landmarks[:, 0] >= low + keep)
    labels = image.labels.masked_fill(covered[_columns_of_labels(image).clamp(0, columns - 1)], 0)
    return replace(image, attenuation=attenuation, labels=labels, visible=image.visible & ~hidden)


def _columns_of_labels(image: LabelledImage) -> Tensor:
    """The image's column below each column of its labels (w,), which lie on the network's grid or on half of it."""
    width = image.labels.shape[1]
    columns = (torch.arange(width, dtype=torch.float64) + 0.5) * (NETWORK_SIZE / width) - 0.5
    return image_from_network(torch.stack([columns, columns], -1), image.camera)[:, 0].round().long()


ALTERATIONS: dict[str, Callable[[LabelledImage], LabelledImage]] = {
    "turned by 180°": turned,
    "grey values inverted": inverted,
    "cropped to one hip": cropped_to_one_hip,
}


@dataclass(frozen=True)
class Outcomes:
    """What became of the start poses that were asked for."""

    good: int
    refused: int
    silent_failures: int


def outcomes(readings: Iterable[Reading]) -> Outcomes:
    """Numbers of start poses within 10°, 20 mm and 100 mm, of refusals, and of other poses that were given."""
    asked = [reading for reading in readings if reading.asked]
    refused = sum(reading.refused for reading in asked)
    good = sum(bool((reading.pose_error < COARSE).all()) for reading in asked)
    return Outcomes(good, refused, len(asked) - refused - good)
