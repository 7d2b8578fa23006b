"""Where the starts of an optimisation ended, told in degrees and mm."""

import pytest
import torch
from registration_scenes import REFERENCE_POINTS, float64, make_scene, true_poses

from femoreg_torch.optimize import Result, Stop
from femoreg_torch.registration.restarts import restarts_of
from femoreg_torch.registration.scene import Body, moved, reference_point_in_view

POSES = true_poses()
SCENE = make_scene(POSES)
SCALE = float64(*[torch.pi / 180] * 3, 1, 1, 1)


def ends(*found: tuple[float, tuple[float, ...]]) -> Result:
    return Result(torch.zeros(6, dtype=torch.float64), 0.0, Stop.FLAT, 1, (), found)


@pytest.mark.parametrize(("objects", "view"), [(("femur",), 0), ((), 2)])
def test_ends_are_told_against_the_best_in_the_order_of_their_costs(objects: tuple[str, ...], view: int) -> None:
    centre = reference_point_in_view(SCENE, POSES, "femur" if objects else "pelvis", view)
    bodies = (Body(objects, view, centre, SCALE),)
    result = ends((0.9, (0, 0, 0, 3, 0, 4)), (0.5, (0, 0, 0, 0, 0, 0)), (0.7, (0, 7, 0, 0, 0, 0)))
    found = restarts_of(result, SCENE, bodies, lambda delta: moved(POSES, bodies, delta))
    assert [restart.cost for restart in found] == pytest.approx([0.2, 0.4])
    assert [restart.apart_deg for restart in found] == pytest.approx([7, 0], abs=1e-5)
    assert [restart.apart_mm for restart in found] == pytest.approx([0, 5], abs=1e-9)


def test_the_body_that_moved_furthest_counts() -> None:
    bodies = tuple(Body((name,), 0, reference_point_in_view(SCENE, POSES, name, 0), SCALE) for name in REFERENCE_POINTS)
    still = (0.0,) * 18
    result = ends((0.5, still), (0.6, (*still[:15], 0, 2, 0)))
    found = restarts_of(result, SCENE, bodies, lambda delta: moved(POSES, bodies, delta))
    assert found[0].apart_mm == pytest.approx(2)


def test_an_optimiser_with_one_start_has_none() -> None:
    assert restarts_of(ends(), SCENE, (), lambda _: POSES) == ()
