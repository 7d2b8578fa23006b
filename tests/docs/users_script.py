"""A script of a user, with types: mypy checks it against the public names in a project of its own; nothing runs it."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

import femoreg_torch as femoreg


@dataclass(frozen=True)
class SquaredDifferences:
    """A similarity of one's own."""

    gain: float = 1.0

    def against(self, fixed: Tensor, weights: Tensor | None) -> Callable[[Tensor], Tensor]:
        """Costs (B,) of images (B, H, W)."""
        return lambda images: self.gain * (images - fixed).square().mean((1, 2))


def verdict_of(folder: Path) -> tuple[bool, str]:
    """Register a case and tell whether it can be trusted."""
    case: femoreg.Case = femoreg.read_case(folder)
    result: femoreg.Result = femoreg.register(case, "fast")
    verdict: femoreg.Verdict = result.verdict
    return verdict.trusted, verdict.sentence


def image_of(volume: femoreg.Volume, binning: int) -> Tensor:
    """One image of a volume in front of the C-arm."""
    carm: femoreg.CArm = femoreg.load_carm("cios_fusion")
    camera: femoreg.Camera = carm.camera.downsampled(binning)
    pose: Tensor = torch.eye(4, dtype=torch.float64)
    return femoreg.project(volume, pose[None], camera)[0]


def plan_with(similarity: SquaredDifferences) -> femoreg.Plan:
    """A workflow of one stage."""
    stage = femoreg.Stage(
        name="mine",
        images="all",
        kinds=["image"],
        render=["all"],
        bodies=[femoreg.BodyPlan(["all"], rotation_deg=[1, 1, 1], translation_mm=[1, 1, 4])],
        level=femoreg.Level(pixel_mm=3.1, step_mm=2),
        similarity=similarity,
        optimiser=femoreg.Bobyqa(max_evaluations=50),
    )
    return femoreg.Plan("mine", (stage,))
