"""What a network sees during training, as pictures in TensorBoard."""

import numpy as np
from lightning import LightningModule, Trainer
from lightning.pytorch.callbacks import Callback
from lightning.pytorch.loggers import TensorBoardLogger
from numpy.typing import NDArray
from torch import Tensor

from femoreg_torch.anatomy import HIP
from femoreg_torch.detect import decode_heatmaps
from femoreg_torch.detect.network import VISIBLE
from femoreg_torch.detect.overlay import class_colours
from models.protocols import Prediction
from training.augmentation import Batch

_SHOWN = 4
_CONTRAST = 2.5  # standard deviations of grey on either side of the mean


class Pictures(Callback):
    """The first images of the first validation batch: bones and landmarks, truth above and prediction below."""

    def on_validation_batch_end(  # type: ignore[override]
        self, trainer: Trainer, pl_module: LightningModule, outputs: dict[str, Tensor], batch: Batch, batch_idx: int
    ) -> None:
        if batch_idx or trainer.sanity_checking or not trainer.is_global_zero:
            return
        for logger in trainer.loggers:
            if isinstance(logger, TensorBoardLogger):
                picture = draw_batch(batch, Prediction(**outputs), _SHOWN)
                logger.experiment.add_image("validation", picture, trainer.global_step, dataformats="HWC")


def draw_batch(batch: Batch, prediction: Prediction, count: int) -> NDArray[np.uint8]:
    """RGB picture of `count` images side by side; truth above, prediction below."""
    columns = []
    for n in range(min(count, len(batch.images))):
        heatmaps, absence = prediction.heatmaps[n].float().cpu(), prediction.absence[n].float().cpu()
        positions, confidence = decode_heatmaps(heatmaps, absence)
        labels = prediction.segmentation[n].argmax(0).cpu()
        image = batch.images[n, 0].cpu()
        truth = _draw(image, batch.labels[n].cpu(), batch.landmarks[n].cpu()[batch.visible[n].cpu()])
        columns.append(np.vstack([truth, _draw(image, labels, positions[confidence >= VISIBLE])]))
    return np.hstack(columns).astype(np.uint8)


def _draw(image: Tensor, labels: Tensor, landmarks: Tensor) -> NDArray[np.float64]:
    """Image (H, W) with bones (H / 2, W / 2) tinted and landmarks (N, 2), in pixels of the labels, as 3 × 3 dots."""
    grey = (image / _CONTRAST + 1).clamp(0, 2).numpy()[..., None] * 127.5
    fine = labels.repeat_interleave(2, 0).repeat_interleave(2, 1).numpy()
    picture = 0.75 * grey + 0.25 * class_colours(HIP)[fine]
    for column, row in (2 * landmarks + 0.5).round().int().tolist():
        picture[max(0, row - 1) : row + 2, max(0, column - 1) : column + 2] = (255, 255, 255)
    return np.asarray(picture)
