"""A coarse procedure under all conditions: the patient's rays are cast once, and cases tell what they are meant to."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import yaml
from coarse import PROCEDURE, SIMULATION, stores_in
from femoreg_torch.configs import load_preset

from femoreg_torch.case import read_case
from femoreg_torch.case.femoroplasty import device_of
from femoreg_torch.errors import InputError
from femoreg_torch.fluoro import read_image
from femoreg_torch.geometry import pose_difference, rotation_angle, transform_points
from femoreg_torch.volume import read_ct, read_mesh
from sim.study import conditions as module
from sim.study.cases import Stores
from sim.study.conditions import Condition, Imaged, body_of, made_once, make_conditions
from sim.study.protocol import load_protocol
from sim.study.work import settings_of
from sim.study.yardsticks import only_these
from sim.theatre.case_folders import write_simulation
from sim.theatre.metal import draw_materials
from sim.theatre.preoperative_case import Preoperative, read_preoperative
from sim.theatre.procedure import Procedure, draw_procedure
from sim.theatre.settings import load_simulation

CONDITIONS = load_protocol("conditions").vary


@pytest.fixture(scope="module")
def stores(coarse_root: Path) -> Stores:
    return stores_in(coarse_root)


@pytest.fixture(scope="module")
def simulation(stores: Stores) -> dict[str, Any]:
    """The settings of the paper, with 16 × 16 pixels of the C-arm in one."""
    return load_preset("simulation", stores.cases.parent / SIMULATION)


@pytest.fixture(scope="module")
def imaged(stores: Stores, simulation: dict[str, Any]) -> Imaged:
    out = Imaged(stores.cases.parent / "bodies", stores.cases.parent / "conditions")
    body = body_of(PROCEDURE, stores, out, stores.cases.parent)
    for condition in CONDITIONS:
        made_once(condition, PROCEDURE, simulation, body, out)
    return out


def folder_of(imaged: Imaged, name: str) -> Path:
    return imaged.conditions / name / PROCEDURE.name


def shown(imaged: Imaged, name: str, kind: str = "device", view: int = 0) -> torch.Tensor:
    return read_image(read_case(folder_of(imaged, name)).views[view].images[kind]).float()


def test_the_condition_uniform_is_the_study_bit_for_bit(imaged: Imaged, stores: Stores, tmp_path: Path) -> None:
    coarse, finer = (stores.patients / "somebody" / name for name in ("1.0", "0.5"))
    config = str(stores.cases.parent / SIMULATION)
    write_simulation(coarse, tmp_path / "case", 2, "right", config, lambda _: None, finer)
    for name in ("view1.tif", "view3.tif", "view2_device.tif", "truth.json", "case.yaml", "device.stl"):
        assert (tmp_path / "case" / name).read_bytes() == (folder_of(imaged, "uniform") / name).read_bytes()


def test_every_condition_has_its_case(imaged: Imaged) -> None:
    assert {path.name for path in imaged.conditions.iterdir()} == {condition.name for condition in CONDITIONS}
    for condition in CONDITIONS:
        if condition.told.parts:
            continue  # read by the library once it knows parts
        case = read_case(folder_of(imaged, condition.name))
        assert case.truth is not None
        assert set(case.truth.camera1_from) == {"pelvis", "femur", "device"}
        for view in case.views:
            assert set(view.images) == {"anatomy", "device"} if condition.told.device_images else {"anatomy"}


def test_the_rays_through_the_patient_are_cast_once_and_again_where_it_moved(
    imaged: Imaged, stores: Stores, simulation: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    assert len(list((imaged.bodies / PROCEDURE.name).glob("*.pt"))) == 6
    monkeypatch.delattr(module, "areal_posed_tissue")  # nothing is cast any more
    later = Condition("later", xray={"kvp": 90})
    make_conditions([PROCEDURE], [later], simulation, stores, imaged, 1)
    assert shown(imaged, "later").shape == (96, 96)
    again = replace(imaged, conditions=imaged.conditions.parent / "again")
    make_conditions([PROCEDURE], [CONDITIONS[0]], simulation, stores, again, 1)
    name = "view2_device.tif"
    assert (folder_of(again, "uniform") / name).read_bytes() == (folder_of(imaged, "uniform") / name).read_bytes()


def test_mixed_devices_are_told_as_one_or_by_their_parts(imaged: Imaged) -> None:
    assert torch.equal(shown(imaged, "mixed", "anatomy"), shown(imaged, "uniform", "anatomy"))
    assert not torch.equal(shown(imaged, "mixed"), shown(imaged, "uniform"))
    device = device_of(read_case(folder_of(imaged, "mixed")))
    assert device is not None
    assert device.model.hu == 5000
    told = {}
    for name in ("mixed", "mixed_named", "mixed_wrong"):
        folder = folder_of(imaged, name)
        told[name] = yaml.safe_load((folder / "case.yaml").read_text(encoding="utf-8"))["device"]
        assert (folder / "view1_device.tif").read_bytes() == (
            folder_of(imaged, "mixed") / "view1_device.tif"
        ).read_bytes()
    named, wrong = told["mixed_named"]["parts"], told["mixed_wrong"]["parts"]
    assert set(told["mixed_named"]) == {"parts", "points", "camera1_from_device"}
    assert {part["model"].removesuffix(".stl"): part["material"] for part in named} == draw_materials(2)
    assert all(one["material"] != other["material"] for one, other in zip(named, wrong, strict=True))
    folder = folder_of(imaged, "mixed_named")
    volume = sum(read_mesh(folder / part["model"]).volume for part in named)
    assert np.isclose(volume, read_mesh(folder / "device.stl").volume, rtol=0.005)


def test_masks_hide_the_rim_and_table_parts_darken_both_images(imaged: Imaged) -> None:
    for name in ("round_mask", "square_mask"):
        share = shown(imaged, name, "anatomy") / shown(imaged, "uniform", "anatomy")
        assert share[0, 0] < 0.2
        assert share[40:56, 40:56].mean() > 0.6  # less scatter
    for kind in ("anatomy", "device"):
        share = shown(imaged, "table_parts", kind) / shown(imaged, "uniform", kind)
        assert share.min() < 0.5
        assert 0.9 < share.median() < 1.02


def test_binned_images_are_means_and_so_is_their_camera(imaged: Imaged) -> None:
    binned, whole = (read_case(folder_of(imaged, name)) for name in ("binned", "uniform"))
    assert binned.carm.camera == whole.carm.camera.downsampled(2)
    means = shown(imaged, "uniform").unflatten(0, (48, 2)).unflatten(2, (48, 2)).mean((1, 3))
    torch.testing.assert_close(shown(imaged, "binned"), means, atol=0.51, rtol=0)


def test_the_ct_of_a_case_is_spoilt_and_that_of_the_patient_is_not(imaged: Imaged, stores: Stores) -> None:
    case = read_case(folder_of(imaged, "ct_hu_5_percent_high"))
    assert case.ct_path is not None
    patient = read_ct(stores.patients / "somebody" / "1.0" / "ct.nii.gz")
    torch.testing.assert_close(read_ct(case.ct_path).data.float(), 1.05 * patient.data.float(), atol=0.51, rtol=0)


def test_the_focal_length_is_told_wrong_and_nothing_else(imaged: Imaged) -> None:
    true = read_case(folder_of(imaged, "uniform")).carm
    for name, factor in (("focal_3", 1.03), ("focal_10", 1.1)):
        told = read_case(folder_of(imaged, name)).carm
        camera = replace(true.camera, sdd_mm=true.camera.sdd_mm * factor)
        assert told.camera.sdd_mm == pytest.approx(camera.sdd_mm)
        assert replace(told, camera=true.camera) == true
        assert (told.camera.pixel_mm, told.camera.principal_point_px) == (
            true.camera.pixel_mm,
            true.camera.principal_point_px,
        )
        assert torch.equal(shown(imaged, name), shown(imaged, "uniform"))


def still_and_moved(stores: Stores, folder: Path, **moves: float) -> tuple[Preoperative, Procedure, Procedure]:
    """A procedure of one seed, as it is and with something moving."""
    paper = load_simulation("paper")
    known = read_preoperative(stores.patients / "somebody" / "1.0", "right", 2, paper, folder / "device.stl")
    mesh = read_mesh(known.device.model.path)
    still, moved = (
        draw_procedure(known, mesh, settings, torch.Generator().manual_seed(5))
        for settings in (paper.acquisition, replace(paper.acquisition, **moves))
    )
    return known, still, moved


def test_the_patient_moves_by_just_so_much_between_the_images(stores: Stores, tmp_path: Path) -> None:
    known, still, moved = still_and_moved(stores, tmp_path, moved_deg=1.0, moved_mm=2.0)
    assert still.lps_moved is None
    assert moved.lps_moved is not None
    assert torch.rad2deg(rotation_angle(moved.lps_moved[:3, :3])).item() == pytest.approx(1)
    head = known.head[None]
    assert (transform_points(moved.lps_moved, head) - head).norm().item() == pytest.approx(2)
    assert torch.equal(still.camera_from_device, moved.camera_from_device)


def test_a_device_held_by_hand_moves_by_just_so_much_in_each_view_after_the_first(
    stores: Stores, tmp_path: Path
) -> None:
    known, still, moved = still_and_moved(stores, tmp_path, device_moved_deg=1.0, device_moved_mm=2.0)
    apart = [
        pose_difference(*views, known.device.points["center"])
        for views in zip(still.camera_from_device, moved.camera_from_device, strict=True)
    ]
    assert apart == [pytest.approx((0, 0), abs=1e-6), *[pytest.approx((1, 2))] * 2]
    assert torch.equal(still.camera_from_pelvis, moved.camera_from_pelvis)


def test_another_condition_of_a_name_and_an_unknown_name_are_refused(
    imaged: Imaged, stores: Stores, simulation: dict[str, Any]
) -> None:
    other = Condition("uniform", xray={"kvp": 60})
    with pytest.raises(InputError, match="other settings"):
        make_conditions([PROCEDURE], [other], simulation, stores, imaged, 1)
    settings = settings_of(load_protocol("conditions"), "conditions")
    with pytest.raises(InputError, match="no 'fog'; there are: uniform, "):
        only_these(settings, ["fog"], "conditions")
    assert list(only_these(settings, ["moved", "dark"], "conditions")) == ["dark", "moved"]
    assert only_these(settings, [], "conditions") == settings
