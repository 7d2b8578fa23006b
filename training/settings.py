"""The settings of a training run: a preset or YAML file of five groups, single values overridden by `key=value`."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from typing import Any, Final, Literal

from femoreg_torch.configs import laid_over, load_preset

from femoreg_torch.anatomy import HIP
from femoreg_torch.detect.weights import NETWORKS_GROUP, check_counts
from femoreg_torch.errors import InputError, shortened
from femoreg_torch.extensions import pop_kind, read_kind
from femoreg_torch.settings import SEEDS, check_within, read_record
from femoreg_torch.text import yaml_content
from models.kinds import LOSSES, NETWORKS
from models.protocols import Loss, Network
from training.augmentation import AugmentationSettings
from training.cohort import CohortSettings
from training.module import OptimisationSettings

LOSSES_GROUP: Final = "femoreg_torch.losses"  # entry points of other packages' losses, see `models.protocols`

_COUNTS = {"classes": 1 + len(HIP.bones), "landmarks": len(HIP.landmarks)}  # of the background and the bones

Precision = Literal["32-true", "bf16-mixed", "16-mixed"]  # as Lightning calls them


@dataclass(frozen=True)
class Run:
    """How a network of any kind is trained, and how much of the machine it may use."""

    cohort: CohortSettings
    optimisation: OptimisationSettings
    augmentation: AugmentationSettings = field(default_factory=AugmentationSettings)
    seed: int = 1
    threads: int = 1  # of the training process
    workers: int = 1  # processes that make batches
    precision: Precision = "32-true"  # bf16-mixed halves the time on CPUs that know bf16

    def __post_init__(self) -> None:
        check_within(self, seed=SEEDS, threads=(1, 1024), workers=(0, 1024))


@dataclass(frozen=True)
class TrainingSettings:
    """What is trained, by which loss, and how."""

    network_kind: str
    network: Network
    loss_kind: str
    loss: Loss
    run: Run

    def as_content(self) -> dict[str, Any]:
        """The settings as they stand in a YAML file, defaults included."""
        values = asdict(self)
        kinds = {"network": self.network_kind, "loss": self.loss_kind}
        return {**{name: {"kind": kind, **values[name]} for name, kind in kinds.items()}, **values["run"]}


def read_settings(name: str, overrides: Sequence[str] = ()) -> TrainingSettings:
    """Settings of a preset in `configs/training/` or of a YAML file, then of `group.key=value` texts.

    The network has the classes and heat maps of the hip. Raises `InputError` for a missing file, an unknown key or
    kind, and a value of the wrong type.
    """
    where = f"training settings {name}"
    content = load_preset("training", name)
    for override in overrides:
        content = laid_over(content, _override(override), f"{where}, {shortened(override)}")
    network, loss = (content.pop(group, None) for group in ("network", "loss"))
    network_kind, _ = pop_kind(network, f"{where}, network")
    loss_kind, _ = pop_kind(loss, f"{where}, loss")
    chosen = read_kind(NETWORKS_GROUP, NETWORKS, {**_COUNTS, **network}, f"{where}, network")
    check_counts(chosen.classes, chosen.landmarks, HIP, f"{where}, network")
    return TrainingSettings(
        network_kind=network_kind,
        network=chosen,
        loss_kind=loss_kind,
        loss=read_kind(LOSSES_GROUP, LOSSES, loss, f"{where}, loss"),
        run=read_record(Run, content, where),
    )


def _override(text: str) -> dict[str, Any]:
    """What `group.key=value` says, as the content of a settings file."""
    path, equals, value = text.partition("=")
    if not equals:
        raise InputError(
            f"--override {shortened(text)}: group.key=value was expected, for instance optimisation.epochs=3."
        )
    change = yaml_content(value, f"--override {shortened(text)}")
    for key in reversed(path.split(".")):
        change = {key: change}
    return change
