"""One training run from settings to exported weights."""

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import torch
from lightning import Trainer, seed_everything
from lightning.pytorch.callbacks import (
    Callback,
    EarlyStopping,
    EMAWeightAveraging,
    ModelCheckpoint,
    RichProgressBar,
)
from lightning.pytorch.loggers import CSVLogger, TensorBoardLogger
from rich.console import Console

from femoreg_torch.errors import InputError
from femoreg_torch.files import temporary_file, write_json
from models.reference import ReferenceUNet
from models.unet import UNet
from models.weights import SHIPPED_WEIGHTS, load_weights, save_weights
from training.cohort import render_cohort
from training.curves import draw_curves
from training.data import ViewData
from training.module import HipTraining
from training.pictures import Pictures
from training.settings import TrainingSettings

_MONITORED = "validation/loss"


@dataclass(frozen=True)
class Machine:
    """Where to train, in Lightning's words."""

    accelerator: str = "cpu"  # or cuda, auto
    devices: int = 1  # per node
    nodes: int = 1


ONE_CPU = Machine()


def train_network(
    settings: TrainingSettings,
    cases: Sequence[Path],
    out: Path,
    cache: Path,
    start: Path | None = None,
    resume: bool = False,
    machine: Machine = ONE_CPU,
) -> Path:
    """Render what is missing in `cache`, train, and return the path of the exported weights in `out`.

    The weights exported are the ones of lowest validation loss or, without patients to validate on, the last ones.
    `start` names weights to begin with; a network that only has more residual blocks begins as the same function.
    Raises `InputError` if `out` holds a run and `resume` is false, or has none to resume, or if `start` does not
    fit.
    """
    console = Console()
    last = out / "checkpoints" / "last.ckpt"
    if resume and not last.is_file():
        raise InputError(f"{last}: no such file, so there is nothing to resume. Leave out --resume.")
    if last.is_file() and not resume:
        raise InputError(f"{out}: holds a training run. Continue it with --resume, or choose another folder.")
    torch.set_num_threads(settings.threads)
    cohort = render_cohort(settings.cohort, cases, cache, console.print)
    out.mkdir(parents=True, exist_ok=True)
    write_json(out / "settings.json", {**asdict(settings), "cases": [case.resolve().name for case in cases]})
    seed_everything(settings.seed)
    optimisation = settings.optimisation
    data = ViewData(
        cohort,
        settings.augmentation,
        optimisation.batch_size,
        optimisation.batches_per_epoch,
        optimisation.validation_batches,
        settings.workers,
        settings.seed,
    )
    module = HipTraining(settings.network, optimisation)
    if start is not None and not resume:
        _begin_with(start, module.network)
    best = ModelCheckpoint(
        out / "checkpoints",
        "best",
        monitor=_MONITORED if cohort.validation else None,
        save_last=True,
        enable_version_counter=False,
    )
    callbacks: list[Callback] = [best, EMAWeightAveraging(decay=optimisation.averaging), Pictures()]
    callbacks.append(RichProgressBar(refresh_rate=25))
    if cohort.validation and optimisation.patience:
        callbacks.append(EarlyStopping(_MONITORED, patience=optimisation.patience))
    trainer = Trainer(
        accelerator=machine.accelerator,
        devices=machine.devices,
        num_nodes=machine.nodes,
        precision=settings.precision,
        max_epochs=optimisation.epochs,
        reload_dataloaders_every_n_epochs=1,
        use_distributed_sampler=False,
        logger=[CSVLogger(out, "csv"), TensorBoardLogger(out, "tensorboard", version="")],
        callbacks=callbacks,
        enable_model_summary=False,
        log_every_n_steps=min(25, optimisation.batches_per_epoch),
        limit_val_batches=1.0 if cohort.validation else 0,
    )
    trainer.fit(module, data, ckpt_path=last if resume else None)
    if not trainer.is_global_zero:  # one process writes
        return out / SHIPPED_WEIGHTS
    draw_curves(out / "tensorboard", out / "curves.png")
    return export_weights(Path(best.best_model_path), settings, out / SHIPPED_WEIGHTS)


def _begin_with(path: Path, network: UNet | ReferenceUNet) -> None:
    """Copy the weights of a file; residual blocks that the file lacks stay the identity they begin as."""
    try:
        start = load_weights(path)
    except (OSError, ValueError) as error:
        raise InputError(str(error)) from error
    if replace(start.config, residual=network.config.residual) != network.config:
        raise InputError(f"{path}: these weights are of {start.config}, but the settings ask for {network.config}.")
    network.load_state_dict({**network.state_dict(), **start.state_dict()})


def export_weights(checkpoint: Path, settings: TrainingSettings, path: Path) -> Path:
    """Write the averaged weights of a checkpoint as safetensors."""
    content = torch.load(checkpoint, weights_only=True)
    module = HipTraining(settings.network, settings.optimisation)
    module.load_state_dict(content["state_dict"])
    about = {"step": str(content["global_step"]), "seed": str(settings.seed), "data": json.dumps(_data(settings))}
    with temporary_file(path) as part:
        save_weights(part, module.network, about)
    return path


def _data(settings: TrainingSettings) -> dict[str, object]:
    """What the weights have seen, for the metadata."""
    return {key: value for key, value in asdict(settings.cohort).items() if key != "ranges"}
