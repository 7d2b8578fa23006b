"""What no procedure can be is refused: starts outside the beam, points nowhere near their object, HU below air."""

from pathlib import Path

import pytest
import torch

from femoreg_torch.case import Case, CaseObject, Model, Start
from femoreg_torch.case.fields import Fields
from femoreg_torch.case.models import read_model
from femoreg_torch.errors import InputError
from femoreg_torch.geometry import CArm, centred_camera
from femoreg_torch.geometry.carm import carm_from_dict
from femoreg_torch.registration.prepare.nominal import check_points, check_starts
from femoreg_torch.registration.scene import RigidObject
from femoreg_torch.settings import read_record
from femoreg_torch.volume import Volume, resample_isotropic
from femoreg_torch.volume.grid import axis_aligned
from sim.theatre.settings import Acquisition, Simulation, load_simulation

VOLUME = Volume(torch.zeros(20, 10, 10), axis_aligned((1.0, 1.0, 1.0), (0.0, 0.0, 0.0)))
GOOD = {"sdd_mm": 1000, "pixel_mm": [0.3, 0.2], "shape": [100, 200]}


def at(depth_mm: float) -> torch.Tensor:
    pose = torch.eye(4, dtype=torch.float64)
    pose[2, 3] = depth_mm
    return pose


def started_at(depth_mm: float) -> dict[str, RigidObject]:
    return {"device": RigidObject(VOLUME, VOLUME.centre(), ("device",), Start(camera1_from=at(depth_mm)))}


@pytest.mark.parametrize(
    ("depth_mm", "place"), [(-600, "behind the source"), (0.6, "at the source"), (1500, "behind the detector")]
)
def test_a_device_that_is_not_in_the_beam(depth_mm: float, place: str) -> None:
    check_starts(started_at(600), 1000.0, "case.yaml")
    with pytest.raises(InputError, match=f"case.yaml: the start pose puts device {place}"):
        check_starts(started_at(depth_mm), 1000.0, "case.yaml")


@pytest.mark.parametrize(("tip", "good"), [((5.0, 5.0, 120.0), True), ((5.0, 5.0, 10_000.0), False)])
def test_a_tip_ten_metres_from_its_mesh(tip: tuple[float, float, float], good: bool, tmp_path: Path) -> None:
    carm = CArm(centred_camera(1000.0, (1.0, 1.0), (9, 9)), (0.0, 0.0, 600.0), (0.0, 1.0, 0.0))
    thing = CaseObject("device", points={"tip": torch.tensor(tip, dtype=torch.float64)})
    case = Case(tmp_path, carm, {"device": thing})
    if good:
        check_points(case, thing, VOLUME)
        return
    with pytest.raises(InputError, match="device: its point tip lies 9980 mm outside its model"):
        check_points(case, thing, VOLUME)


@pytest.mark.parametrize("hu", [-5000, -1000, 1e9, True, "dense"])
def test_hu_that_no_solid_has(hu: object, tmp_path: Path) -> None:
    (tmp_path / "a.stl").write_bytes(b"some")
    with pytest.raises(InputError, match=r"case\.yaml, hu: "):
        read_model(Fields({"model": "a.stl", "hu": hu}, "case.yaml"), tmp_path)
    assert read_model(Fields({"model": "a.stl", "hu": 5000}, "case.yaml"), tmp_path) == Model(tmp_path / "a.stl", 5000)


@pytest.mark.parametrize(
    "change",
    [
        {"pixel_mm": [1e-9, 1e-9]},
        {"pixel_mm": [200, 200]},
        {"shape": [192.9, 192.2]},
        {"shape": [10**6, 10**6]},
        {"shape": [True, True]},
        {"sdd_mm": True},
        {"sdd_mm": 1.02},
        {"principal_point_px": [1e9, 0]},
        {"isocentre_mm": [0, 0, 1e9]},
        {"uncertainty": {"sdd_percent": 1000}},
    ],
)
def test_a_carm_that_nobody_has(change: dict[str, object]) -> None:
    carm_from_dict(GOOD, "carm")
    with pytest.raises(InputError, match=f"carm.*{next(iter(change)).split('_')[0]}"):
        carm_from_dict(GOOD | change, "carm")


@pytest.mark.parametrize(
    ("group", "key", "value"),
    [
        ("xray", "k_lines", "abc"),
        ("xray", "kvp", 500),
        ("xray", "energy_bins", 10**9),
        ("xray", "quantum_efficiency", 0),
        ("acquisition", "step_mm", 1e-9),
        ("acquisition", "orbit_deg", []),
        ("acquisition", "device_hu", float("inf")),
        ("acquisition", "head_depth_mm", True),
        ("acquisition", "view", {"angle_deg": -1, "shift_mm": 0}),
    ],
)
def test_simulation_settings_have_ranges(group: str, key: str, value: object) -> None:
    from femoreg_torch.configs import load_preset

    content = load_preset("simulation", "paper")
    content[group] = {**content[group], key: value}
    with pytest.raises(InputError, match="settings") as raised:
        read_record(Simulation, content, "settings")
    assert "\n" not in str(raised.value)
    assert len(str(raised.value)) < 500


def test_the_presets_are_within_their_ranges() -> None:
    assert isinstance(load_simulation("paper").acquisition, Acquisition)
    assert load_simulation("mixed")


def test_a_volume_in_other_units_is_not_resampled_without_end() -> None:
    vast = Volume(torch.zeros(100, 100, 100), axis_aligned((50.0, 50.0, 50.0), (0.0, 0.0, 0.0)))
    with pytest.raises(InputError, match="volume of 5000 × 5000 × 5000 mm"):
        resample_isotropic(vast, 0.5)
