"""Single-view registration of labelled images: the preset's first stages, on images that are binned already."""

from dataclasses import replace

import pytest

from femoreg_torch.errors import InputError
from femoreg_torch.registration import load_plan
from femoreg_torch.registration.plan import Stage
from sim.study.capture import first_stages
from training import single_view


def test_levels_follow_the_binning() -> None:
    plan = first_stages(load_plan("fast"))
    binned = single_view._on_binned_images(plan, 4)
    for before, after in zip(plan.steps, binned.steps, strict=True):
        assert isinstance(before, Stage)
        assert isinstance(after, Stage)
        assert after.level.downsample * 4 == before.level.downsample
        assert replace(after, level=before.level) == before
    with pytest.raises(InputError, match="not a multiple of the images' binning, 5"):
        single_view._on_binned_images(plan, 5)
