"""Moments of a stage: they cost what they say, and lead from its start to its end."""

import json

import pytest
import torch
from registration_scenes import REFERENCE_POINTS, make_scene, off, true_poses

from femoreg_torch.case.trace import moments_content
from femoreg_torch.files import plain
from femoreg_torch.optimize import Bobyqa, CmaEs
from femoreg_torch.registration import BodyPlan, Level, Stage
from femoreg_torch.registration.costs import image_costs
from femoreg_torch.registration.stage import run_stage
from femoreg_torch.similarity import GradNcc

LEVEL = Level(pixel_mm=3.0, step_mm=2.0)
SIMILARITY = GradNcc(patch_radius=4)


@pytest.mark.parametrize("optimiser", [CmaEs(population=10, max_evaluations=120), Bobyqa(max_evaluations=40)])
def test_moments_cost_what_they_say_and_end_at_the_end(optimiser: CmaEs | Bobyqa) -> None:
    truth = true_poses()
    scene = make_scene(truth)
    start = truth.with_object(
        "pelvis", off(truth.camera1_from["pelvis"], REFERENCE_POINTS["pelvis"], (2, 0, 1), (2, -3, 6))
    )
    body = BodyPlan(["pelvis"], [3, 3, 3], [4, 4, 15])
    stage = Stage("pelvis", "all", ["anatomy"], ["pelvis", "femur"], [body], LEVEL, SIMILARITY, optimiser)
    done = run_stage(scene, start, stage, (0, 1, 2), seed=0)
    moments = done.moments
    assert 3 <= len(moments) <= 8
    torch.testing.assert_close(moments[0].poses.camera1_from["pelvis"], start.camera1_from["pelvis"])
    assert torch.equal(moments[-1].poses.camera1_from["pelvis"], done.poses.camera1_from["pelvis"])
    assert moments[-1].cost == done.cost
    assert [m.cost for m in moments] == sorted((m.cost for m in moments), reverse=True)
    assert [m.evaluations for m in moments] == sorted(m.evaluations for m in moments)
    images = [("anatomy", view) for view in range(3)]
    for moment in moments:  # rendered anew, at the poses that the moment holds
        costs = image_costs(scene, moment.poses, (), ["pelvis", "femur"], images, LEVEL, SIMILARITY)  # type: ignore[arg-type]
        assert float(costs(torch.zeros(1, 0).double()).mean()) == pytest.approx(moment.cost, abs=1e-5)
    content = json.loads(json.dumps(plain(moments_content(moments))))
    assert set(content[0]) == {"evaluations", "cost", "camera1_from"}  # no view moves
    assert set(content[0]["camera1_from"]) == {"pelvis"}
    assert content[1]["cost"] == pytest.approx(moments[1].cost, abs=1e-8)
