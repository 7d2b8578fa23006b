"""One training run from settings to exported weights."""

import json
import logging
import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from lightning import Trainer, seed_everything
from lightning.pytorch.callbacks import (
    Callback,
    EarlyStopping,
    EMAWeightAveraging,
    ProgressBar,
    RichProgressBar,
    TQDMProgressBar,
)
from lightning.pytorch.loggers import CSVLogger, TensorBoardLogger
from rich.console import Console
from torch import nn

from femoreg_torch.anatomy import HIP
from femoreg_torch.case import case_folder
from femoreg_torch.detect import load_network
from femoreg_torch.detect.grid import NETWORK_SIZE
from femoreg_torch.errors import InputError
from femoreg_torch.files import clear_leftovers, read_json, temporary_file, write_json
from models.weights import SHIPPED_WEIGHTS, Weights, save_weights
from training.card import write_card
from training.checkpoints import BestCheckpoint, WholeCheckpoints, last_good_checkpoint, read_checkpoint
from training.cohort import render_cohort
from training.curves import draw_curves
from training.data import ViewData
from training.module import NetworkTraining
from training.pictures import Pictures
from training.settings import TrainingSettings

_MONITORED = "validation/loss"
_CSV, _TENSORBOARD = "csv", "tensorboard"  # folders of logs
_SETTINGS = "settings.json"


@dataclass(frozen=True)
class Machine:
    """Where to train, in Lightning's words."""

    accelerator: str = "cpu"  # or cuda
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
    `start` names weights to begin with, see `begin_with`. Raises `InputError` if `out` holds a run and `resume` is
    false, or has none to resume, or if `start` does not fit.
    """
    console = Console()
    cases = [case_folder(case) for case in cases]  # by their names patients are told apart, and looked up
    if any("\ud800" <= letter <= "\udfff" for letter in str(out)):  # how Python holds bytes that are no letters
        raise InputError(f"{out}: the name of this folder is not UTF-8, which logs need. Choose another one.")
    last = out / "checkpoints" / "last.ckpt"
    if resume and not any(last.parent.glob("*.ckpt")):
        raise InputError(f"{last}: no such file, so there is nothing to resume. Leave out --resume.")
    if not resume and any(last.parent.glob("*.ckpt")):
        raise InputError(f"{out}: holds a training run. Continue it with --resume, or choose another folder.")
    if resume and start is not None:
        raise InputError("--start: a run that is resumed goes on with its own weights. Leave out --start or --resume.")
    _check_machine(machine)
    run = settings.run
    about = {**settings.as_content(), "cases": [case.resolve().name for case in cases]}
    resumed = None
    if resume:
        like = NetworkTraining(settings.network, settings.loss, run.optimisation)
        resumed, epochs = last_good_checkpoint(last.parent, like, console.print)
        _check_same_run(out / _SETTINGS, about)
        if epochs > run.optimisation.epochs:
            raise InputError(
                f"--resume: this run has had {epochs} epochs, and the settings ask for {run.optimisation.epochs}. Ask "
                f"for more, as --override '[optimisation.epochs={epochs + 1}]' does."
            )
        left = run.optimisation.epochs - epochs
        console.print(f"After {epochs} epochs, {left} are left." if left else "All epochs are done.", markup=False)
    elif start is not None:
        begin_with(start, settings.network.build())  # complains before anything is rendered
    logging.getLogger("lightning.pytorch").setLevel(logging.WARNING)  # or advice of its own stands on stderr
    torch.set_num_threads(run.threads)
    cohort = render_cohort(run.cohort, cases, cache, console.print)
    for name in () if resume else (_CSV, _TENSORBOARD):  # of a run that was killed before its first checkpoint
        shutil.rmtree(out / name, ignore_errors=True)
    clear_leftovers(last.parent)
    out.mkdir(parents=True, exist_ok=True)
    write_json(out / _SETTINGS, about)
    seed_everything(run.seed, verbose=False)
    optimisation = run.optimisation
    data = ViewData(
        cohort,
        run.augmentation,
        optimisation.batch_size,
        optimisation.batches_per_epoch,
        optimisation.validation_batches,
        run.workers,
        run.seed,
    )
    module = NetworkTraining(settings.network, settings.loss, optimisation)
    if start is not None and not resume:
        begin_with(start, module.network)
    best = BestCheckpoint(
        out / "checkpoints",
        "best",
        monitor=_MONITORED if cohort.validation else None,
        save_last=True,
        enable_version_counter=False,
    )
    callbacks: list[Callback] = [best, EMAWeightAveraging(decay=optimisation.averaging), Pictures()]
    callbacks.append(progress_bar(console))
    if cohort.validation and optimisation.patience:
        callbacks.append(EarlyStopping(_MONITORED, patience=optimisation.patience))
    trainer = Trainer(
        accelerator=machine.accelerator,
        devices=machine.devices,
        num_nodes=machine.nodes,
        precision=run.precision,
        max_epochs=optimisation.epochs,
        reload_dataloaders_every_n_epochs=1,
        use_distributed_sampler=False,
        logger=[CSVLogger(out, _CSV), TensorBoardLogger(out, _TENSORBOARD, version="")],
        callbacks=callbacks,
        plugins=[WholeCheckpoints()],
        enable_model_summary=False,
        log_every_n_steps=min(25, optimisation.batches_per_epoch),
        limit_val_batches=1.0 if cohort.validation else 0,
    )
    if machine.nodes > 1:
        console.print(f"Waiting until the command runs on all of {machine.nodes} machines.")
    try:
        trainer.fit(module, data, ckpt_path=resumed)
    except SystemExit as stopped:  # how Lightning ends on Ctrl-C, and where the system ends it
        kept = "go on with --resume" if any(last.parent.glob("*.ckpt")) else "no epoch had ended, so nothing is kept"
        raise KeyboardInterrupt(f"interrupted; {kept}.") from stopped
    except OSError as error:
        if error.filename is None and error.errno is not None:  # the system does not say for which file
            raise OSError(error.errno, error.strerror, str(out)) from error
        raise
    if not trainer.is_global_zero:  # one process writes
        return out / SHIPPED_WEIGHTS
    draw_curves(out / _TENSORBOARD, out / "curves.png")
    weights = export_weights(Path(best.best_model_path), settings, out / SHIPPED_WEIGHTS)
    write_card(out / "card.md", settings, cases, out / _TENSORBOARD, trainer.current_epoch)
    console.print(f"Weights written to {weights}", markup=False, soft_wrap=True)
    return weights


def _check_same_run(file: Path, about: dict[str, Any]) -> None:
    """Raises `InputError` if a run was begun with another network, loss, patients or images than `about` tells."""
    begun = read_json(file) if file.exists() else {}
    now = json.loads(json.dumps(about))
    for group in ("network", "loss", "cohort", "cases"):
        if begun.get(group, now[group]) != now[group]:
            raise InputError(
                f"--resume: the settings of this run, {file}, have another `{group}` than those that were given. "
                "Resume it with its own, or begin another run from its weights with --start."
            )


def _check_machine(machine: Machine) -> None:
    """Raises `InputError` for accelerators that this machine does not have."""
    there = torch.cuda.device_count() if torch.cuda.is_available() else 0
    if machine.accelerator == "cuda" and there < machine.devices:
        raise InputError(
            f"--device cuda: {machine.devices} GPUs were asked for, torch sees {there}. "
            "Train on the CPU, or see what `femoreg doctor` says."
        )


def progress_bar(console: Console) -> ProgressBar:
    """Lightning's bar for a terminal; in a Jupyter notebook, where that one fails, the plain one."""
    return TQDMProgressBar(refresh_rate=25) if console.is_jupyter else EpochBar(refresh_rate=25)


class EpochBar(RichProgressBar):
    """Lightning's bar, which would count epochs from 0, so that a run of two ended at "Epoch 1/1"."""

    def _get_train_description(self, current_epoch: int) -> str:
        description = f"Epoch {current_epoch + 1}/{self.trainer.max_epochs}"
        return description.ljust(len(self.validation_description))  # or the bars would jump


def begin_with(path: Path, network: nn.Module) -> None:
    """Copy the weights of a file into a new network.

    The network may have more than the file, as long as it then computes the same function: residual blocks that start
    as the identity, say. Raises `InputError` if it does not.
    """
    start = load_network(path).module
    mode = network.training
    image = torch.randn((1, 1, NETWORK_SIZE, NETWORK_SIZE), generator=torch.Generator().manual_seed(0))
    try:
        network.load_state_dict({**network.state_dict(), **start.state_dict()})
        with torch.inference_mode():
            for found, expected in zip(network.eval()(image), start(image), strict=True):
                torch.testing.assert_close(found, expected, rtol=1e-3, atol=1e-3)
    except (RuntimeError, AssertionError) as error:
        reason = " ".join(str(error).split())[:200]
        raise InputError(f"{path}: the network of the settings is not that of these weights ({reason}).") from error
    network.train(mode)


def export_weights(checkpoint: Path, settings: TrainingSettings, path: Path) -> Path:
    """Write the averaged weights of a checkpoint as safetensors."""
    content = read_checkpoint(checkpoint)
    module = NetworkTraining(settings.network, settings.loss, settings.run.optimisation)
    module.load_state_dict(content["state_dict"])
    known = settings.as_content()
    network = {key: value for key, value in known["network"].items() if key != "kind"}
    state = module.network.state_dict()
    weights = Weights(settings.network_kind, network, HIP.name, settings.loss.sigma_px, state)
    data = {key: value for key, value in known["cohort"].items() if key != "ranges"}  # what the weights have seen
    about = {
        "step": str(content["global_step"]),
        "seed": str(settings.run.seed),
        "data": json.dumps(data),
        "loss": json.dumps(known["loss"]),
    }
    with temporary_file(path) as part:
        save_weights(part, weights, about)
    return path
