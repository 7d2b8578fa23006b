"""The learning rate over a run: warm-up, constant, cool-down."""

from types import SimpleNamespace
from typing import Any, cast

import pytest

from femoreg_torch.anatomy import HIP
from models.losses import MultiTaskLoss
from models.unet import UNetSettings
from training.module import NetworkTraining, OptimisationSettings


def rates(epochs: int, batches: int, **optimisation: float) -> list[float]:
    """Shares of the learning rate at each step."""
    network = UNetSettings(1 + len(HIP.bones), len(HIP.landmarks), channels=(8, 12), convolutions=(1, 1))
    settings = OptimisationSettings(epochs, batches, **cast(Any, optimisation))
    module = NetworkTraining(network, MultiTaskLoss(sigma_px=1.0, landmark_weight=1.0), settings)
    module.trainer = cast(Any, SimpleNamespace(world_size=1))
    return [module._rate(step) for step in range(epochs * batches)]


def test_a_run_warms_up_stays_and_cools_down_to_one_per_cent() -> None:
    found = rates(10, 1000)
    assert found[9] == pytest.approx(10 / 500)
    assert set(found[500:7000]) == {1.0}
    assert found[7750] == pytest.approx(0.5)  # 1 − √¼ after a quarter of the last 3000
    assert found[-1] == pytest.approx(0.01)
    assert found[7000:] == sorted(found[7000:], reverse=True)


def test_a_longer_run_begins_as_a_shorter_one() -> None:
    assert rates(10, 600)[:4200] == rates(20, 600)[:4200]


def test_a_run_of_few_steps_warms_up_in_a_tenth_of_them() -> None:
    found = rates(1, 20)
    assert found[0] == 0.5
    assert found[1] == 1.0
