"""How well a network reads views of patients it has not seen."""

from collections.abc import Iterable
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from femoreg_torch.detect import decode_heatmaps
from femoreg_torch.detect.grid import NETWORK_PIXEL_MM
from femoreg_torch.detect.network import VISIBLE
from training.augmentation import Batch

_OUTPUT_MM = 2 * NETWORK_PIXEL_MM  # pixel of the network's output on the detector
_GROSS_MM = 20.0


@dataclass(frozen=True)
class Accuracy:
    """Errors are on the detector, in mm, of landmarks that are in the image and were found there; nan if none was."""

    median_mm: float
    mean_mm: float
    p90_mm: float
    gross_share: float  # of the found ones, further than 20 mm away
    recall: float  # found of those in the image
    false_share: float  # found of those not in the image
    dice: dict[int, float]  # label → overlap of all pixels of all images
    median_mm_of: list[float]  # per landmark


@torch.inference_mode()
def measure(network: nn.Module, batches: Iterable[Batch], visible_from: float = VISIBLE) -> Accuracy:
    """Accuracy of `network` over batches; a landmark counts as found from a confidence of `visible_from`."""
    errors, found, there = [], [], []
    overlap, total = torch.zeros(7), torch.zeros(7)
    for batch in batches:
        prediction = network(batch.images)
        labels = prediction.segmentation.argmax(1)
        for label in range(1, 7):
            a, b = labels == label, batch.labels == label
            overlap[label] += 2 * (a & b).sum()
            total[label] += a.sum() + b.sum()
        for n in range(len(batch.images)):
            positions, confidence = decode_heatmaps(prediction.heatmaps[n], prediction.absence[n])
            errors.append((positions - batch.landmarks[n]).norm(dim=1) * _OUTPUT_MM)
            found.append(confidence >= visible_from)
            there.append(batch.visible[n])
    error, seen, present = torch.stack(errors), torch.stack(found), torch.stack(there)
    return _summary(error, seen, present, overlap, total)


def _summary(error: Tensor, seen: Tensor, present: Tensor, overlap: Tensor, total: Tensor) -> Accuracy:
    counted = seen & present
    hits = error[counted] if counted.any() else torch.full((1,), torch.nan)
    return Accuracy(
        median_mm=hits.median().item(),
        mean_mm=hits.mean().item(),
        p90_mm=hits.quantile(0.9).item(),
        gross_share=(hits > _GROSS_MM).double().mean().item(),
        recall=(counted.sum() / present.sum()).item(),
        false_share=((seen & ~present).sum() / (~present).sum()).item(),
        dice={n: (overlap[n] / total[n]).item() for n in range(1, 7) if total[n] > 0},
        median_mm_of=error.where(counted, torch.nan).nanmedian(0).values.tolist(),
    )
