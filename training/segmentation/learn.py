"""The training of the network that labels bones in a CT: settings, loop, checkpoints, exported weights."""

import csv
import json
import math
import random
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import torch
from femoreg_torch.configs import load_preset
from torch import Tensor, nn
from torch.nn import functional as F
from torch.optim.swa_utils import AveragedModel, get_ema_multi_avg_fn

from femoreg_torch.anatomy import HIP
from femoreg_torch.arrays import quiet
from femoreg_torch.errors import InputError
from femoreg_torch.files import temporary_file, write_json
from femoreg_torch.segment.network import network_input, padded_to
from femoreg_torch.settings import SEEDS, check_within, read_record
from models.volume_unet import VolumeUNetSettings
from models.weights import Weights, save_weights
from training.segmentation.scans import Scan, ScanSettings, random_scan
from training.segmentation.shapes import BoneShape, cached_shapes, check_shapes

WEIGHTS_NAME = "bones6.safetensors"
_WARM_UP = 50  # steps with a rising learning rate
_FIRST_BACKGROUND = 0.1  # weight of the background at first, so that the bones are learned soon; 1 at the end
_VALIDATION_SCANS = 8
_VALIDATION_SEED = 10**6  # far from the seeds of training
_KEPT = 40  # scans that wait to be used again


@dataclass(frozen=True)
class _NetworkShape:
    channels: list[int] = field(default_factory=lambda: list(VolumeUNetSettings(2).channels))


@dataclass(frozen=True)
class _ScanRanges:
    voxel_mm: float = 3.0
    sizes: list[list[int]] = field(default_factory=lambda: [list(pair) for pair in ScanSettings().sizes])


@dataclass(frozen=True)
class SegmentationSettings:
    """A training run."""

    steps: int
    held_out: list[str]  # names of shapes that only validate
    network: _NetworkShape = field(default_factory=_NetworkShape)
    scans: _ScanRanges = field(default_factory=_ScanRanges)
    learning_rate: float = 2e-3
    averaging: float = 0.99  # of the weights from step to step
    uses: int = 2  # of each random CT; mirrored and with other noise after the first time
    checkpoint_steps: int = 100
    seed: int = 1
    threads: int = 1

    def __post_init__(self) -> None:
        check_within(self, steps=(1, 10**7), checkpoint_steps=(1, 10**6), uses=(1, 100), seed=SEEDS, threads=(1, 1024))

    @property
    def scan_settings(self) -> ScanSettings:
        """How random CTs are drawn."""
        sizes = tuple((int(low), int(high)) for low, high in self.scans.sizes)
        return ScanSettings(voxel_mm=self.scans.voxel_mm, sizes=sizes)

    def build(self) -> nn.Module:
        """A new network."""
        return self.shape.build()

    @property
    def shape(self) -> VolumeUNetSettings:
        """The network's shape."""
        return VolumeUNetSettings(1 + len(HIP.bones), tuple(self.network.channels), self.scans.voxel_mm)


def read_segmentation_settings(name: str) -> SegmentationSettings:
    """Settings of a preset in `configs/segmentation/` or of a YAML file. Raises `InputError`."""
    return read_record(SegmentationSettings, load_preset("segmentation", name), f"training settings {name}")


def resumed(path: Path, network: nn.Module, average: nn.Module, optimiser: torch.optim.Optimizer) -> tuple[int, float]:
    """Take over the state of an earlier run; how many steps it had done, in how many seconds. Raises `InputError`."""
    try:
        with quiet():
            state = torch.load(path, weights_only=True)
        network.load_state_dict(state["network"])
        average.load_state_dict(state["average"])
        optimiser.load_state_dict(state["optimiser"])
        return int(state["step"]), float(state["seconds"])
    except Exception as error:  # of zip, pickle or torch, by where the file is damaged
        reason = " ".join(str(error).split())[:120] or type(error).__name__
        raise InputError(
            f"{path}: is cut off, damaged, or of another network ({reason}). Train anew into another folder."
        ) from error


def train_segmentation(
    settings: SegmentationSettings,
    shapes: list[Path],
    out: Path,
    cache: Path,
    resume: bool,
    tell: Callable[[str], None],
) -> Path:
    """Train on random CTs around the shapes of these files and return the path of the exported weights in `out`.

    Weights (a moving average) and checkpoint are written every `checkpoint_steps`, so a run can be killed and resumed.
    Raises `InputError` if `out` holds a run and `resume` is false, or has none to resume.
    """
    checkpoint, exported = out / "checkpoint.pt", out / WEIGHTS_NAME
    if resume and not checkpoint.is_file():
        raise InputError(f"{checkpoint}: no such file, so there is nothing to resume. Leave out --resume.")
    if checkpoint.is_file() and not resume:
        raise InputError(f"{out}: holds a training run. Continue it with --resume, or choose another folder.")
    check_shapes(shapes, cache)
    torch.set_num_threads(settings.threads)
    out.mkdir(parents=True, exist_ok=True)
    tell(f"reading {len(shapes)} shapes")
    known = cached_shapes(shapes, cache)
    learning = [shape for shape in known if shape.name not in settings.held_out]
    held_out = [shape for shape in known if shape.name in settings.held_out]
    if not learning:
        raise InputError("train-segmentation: no shape is left to learn from; all are held out.")
    names = {"learned_from": [s.name for s in learning], "held_out": [s.name for s in held_out]}
    write_json(out / "settings.json", {**asdict(settings), **names})
    torch.manual_seed(settings.seed)
    network = settings.build()
    average = AveragedModel(network, multi_avg_fn=get_ema_multi_avg_fn(settings.averaging))
    optimiser = torch.optim.AdamW(network.parameters(), lr=settings.learning_rate, weight_decay=1e-3)
    first, seconds = 0, 0.0
    if resume:
        first, seconds = resumed(checkpoint, network, average, optimiser)
    validation = _validation_scans(held_out, settings)
    draw = random.Random(settings.seed * 10**6 + first)
    waiting: list[Scan] = []
    started, losses = time.monotonic(), []
    for step in range(first, settings.steps):
        scan = _next_scan(learning, settings, step, waiting, draw)
        for group in optimiser.param_groups:
            group["lr"] = settings.learning_rate * _rate(step, settings.steps)
        background = _FIRST_BACKGROUND + (1 - _FIRST_BACKGROUND) * (step / settings.steps) ** 2
        losses.append(_learn_from(scan, network, optimiser, settings.shape.multiple, background))
        average.update_parameters(network)
        done = step + 1
        if done % settings.checkpoint_steps == 0 or done == settings.steps:
            spent = seconds + time.monotonic() - started
            dice = mean_dice(average.module, validation, settings.shape.multiple)
            row = {"step": done, "seconds": round(spent), "loss": sum(losses) / len(losses), **dice}
            losses = []
            _append(out / "progress.csv", row)
            tell(
                ", ".join(
                    f"{key} {value:.3f}" if isinstance(value, float) else f"{key} {value}" for key, value in row.items()
                )
            )
            state = {
                "network": network.state_dict(),
                "average": average.state_dict(),
                "optimiser": optimiser.state_dict(),
                "step": done,
                "seconds": spent,
            }
            with temporary_file(checkpoint) as part:
                torch.save(state, part)
            export_segmentation(average.module, settings, names, done, spent, exported)
    return exported


def export_segmentation(
    network: nn.Module,
    settings: SegmentationSettings,
    names: dict[str, list[str]],
    step: int,
    seconds: float,
    path: Path,
) -> None:
    """Write weights as safetensors, with what they were trained on in the file's metadata."""
    state = {name: tensor.half() for name, tensor in network.state_dict().items()}
    content = {
        "classes": 1 + len(HIP.bones),
        "channels": settings.network.channels,
        "voxel_mm": settings.scans.voxel_mm,
    }
    about = {
        "step": str(step),
        "seconds": str(round(seconds)),
        "learned_from": json.dumps(names["learned_from"]),
        "held_out": json.dumps(names["held_out"]),
        "seed": str(settings.seed),
    }
    with temporary_file(path) as part:
        save_weights(part, Weights("volume_unet", content, HIP.name, 0.0, state), about)


def segmentation_loss(logits: Tensor, labels: Tensor, background: float = 1.0) -> Tensor:
    """Cross-entropy plus one minus the mean soft Dice of the bones that are there; (1, C, Z, Y, X), (1, Z, Y, X).

    `background` is the weight of its voxels, some 30 times as many as the bones', in the cross-entropy.
    """
    weights = torch.ones(logits.shape[1])
    weights[0] = background
    entropy = F.cross_entropy(logits, labels, weights)
    shares = logits.softmax(1)
    there = [k for k in range(1, logits.shape[1]) if bool((labels == k).any())]
    if not there:
        return entropy
    truth = torch.stack([(labels == k).float() for k in there], 1)
    found = shares[:, there]
    both = (found * truth).sum((0, 2, 3, 4))
    dice = (2 * both + 1) / (found.sum((0, 2, 3, 4)) + truth.sum((0, 2, 3, 4)) + 1)
    return entropy + 1 - dice.mean()


@torch.inference_mode()
def mean_dice(network: nn.Module, scans: list[Scan], multiple: int) -> dict[str, float]:
    """Dice of each bone over all scans together."""
    network.eval()
    both, sums = torch.zeros(len(HIP.bones)), torch.zeros(len(HIP.bones))
    for scan in scans:
        found = _forward(network, scan.hu, multiple).argmax(1)[0]
        for k in range(len(HIP.bones)):
            mine, truth = found == k + 1, scan.labels == k + 1
            both[k] += (mine & truth).sum()
            sums[k] += mine.sum() + truth.sum()
    network.train()
    dice = (2 * both / sums.clamp(min=1)).tolist()
    return dict(zip(HIP.bone_names, dice, strict=True)) if scans else {}


def _forward(network: nn.Module, hu: Tensor, multiple: int) -> Tensor:
    padded = padded_to(network_input(hu), multiple)
    with torch.autocast("cpu", torch.bfloat16):
        logits = network(padded[None, None])
    z, y, x = hu.shape
    result: Tensor = logits.float()[:, :, :z, :y, :x]
    return result


def _learn_from(
    scan: Scan, network: nn.Module, optimiser: torch.optim.Optimizer, multiple: int, background: float
) -> float:
    loss = segmentation_loss(_forward(network, scan.hu, multiple), scan.labels[None].long(), background)
    optimiser.zero_grad()
    loss.backward()
    nn.utils.clip_grad_norm_(network.parameters(), 1.0)
    optimiser.step()
    return loss.item()


def _next_scan(
    shapes: list[BoneShape], settings: SegmentationSettings, step: int, waiting: list[Scan], draw: random.Random
) -> Scan:
    """A new random CT, or one that was used already, mirrored and with more noise."""
    if step % settings.uses and len(waiting) > _KEPT // 2:
        return _altered(draw.choice(waiting), draw)
    scan = random_scan(draw.choice(shapes), settings.seed * 10**7 + step, settings.scan_settings)
    waiting.append(scan)
    del waiting[:-_KEPT]
    return scan


def _altered(scan: Scan, draw: random.Random) -> Scan:
    exchanged = torch.tensor(HIP.mirrored_classes, dtype=torch.uint8)[scan.labels.flip(2).long()]
    noise = torch.randn(scan.hu.shape, generator=torch.Generator().manual_seed(draw.randrange(2**31)))
    hu = scan.hu.flip(2) * draw.uniform(0.9, 1.1) + draw.uniform(-20, 20) + noise * draw.uniform(0, 25)
    return Scan(hu, exchanged)


def _validation_scans(shapes: list[BoneShape], settings: SegmentationSettings) -> list[Scan]:
    if not shapes:
        return []
    return [
        random_scan(shapes[n % len(shapes)], _VALIDATION_SEED + n, settings.scan_settings)
        for n in range(_VALIDATION_SCANS)
    ]


def _rate(step: int, steps: int) -> float:
    """Share of the learning rate: warm-up, then half a cosine down to a hundredth."""
    if step < _WARM_UP:
        return (step + 1) / _WARM_UP
    return 0.01 + 0.99 * 0.5 * (1 + math.cos(math.pi * step / steps))


def _append(path: Path, row: dict[str, Any]) -> None:
    new = not path.is_file()
    with path.open("a", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, row)
        if new:
            writer.writeheader()
        writer.writerow(row)
