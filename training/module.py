"""The Lightning module: a network, its loss and its optimiser."""

import math
from dataclasses import dataclass

import torch
from lightning import LightningModule
from lightning.pytorch.utilities.types import OptimizerLRSchedulerConfig
from torch import Tensor

from femoreg_torch.settings import check_within
from models.protocols import Loss, Network, Prediction
from training.augmentation import Batch


@dataclass(frozen=True)
class OptimisationSettings:
    """AdamW over `epochs` of `batches_per_epoch` batches: a warm-up, a constant learning rate, and a cool-down.

    Hägele et al. 2024 (arXiv 2405.18392) find it as good as a cosine's decay. A longer run begins as a shorter one
    does. So a run that is resumed with more epochs before its cool-down equals one that was planned so from the start.
    """

    epochs: int
    batches_per_epoch: int = 250
    validation_batches: int = 15
    batch_size: int = 8
    learning_rate: float = 2e-3
    weight_decay: float = 1e-3
    warm_up: int = 500  # steps, but at most a tenth of all
    cool_down: float = 0.3  # share of all steps
    averaging: float = 0.998  # decay of the moving average of the weights that is validated and exported
    patience: int = 0  # epochs without a better validation loss before training stops early; 0: never

    def __post_init__(self) -> None:
        check_within(
            self,
            epochs=(1, 100_000),
            batches_per_epoch=(1, 1_000_000),
            validation_batches=(1, 1_000_000),
            batch_size=(1, 4096),
            learning_rate=(1e-9, 10),
            weight_decay=(0, 10),
            warm_up=(0, 1_000_000),
            cool_down=(0, 1),
            averaging=(0, 0.999_999),
            patience=(0, 100_000),
        )


def landmark_errors_px(prediction: Prediction, landmarks: Tensor, visible: Tensor) -> Tensor:
    """Distance (N,) from the highest pixel of the heat map to each visible landmark, in output pixels."""
    width = prediction.heatmaps.shape[3]
    best = prediction.heatmaps.flatten(2).argmax(-1)
    found = torch.stack([best % width, best // width], -1)
    return (found - landmarks).norm(dim=-1)[visible]


class NetworkTraining(LightningModule):
    """Trains a network on `Batch`es; logs the loss and its parts, landmark errors, visibility and overlap."""

    def __init__(self, network: Network, loss: Loss, settings: OptimisationSettings) -> None:
        super().__init__()
        self.network = network.build().to(memory_format=torch.channels_last)
        self.loss = loss
        self.settings = settings

    def _losses(self, batch: Batch) -> tuple[Prediction, dict[str, Tensor]]:
        prediction = self.network(batch.images)
        return prediction, self.loss(prediction, batch.labels, batch.landmarks, batch.visible)

    def training_step(self, batch: Batch, _number: int) -> Tensor:
        _, losses = self._losses(batch)
        self.log_dict({f"train/{name}": value for name, value in losses.items()}, batch_size=len(batch.images))
        return losses["loss"]

    def validation_step(self, batch: Batch, _number: int) -> dict[str, Tensor]:
        prediction, losses = self._losses(batch)
        seen = prediction.heatmaps.float().flatten(2).logsumexp(-1) > prediction.absence.float()
        correct = (seen == batch.visible).float().mean()
        overlap = (prediction.segmentation.argmax(1) == batch.labels).float().mean()
        values = {f"validation/{name}": value for name, value in losses.items()}
        errors = landmark_errors_px(prediction, batch.landmarks, batch.visible)
        values |= {
            "validation/landmark_median_px": errors.median(),
            "validation/landmark_within_2px": (errors < 2).float().mean(),
            "validation/visibility": correct,
            "validation/pixel_accuracy": overlap,
        }
        self.log_dict(values, batch_size=len(batch.images), sync_dist=True)
        self.log("loss", losses["loss"], logger=False, prog_bar=True, sync_dist=True)  # more fits into no terminal
        return prediction._asdict()

    def configure_optimizers(self) -> OptimizerLRSchedulerConfig:
        s = self.settings
        optimiser = torch.optim.AdamW(self.parameters(), s.learning_rate, weight_decay=s.weight_decay)
        schedule = torch.optim.lr_scheduler.LambdaLR(optimiser, self._rate)
        return {"optimizer": optimiser, "lr_scheduler": {"scheduler": schedule, "interval": "step"}}

    def _rate(self, step: int) -> float:
        """Share of the learning rate: linear warm-up, one, and 1 − √x in the cool-down, down to one per cent."""
        s = self.settings
        steps = s.epochs * (s.batches_per_epoch // self.trainer.world_size)
        cooled = max(0.0, 1 - (steps - step) / max(1e-9, s.cool_down * steps))
        warm_up = max(1.0, min(s.warm_up, 0.1 * steps))
        return max(0.01, min((step + 1) / warm_up, 1 - math.sqrt(min(1.0, cooled))))
