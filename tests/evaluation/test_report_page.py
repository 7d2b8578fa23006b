"""The page of a report: nothing from outside, nothing that a name could smuggle in, and what is drawn where it is."""

import base64
import hashlib
import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from lxml import html

from femoreg_torch.case import Case, Result, read_case, read_result
from femoreg_torch.evaluation.overlay import Drawn, draw, monitor_picture
from femoreg_torch.evaluation.report import report_page
from femoreg_torch.evaluation.report.surfaces import surface_of
from femoreg_torch.geometry import project_points
from femoreg_torch.registration import Scene, prepare_scene
from femoreg_torch.volume import Volume, axis_aligned

EVIL = '<img src=x onerror="alert(1)"></script><script>alert(2)</script>'


@pytest.fixture(scope="module")
def case(kept_procedure: tuple[Path, Path]) -> Case:
    return read_case(kept_procedure[0])


@pytest.fixture(scope="module")
def scene(case: Case) -> Scene:
    return prepare_scene(case)


@pytest.fixture(scope="module")
def result(kept_procedure: tuple[Path, Path]) -> Result:
    return read_result(kept_procedure[1])


@pytest.fixture(scope="module")
def drawn(scene: Scene, result: Result) -> Drawn:
    return draw(scene, result.poses)


def test_nothing_comes_from_outside_and_only_the_pages_own_scripts_run(case, scene, result, drawn) -> None:
    page = html.fromstring(report_page(case, scene, result, None, drawn))
    addresses = [value for _, name, value, _ in page.iterlinks() if name in ("src", "href", "action", "data")]
    assert addresses
    assert all(address.startswith(("data:", "#")) for address in addresses)
    policy = page.xpath("//meta[@http-equiv='Content-Security-Policy']/@content")[0]
    assert policy.startswith("default-src 'none'")
    scripts = [script for script in page.iter("script") if script.get("type") != "application/json"]
    assert len(scripts) == 2
    for script in scripts:
        digest = base64.b64encode(hashlib.sha256(script.text.encode()).digest()).decode()
        assert f"'sha256-{digest}'" in policy


def test_names_of_users_stay_text(case, scene, result, drawn) -> None:
    spoilt_case = replace(case, folder=Path("/" + EVIL.replace("/", "|")), landmarks={EVIL: case.landmarks["FH-l"]})
    qualities = {name: replace(value, reason=EVIL) for name, value in result.quality.items()}
    spoilt = replace(result, quality=qualities, skipped=(EVIL,), doubts=(EVIL,), preset=EVIL, versions={EVIL: EVIL})
    page = html.fromstring(report_page(spoilt_case, scene, spoilt, None, drawn))
    plain = html.fromstring(report_page(case, scene, result, None, drawn))
    assert len(list(page.iter("script"))) == len(list(plain.iter("script")))
    assert not page.xpath("//*[@onerror]")
    assert not page.xpath("//img[@src='x']")
    assert EVIL in page.text_content()


def test_numbers_that_are_not_trusted_are_told_without_uncertainty(case, scene, result, drawn) -> None:
    places = dict.fromkeys(("entry_point", "tip"), torch.tensor([1.0, 2.0, 3.0], dtype=torch.float64))
    ways = dict.fromkeys(("path", "guide"), torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64))
    doubted = replace(result, points_camera1=places, directions_camera1=ways)
    trusted = replace(doubted, quality={name: replace(q, trusted=True) for name, q in result.quality.items()})
    for found, uncertain in ((trusted, True), (doubted, False)):
        card = html.fromstring(report_page(case, scene, found, None, drawn)).find_class("card")[0]
        assert ("not trusted: not to be used" in card.text_content()) is not uncertain
        assert ("±" in card.text_content()) is uncertain
        assert "0.00 mm" in card.text_content()


def test_what_is_not_known_of_the_carm_is_told_where_the_deviations_do_not_hold_it(case, scene, result, drawn) -> None:
    for with_carm, told in (((1.3, 1.2, 2.1), True), ((0.1, 0.1, 0.2), False), ((math.nan,) * 3, False)):
        quality = {
            name: replace(of, translation_deviation_mm=(0.1, 0.1, 0.2), translation_deviation_with_carm_mm=with_carm)
            for name, of in result.quality.items()
        }
        page = html.fromstring(report_page(case, scene, replace(result, quality=quality), None, drawn)).text_content()
        assert ("that nobody has calibrated: ± 2.10 mm" in " ".join(page.split())) is told


def test_there_is_a_panel_for_every_image_with_each_object_in_its_colour(case, scene, result, drawn) -> None:
    page = html.fromstring(report_page(case, scene, result, None, drawn))
    panels = page.find_class("panel")
    assert [panel.find("figcaption").text.strip() for panel in panels] == [
        f"View {view}, {kind}" for kind in ("anatomy", "device") for view in (1, 2, 3)
    ]
    layers = [panel.xpath(".//img/@data-layer") for panel in panels]
    assert layers == [["pelvis", "femur"]] * 3 + [["pelvis", "femur", "device"]] * 3
    assert all(panel.xpath(".//*[@data-layer=':path']") for panel in panels)
    assert [len(panel.xpath(".//*[@data-layer=':guide']")) for panel in panels] == [0, 0, 0, 1, 1, 1]
    assert len(set(page.xpath("//*[@class='legend']//*[@class='swatch' and @style]/@style"))) == 3


def test_the_scale_is_as_long_as_something_of_that_length_looks(case, scene, result, drawn) -> None:
    page = html.fromstring(report_page(case, scene, result, None, drawn))
    bar = page.find_class("panel")[0].find_class("scale")[0]
    length = float(bar.find("path").get("d").split("H")[1].split("V")[0])
    centre = result.poses.camera1_from["femur"] @ torch.cat([scene.objects["femur"].reference_point, torch.ones(1)])
    ends = centre[:3] + torch.tensor([[-25.0, 0, 0], [25.0, 0, 0]], dtype=torch.float64)
    pixels = project_points(drawn.cameras[0], ends)
    assert bar.text_content() == "50 mm at the femur"
    assert length == pytest.approx(float(pixels[1, 0] - pixels[0, 0]), abs=0.06)


def test_the_errors_stand_there_only_with_a_truth(case, scene, result, drawn) -> None:
    row = {"mm": 0.5, "deg": 0.2, "mm_xyz": [-0.3, 0.0, 0.4], "deg_xyz": [0.2, 0.0, -0.01]}
    with_truth = report_page(case, scene, result, {"femur": row}, drawn)
    without = report_page(replace(case, truth=None), scene, result, None, drawn)
    assert "Errors against the truth" in with_truth
    assert "Errors against the truth" not in without
    assert "simulated" not in without


def test_the_detectors_in_space_are_those_of_the_images(case, scene, result, drawn) -> None:
    page = html.fromstring(report_page(case, scene, result, None, drawn))
    theatre = json.loads(page.get_element_by_id("theatre-data").text)
    assert [mesh["name"] for mesh in theatre["meshes"]][:3] == ["pelvis", "femur", "device"]
    rows, columns = drawn.cameras[0].shape
    corners = project_points(drawn.cameras[0], torch.tensor(theatre["views"][0]["detector"], dtype=torch.float64))
    expected = torch.tensor([[-0.5, -0.5], [columns - 0.5, -0.5], [columns - 0.5, rows - 0.5], [-0.5, rows - 0.5]])
    assert torch.allclose(corners, expected.double(), atol=0.01)
    assert theatre["views"][0]["source"] == [0.0, 0.0, 0.0]


def test_the_surface_of_a_hollow_ball_is_its_outside() -> None:
    z, y, x = np.mgrid[:90, :80, :70] - np.array([45, 40, 35])[:, None, None, None]
    radius = np.sqrt(x**2 + y**2 + z**2)
    shell = torch.from_numpy(((radius < 30) & (radius > 26)).astype(np.float32)) * 0.05
    surface = surface_of(Volume(shell, axis_aligned((1.5, 1.0, 0.5), (-52.5, -40.0, -22.5))))
    assert surface is not None
    corners, faces = surface
    voxels = np.linalg.norm(corners / np.array([1.5, 1.0, 0.5]), axis=1)
    assert abs(voxels.mean() - 30) < 0.5
    assert voxels.min() > 28  # nothing of the cavity
    edges = np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1)
    assert (np.unique(edges, axis=0, return_counts=True)[1] == 2).all()  # closed


def test_nothing_has_no_surface() -> None:
    assert surface_of(Volume(torch.zeros(4, 4, 4), axis_aligned((1.0, 1.0, 1.0), (0.0, 0.0, 0.0)))) is None


def test_a_shutter_does_not_set_the_window() -> None:
    """A body with faint bone inside a round field, and black beyond: the bone is as clear as without the shutter."""
    y, x = np.mgrid[:128, :128] - 63.5
    body = 4.0 + 0.4 * (np.abs(x) < 12)
    inside = np.hypot(x, y) < 55
    shuttered = torch.from_numpy(np.where(inside, body, 11.0)).float()
    field = torch.from_numpy(inside)
    shown = monitor_picture(shuttered, field)[..., 0].astype(int)
    assert (shown[~inside] == 0).all()
    middle = slice(54, 74)
    assert shown[middle, 30:45].mean() - shown[middle, 58:70].mean() > 60


def test_an_image_of_nothing_is_shown_too() -> None:
    assert monitor_picture(torch.zeros(32, 32)).shape == (32, 32, 3)
