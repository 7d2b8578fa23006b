"""Views from a side, inlet and outlet views, and femora as in a frog-leg view."""

import numpy as np
import pytest
import torch
from torch import Tensor
from torch.testing import assert_close

from femoreg_torch.anatomy import HIP
from femoreg_torch.errors import InputError
from sim.labelled.view_poses import FEMORAL_HEADS, LabelledPose, ViewRanges, sample_pose

RIGID = {"size": 0.0, "stretch": 0.0}
HEADS = {"femur_left": torch.tensor([90.0, 0, 0]), "femur_right": torch.tensor([-90.0, 0, 0])}


def landmarks() -> Tensor:
    points = torch.zeros((len(HIP.landmarks), 3), dtype=torch.float64)
    for femur, head in HEADS.items():
        points[FEMORAL_HEADS[femur]] = head.double()
    return points


def poses(ranges: ViewRanges, count: int = 60) -> list[LabelledPose]:
    rng = np.random.default_rng(3)
    return [sample_pose(ranges, landmarks(), rng) for _ in range(count)]


def angle_deg(a: Tensor, b: tuple[float, float, float]) -> float:
    return float(torch.rad2deg(torch.acos((a @ a.new_tensor(b)).clamp(-1, 1))))


def test_views_from_a_side_look_from_both_and_are_not_mirrored() -> None:
    drawn = poses(ViewRanges(side_share=1.0, posterior_share=1.0, side_deg=(20.0, 45.0), in_plane_deg=0.0, **RIGID))
    beams = [pose.camera_from_lps[2, :3] for pose in drawn]
    assert not any(pose.mirrored for pose in drawn)
    assert 10 < sum(bool(beam[0] > 0) for beam in beams) < 50  # from the patient's right, and from the left
    for pose, beam in zip(drawn, beams, strict=True):
        along = float(beam[2])  # inclined to the long axis by up to 45°
        assert abs(along) <= np.sin(np.radians(45)) + 1e-9
        level = torch.cat([beam[:2], beam.new_zeros(1)])
        side = (float(beam[0].sign()), 0.0, 0.0)
        assert angle_deg(level / level.norm(), side) <= 20 + 1e-6
        assert_close(pose.camera_from_lps[0, 2], beam.new_zeros(()))  # the long axis stays upright in the picture
        assert pose.camera_from_lps[1, 2] < 0  # head up
    assert max(abs(float(beam[2])) for beam in beams) > 0.4


def test_inlet_and_outlet_views_are_steep_either_way() -> None:
    ranges = ViewRanges(steep_share=1.0, steep_deg=(30.0, 50.0), orbital_deg=1e-9, posterior_share=0.0, **RIGID)
    tilts = [float(torch.rad2deg(torch.asin(pose.camera_from_lps[2, 2]))) for pose in poses(ranges)]
    assert all(30 - 1e-6 <= abs(tilt) <= 50 + 1e-6 for tilt in tilts)
    assert min(tilts) < 0 < max(tilts)


@pytest.mark.parametrize("outwards", [False, True])
def test_a_frog_leg_goes_to_the_front_and_outwards(outwards: bool) -> None:
    ranges = ViewRanges(frog_share=1.0, frog_deg=(0.0, 0.0, 50.0) if outwards else (90.0, 50.0, 50.0), **RIGID)
    for pose in poses(ranges, 20):
        for femur, head in HEADS.items():
            lps_from_femur = torch.linalg.inv(pose.camera_from_lps) @ pose.camera_from(femur)
            assert_close(lps_from_femur[:3, :3] @ head.double() + lps_from_femur[:3, 3], head.double())
            thigh = lps_from_femur[:3, :3] @ torch.tensor([0.0, 0, -1], dtype=torch.float64)
            kneecap = lps_from_femur[:3, :3] @ torch.tensor([0.0, -1, 0], dtype=torch.float64)
            side = float(head[0].sign())
            if outwards:
                assert kneecap[0] * side > 0
            else:
                assert thigh[1] < 0 < thigh[0] * side  # +y is the back


def test_kinds_that_are_not_asked_for_change_no_draw() -> None:
    """Views of a seed stay what they were before there were kinds."""
    pose = sample_pose(ViewRanges(), landmarks(), np.random.default_rng(8))
    draws = np.random.default_rng(8)
    draws.uniform(-0.1, 0.1)
    draws.uniform(size=12)
    tilt = draws.triangular(-30, 0, 30)
    orbit = draws.triangular(-60, 0, 60)
    turn = draws.uniform(-15, 15)
    mirrored = draws.random() < 0.3
    assert pose.mirrored == mirrored
    x, y, z = (np.radians(angle) for angle in (tilt, orbit, turn))
    about_x = np.array([[1, 0, 0], [0, np.cos(x), -np.sin(x)], [0, np.sin(x), np.cos(x)]])
    about_y = np.array([[np.cos(y), 0, np.sin(y)], [0, 1, 0], [-np.sin(y), 0, np.cos(y)]])
    about_z = np.array([[np.cos(z), -np.sin(z), 0], [np.sin(z), np.cos(z), 0], [0, 0, 1]])
    side = -1.0 if mirrored else 1.0
    upright = about_z @ about_y @ about_x @ np.array([[side, 0, 0], [0, 0, -1], [0, side, 0]])
    rigid = sample_pose(ViewRanges(**RIGID), landmarks(), np.random.default_rng(8)).camera_from_lps[:3, :3]
    assert_close(rigid, torch.from_numpy(upright))


def test_shares_beyond_one_are_refused() -> None:
    with pytest.raises(InputError, match="steep_share and side_share"):
        ViewRanges(steep_share=0.6, side_share=0.6)
