"""What shutters hide does not count: in similarities, searches, quality, detection and the start."""

import math
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from registration_scenes import CARM, REFERENCE_POINTS, error, float64, make_scene, off, true_poses
from torch import Tensor

from femoreg_torch.case import Case, CaseObject, View
from femoreg_torch.detect import Detection, filled
from femoreg_torch.errors import InputError
from femoreg_torch.fluoro import Circle, Polygon, find_shutter, without_penumbra, write_image
from femoreg_torch.geometry import Camera
from femoreg_torch.optimize import LevenbergMarquardt
from femoreg_torch.registration import BodyPlan, Level, OrbitSearch, Scene, Stage
from femoreg_torch.registration.costs import image_costs
from femoreg_torch.registration.evidence.covariance import pose_covariance
from femoreg_torch.registration.objective import stage_objective
from femoreg_torch.registration.prepare import images as reading_of_images
from femoreg_torch.registration.prepare.images import read_images
from femoreg_torch.registration.quality import Limits, assess
from femoreg_torch.registration.scene import Body
from femoreg_torch.registration.stage import run_stage
from femoreg_torch.registration.start.find import look_at
from femoreg_torch.similarity import GradientOrientation, GradNcc, Ncc, Similarity, against_field

TRUTH = true_poses()
LEVEL = Level(pixel_mm=3.0, step_mm=2.0)
SIMILARITIES = [GradNcc(patch_radius=3), Ncc(), Ncc(patch_radius=3), GradientOrientation()]
FIELD = Circle((44, 42), 38).exposed((88, 88))


def behind(scene: Scene, seed: int | None = None) -> Scene:
    """The scene behind round shutters, with black or with anything else outside."""
    generator = torch.Generator().manual_seed(seed or 0)

    def shaded(image: Tensor | None) -> Tensor | None:
        outside = torch.tensor(9.0) if seed is None else 5 * torch.rand((88, 88), generator=generator)
        return None if image is None else torch.where(FIELD, image, outside)

    images = {kind: tuple(map(shaded, images)) for kind, images in scene.images.items()}
    return replace(scene, images=images, fields=dict.fromkeys(scene.images, (FIELD,) * scene.views))


@pytest.fixture(scope="module")
def scene() -> Scene:
    return make_scene(TRUTH)


@pytest.mark.parametrize("similarity", SIMILARITIES)
def test_what_stands_outside_the_field_does_not_matter(scene: Scene, similarity: Similarity) -> None:
    body = Body(("pelvis",), 0, float64(0, 0, 740), float64(0.02, 0.02, 0.02, 2, 2, 12))
    images = [("anatomy", view) for view in range(3)]
    deltas = torch.cat([torch.zeros(1, 6), torch.eye(6)]).double()
    found = []
    for here in (behind(scene), behind(scene, 1), behind(scene, 2)):
        costs = image_costs(here, TRUTH, (body,), ("pelvis", "femur"), images, LEVEL, similarity)
        model = stage_objective(costs, (body,), None).quadratic(deltas[1])
        found.append((costs(deltas), model.gradient, model.hessian))
    for other in found[1:]:
        for ours, theirs in zip(found[0], other, strict=True):
            torch.testing.assert_close(ours, theirs, rtol=0, atol=1e-12)


@pytest.mark.parametrize("similarity", SIMILARITIES)
def test_a_moving_image_does_not_count_outside_either(similarity: Similarity) -> None:
    generator = torch.Generator().manual_seed(3)
    fixed, moving, other = torch.rand((3, 88, 88), generator=generator)
    changed = torch.where(FIELD, moving, other)
    weights = torch.rand((88, 88), generator=generator)
    for shares in (None, weights):
        costs = against_field(similarity, fixed, shares, FIELD)(torch.stack([moving, changed]))
        assert float(costs[0]) == pytest.approx(float(costs[1]), abs=1e-12)
        everything = torch.ones_like(FIELD)
        plain = similarity.against(fixed, shares)(moving[None])
        torch.testing.assert_close(against_field(similarity, fixed, shares, everything)(moving[None]), plain)


def test_a_similarity_that_knows_no_field_weighs_its_pixels() -> None:
    class Own:
        def against(self, fixed: Tensor, weights: Tensor | None) -> object:
            assert weights is not None
            return lambda images: ((images - fixed).square() * weights).sum((1, 2))

    prepared = against_field(Own(), torch.rand(88, 88), None, FIELD)  # type: ignore[arg-type]
    image = torch.rand(88, 88)
    assert torch.equal(prepared(image[None]), prepared(torch.where(FIELD, image, 7.0)[None]))


def test_a_field_that_leaves_nothing_is_named(scene: Scene) -> None:
    tiny = Circle((44, 42), 3).exposed((88, 88))
    hidden = replace(scene, fields={"anatomy": (None, tiny, None)})
    with pytest.raises(InputError, match=r"view 2, anatomy image: similarity: no patch of radius 4 lies wholly"):
        image_costs(hidden, TRUTH, (), ("pelvis",), [("anatomy", 0), ("anatomy", 1)], LEVEL, GradNcc(4))


def test_a_pixel_of_a_level_is_exposed_if_all_of_it_is() -> None:
    coarse = Level(6.0, 2.0).field(FIELD, CARM.camera)
    assert coarse.shape == (44, 44)
    assert torch.equal(coarse, FIELD.view(44, 2, 44, 2).all(3).all(1))


def test_a_registration_behind_shutters_is_about_as_good(scene: Scene) -> None:
    bodies = [BodyPlan([name], [2, 2, 2], [2, 2, 8]) for name in ("pelvis", "femur")]
    settings = LevenbergMarquardt(max_iterations=12, tol_x=1e-3, tol_f=1e-8)
    stage = Stage("bones", "all", ["anatomy"], ["pelvis", "femur"], bodies, LEVEL, GradNcc(3), settings)
    start = TRUTH
    for name in ("pelvis", "femur"):
        start = start.with_object(name, off(start.camera1_from[name], REFERENCE_POINTS[name], (1, -1, 1), (1, -1, 4)))
    for here, limit in ((scene, 0.3), (behind(scene), 0.5)):
        found = run_stage(here, start, stage, (0, 1, 2), seed=0).poses
        for name in ("pelvis", "femur"):
            mm, deg = error(found.camera1_from[name], TRUTH.camera1_from[name], REFERENCE_POINTS[name])
            assert mm < limit, name
            assert deg < 0.5, name


def test_the_orbit_search_looks_within_the_field(scene: Scene) -> None:
    search = OrbitSearch("orbit", ["anatomy"], ["pelvis", "femur"], 24, 2, LEVEL, GradNcc(3))
    angles = [record.cost for record in search.run(behind(scene), TRUTH, 0)]
    assert angles == pytest.approx([record.cost for record in search.run(behind(scene, 5), TRUTH, 0)], abs=1e-9)
    last = list(search.run(behind(scene), TRUTH, 0))[-1].poses.camera_from_camera1
    for view in (1, 2):
        turn = last[view][:3, :3] @ TRUTH.camera_from_camera1[view][:3, :3].T
        assert math.degrees(math.acos(min(1.0, float(turn.trace() - 1) / 2))) < 2.5


def test_quality_and_covariance_look_within_the_field(scene: Scene) -> None:
    one, other = (assess(behind(scene, seed), TRUTH, Limits())["pelvis"] for seed in (None, 4))
    assert [v.gain for v in one.views] == pytest.approx([v.gain for v in other.views], abs=1e-9)
    one, other = (pose_covariance(behind(scene, seed), TRUTH, LEVEL, GradNcc(3)) for seed in (None, 4))
    torch.testing.assert_close(one.matrix, other.matrix)


def test_the_network_sees_no_shadow_and_finds_no_landmark_in_it(scene: Scene) -> None:
    looks: list[Tensor] = []

    def find(image: Tensor, camera: Camera) -> Detection:
        looks.append(image)
        pixels = torch.tensor([[44.0, 42.0], [2.0, 3.0], [-5.0, 40.0]], dtype=torch.float64)
        seen = torch.ones(3)
        return Detection(pixels, seen, seen, seen.bool(), torch.zeros(7, 4, 4), camera, False)

    hidden = behind(scene)
    found = look_at(hidden, 1, find)
    assert found.visible.tolist() == [True, False, False]
    image = hidden.image("anatomy", 1)
    assert torch.equal(looks[0], filled(image, FIELD))
    assert torch.equal(looks[0][FIELD], image[FIELD])
    assert (looks[0][~FIELD] == image[FIELD].min()).all()
    assert look_at(scene, 1, find).visible.all()
    assert looks[1] is scene.image("anatomy", 1)


def case_with(folder: Path, raw: Tensor, **told: object) -> Case:
    write_image(folder / "view1.tif", raw.to(torch.uint16))
    views = (View({"anatomy": folder / "view1.tif"}, **told),)  # type: ignore[arg-type]
    return Case(folder, CARM, {"bone": CaseObject("bone")}, views)


def test_a_shutter_that_one_image_hides_is_known_from_another(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    beam = 30000 * torch.exp(-torch.rand(88, 88, generator=torch.Generator().manual_seed(0)) / 3)
    case = case_with(tmp_path, torch.where(FIELD, beam, 60.0))
    write_image(tmp_path / "view2.tif", torch.where(FIELD, beam.flip(0), 60.0).to(torch.uint16))
    case = replace(case, views=(*case.views, View({"anatomy": tmp_path / "view2.tif"})))
    found = iter([find_shutter(torch.where(FIELD, beam, 60.0), CARM.camera), None, None])
    monkeypatch.setattr(reading_of_images, "find_shutter", lambda raw, camera: next(found))
    _, fields, told = read_images(case)
    first, second = fields["anatomy"]
    assert first is not None
    assert second is not None
    assert torch.equal(first, second)
    assert told == ("anatomy images of views 1 and 2: a round shutter was found, 58 % of the detector is exposed",)
    write_image(tmp_path / "view2.tif", beam.flip(0).to(torch.uint16))
    found = iter([find_shutter(torch.where(FIELD, beam, 60.0), CARM.camera), None, None])
    assert read_images(case)[1]["anatomy"][1] is None  # its shutter was open


def test_a_shutter_that_was_found_but_in_part_is_known_from_another_image(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    beam = 30000 * torch.exp(-torch.rand(88, 88, generator=torch.Generator().manual_seed(0)) / 3)
    whole = find_shutter(torch.where(FIELD, beam, 60.0), CARM.camera)
    assert whole is not None
    part = replace(whole, exposed=whole.exposed + 0.1, field=torch.ones(88, 88, dtype=torch.bool))
    case = case_with(tmp_path, torch.where(FIELD, beam, 60.0))
    write_image(tmp_path / "view2.tif", torch.where(FIELD, beam.flip(0), 60.0).to(torch.uint16))
    case = replace(case, views=(*case.views, View({"anatomy": tmp_path / "view2.tif"})))

    def second_field() -> Tensor:
        found = iter([whole, part])
        monkeypatch.setattr(reading_of_images, "find_shutter", lambda raw, camera: next(found))
        field = read_images(case)[1]["anatomy"][1]
        assert field is not None
        return field

    assert torch.equal(second_field(), whole.field)
    write_image(tmp_path / "view2.tif", beam.flip(0).to(torch.uint16))  # which shows no edge where the other one does
    assert torch.equal(second_field(), part.field)


def test_a_field_is_found_or_told_by_the_case(tmp_path: Path) -> None:
    generator = torch.Generator().manual_seed(0)
    smooth = torch.nn.functional.interpolate(torch.rand(1, 1, 6, 6, generator=generator), (88, 88), mode="bicubic")
    beam = 30000 * torch.exp(-smooth[0, 0])
    raw = torch.where(FIELD, beam, 60.0)
    images, fields, told = read_images(case_with(tmp_path, raw))
    assert told == ("view 1, anatomy image: a round shutter was found, 58 % of the detector is exposed",)
    (field,), (image,) = fields["anatomy"], images["anatomy"]
    assert field is not None
    assert image is not None
    assert (field & without_penumbra(FIELD, CARM.camera)).sum() / (field | FIELD).sum() > 0.85
    assert float(image[field].min()) == pytest.approx(0, abs=0.02)
    images, fields, told = read_images(case_with(tmp_path, beam))
    assert fields == {"anatomy": (None,)}
    assert told == ()
    corners = ((10.0, 10.0), (70.0, 12.0), (60.0, 80.0))
    write_image(tmp_path / "mask.png", (FIELD * 255).to(torch.uint16))
    for shape, exposed in (
        (Circle((44, 42), 38), FIELD),
        (Polygon(corners), Polygon(corners).exposed((88, 88))),
        (tmp_path / "mask.png", FIELD),
    ):
        _, fields, told = read_images(case_with(tmp_path, beam, field=shape))
        assert torch.equal(fields["anatomy"][0], without_penumbra(exposed, CARM.camera))  # type: ignore[arg-type]
        assert told == ()
    with pytest.raises(InputError, match=r"views\[0\]\.field: exposes no pixel"):
        read_images(case_with(tmp_path, beam, field=Circle((-50, -50), 3)))


def test_what_holds_of_several_images_is_said_once() -> None:
    round_one, bright = "a round shutter", "saturated"
    told = reading_of_images._summed(
        {"anatomy": [(round_one,), (round_one,), (round_one,)], "device": [(round_one,), (bright,), ()]}
    )
    assert told == [
        "anatomy images of views 1, 2 and 3, device image of view 1: a round shutter",
        "view 2, device image: saturated",
    ]
