"""What `femoreg check` says of a device and of a planned path that the images hardly show."""

import pytest
import torch

from femoreg_torch.case.model import PlannedPath
from femoreg_torch.geometry import CArm, centred_camera, first_view_only, rigid
from femoreg_torch.intake.start_picture import hardly_shown, path_out_of_view
from femoreg_torch.registration.scene import RigidObject, Scene
from femoreg_torch.volume import Volume


@pytest.mark.parametrize(
    ("aside_mm", "shown"), [(0.0, None), (40.0, None), (61.8, "20 % of it"), (400.0, "nothing of it")]
)
def test_a_device_beside_the_picture_is_told(aside_mm: float, shown: str | None) -> None:
    """A bar of 40 mm at half the source distance, where the picture is 99 mm wide: 8 of its 40 columns."""
    bar = torch.zeros(8, 8, 44)
    bar[2:6, 2:6, 2:42] = 0.3
    away = torch.eye(4, dtype=torch.float64)
    away[:3, 3] = torch.tensor([-21.5, -3.5, -3.5])
    carm = CArm(centred_camera(1000.0, (2.0, 2.0), (100, 100)), (0.0, 0.0, 500.0), (0.0, 1.0, 0.0))
    thing = RigidObject(Volume(bar, away), torch.zeros(3).double(), ("device",))
    scene = Scene(carm, {"device": thing}, {"device": (torch.zeros(100, 100),)})
    place = rigid(translation=torch.tensor([aside_mm, 0, 500], dtype=torch.float64))
    told = hardly_shown(scene, first_view_only({"device": place}, 1), ["device", "bone"])
    assert len(told) == (0 if shown is None else 1)
    assert shown is None or f"device: where it is meant to stand, {shown}" in told[0]


@pytest.mark.parametrize(("aside_mm", "told"), [(0.0, False), (55.0, False), (70.0, True), (-70.0, True)])
def test_a_planned_path_beside_the_picture_is_told(aside_mm: float, told: bool) -> None:
    """One of 30 mm along the columns, at half the source distance, where the picture is 99 mm wide."""
    carm = CArm(centred_camera(1000.0, (2.0, 2.0), (100, 100)), (0.0, 0.0, 500.0), (0.0, 1.0, 0.0))
    volume = Volume(torch.ones(2, 2, 2), torch.eye(4, dtype=torch.float64))
    scene = Scene(
        carm,
        {"femur": RigidObject(volume, torch.zeros(3).double(), ("anatomy",))},
        {"anatomy": (torch.zeros(100, 100),)},
    )
    poses = first_view_only({"femur": rigid(translation=torch.tensor([aside_mm, 0, 500], dtype=torch.float64))}, 1)
    path = PlannedPath("femur", torch.tensor([-15.0, 0, 0]).double(), torch.tensor([15.0, 0, 0]).double())
    found = path_out_of_view(path, scene, poses)
    assert bool(found) == told
    assert not told or "plan: where the start puts the femur, entry point and target lie beside" in found[0]
    assert path_out_of_view(None, scene, poses) == ()
