"""The settings of a training run: one YAML file, four groups, single values overridden by `key=value`."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from jsonargparse import ArgumentError, ArgumentParser

from femoreg_torch.errors import InputError
from models.unet import UNetConfig
from training.augmentation import AugmentationSettings
from training.cohort import CohortSettings
from training.module import OptimisationSettings

Precision = Literal["32-true", "bf16-mixed", "16-mixed"]  # as Lightning calls them


@dataclass(frozen=True)
class TrainingSettings:
    """What the YAML file holds: the four groups, and who may use how much of the machine."""

    cohort: CohortSettings
    network: UNetConfig
    augmentation: AugmentationSettings
    optimisation: OptimisationSettings
    seed: int
    threads: int  # of the training process
    workers: int  # processes that make batches
    precision: Precision  # bf16-mixed halves the time on CPUs that know bf16


def read_settings(path: Path, overrides: Sequence[str] = ()) -> TrainingSettings:
    """Settings from a YAML file, then from `group.key=value` texts.

    Raises `InputError` for a missing file, an unknown key or a value of the wrong kind.
    """
    if not path.is_file():
        raise InputError(f"{path}: no such file. Shipped training settings stand in configs/training/.")
    parser = ArgumentParser(exit_on_error=False)
    parser.add_argument("--file", action="config")
    groups = {
        "cohort": CohortSettings,
        "network": UNetConfig,
        "augmentation": AugmentationSettings,
        "optimisation": OptimisationSettings,
    }
    for name, group in groups.items():
        parser.add_class_arguments(group, name)
    for name, default in {"seed": 1, "threads": 1, "workers": 1}.items():
        parser.add_argument(f"--{name}", type=int, default=default)
    parser.add_argument("--precision", type=Precision, default="32-true")
    try:
        parsed = parser.parse_args([f"--file={path}", *(f"--{override}" for override in overrides)])
    except ArgumentError as error:
        raise InputError(f"{path}: {str(error).rstrip('. ')}.") from error
    values = parser.instantiate(parsed)
    return TrainingSettings(**{name: values[name] for name in (*groups, "seed", "threads", "workers", "precision")})
