"""Batches of augmented views from the cache: the same number always gives the same batch."""

from collections.abc import Iterator, Sequence
from pathlib import Path

import torch
from lightning import LightningDataModule
from safetensors import safe_open
from torch import Tensor
from torch.utils.data import DataLoader, Dataset, Sampler

from training.augmentation import AugmentationSettings, Batch, make_batch
from training.cohort import Cohort
from training.devices import read_devices

_LAYERS = ("tissue", "bones", "labels", "landmarks")


class ViewBatches(Dataset[Batch]):
    """Batch k, drawn from all files and augmented by a generator seeded with (seed, k)."""

    def __init__(
        self,
        files: Sequence[Path],
        batch_size: int,
        settings: AugmentationSettings,
        seed: int,
        length: int,
        devices: Tensor | None = None,
    ) -> None:
        self.files, self.batch_size, self.settings, self.seed, self.length = files, batch_size, settings, seed, length
        self.devices = devices
        self._open: dict[Path, safe_open] = {}  # opened by the process that reads

    def __len__(self) -> int:
        return self.length

    def __getitem__(self, number: int) -> Batch:
        generator = torch.Generator().manual_seed(self.seed * 1_000_003 + number)
        files = torch.randint(len(self.files), (self.batch_size,), generator=generator).tolist()
        views = [self._view(self.files[n], generator) for n in files]
        tissue, bones, labels, landmarks = (torch.stack(layer) for layer in zip(*views, strict=True))
        return make_batch(tissue, bones, labels, landmarks, self.settings, generator, self.devices)

    def _view(self, file: Path, generator: torch.Generator) -> list[Tensor]:
        if file not in self._open:
            self._open[file] = safe_open(file, "pt")
        slices = [self._open[file].get_slice(name) for name in _LAYERS]
        n = int(torch.randint(slices[0].get_shape()[0], (1,), generator=generator))
        return [layer[n] for layer in slices]


class _Consecutive(Sampler[int]):
    """Batch numbers of one epoch, so that no two epochs see the same batch, dealt out among `world` processes."""

    def __init__(self, epoch: int, length: int, rank: int, world: int) -> None:
        self.numbers = range(epoch * length, (epoch + 1) * length)[rank : length - length % world : world]

    def __len__(self) -> int:
        return len(self.numbers)

    def __iter__(self) -> Iterator[int]:
        return iter(self.numbers)


class ViewData(LightningDataModule):
    """Training batches without end, and the same few validation batches every time."""

    def __init__(
        self,
        cohort: Cohort,
        settings: AugmentationSettings,
        batch_size: int,
        batches_per_epoch: int,
        validation_batches: int,
        workers: int,
        seed: int,
    ) -> None:
        super().__init__()
        self.workers, self.batches_per_epoch = workers, batches_per_epoch
        devices = None if cohort.devices is None else read_devices(cohort.devices)
        self.training = ViewBatches(cohort.training, batch_size, settings, seed, batches_per_epoch, devices)
        self.validation = ViewBatches(cohort.validation, batch_size, settings, seed + 1, validation_batches, devices)

    def train_dataloader(self) -> DataLoader[Batch]:
        if self.trainer is None:
            rank, world, epoch = 0, 1, 0
        else:
            rank, world, epoch = self.trainer.global_rank, self.trainer.world_size, self.trainer.current_epoch
        sampler = _Consecutive(epoch, self.batches_per_epoch, rank, world)
        return DataLoader(self.training, batch_size=None, sampler=sampler, num_workers=self.workers)

    def val_dataloader(self) -> DataLoader[Batch]:
        return DataLoader(self.validation, batch_size=None, num_workers=self.workers)
