"""Where images are as bright as they can tell, nothing speaks against a result: no bend, nothing that came or went."""

from dataclasses import replace
from pathlib import Path

import torch
import trimesh
from registration_scenes import CARM, KINDS, images_of_broken, make_scene, true_poses
from torch import Tensor

from femoreg_torch.case import Case, CaseObject, Model, Start, View
from femoreg_torch.fluoro import write_image
from femoreg_torch.registration import Scene
from femoreg_torch.registration.doubts.shape import doubts_about_rigidity
from femoreg_torch.registration.evidence.besides import besides, rival
from femoreg_torch.registration.evidence.rigidity import bend, images_of
from femoreg_torch.registration.imaging import PLAIN
from femoreg_torch.registration.prepare.scene import prepare_scene

TRUTH = true_poses()
ROWS = torch.arange(88)[:, None].expand(88, 88)
BRIGHT = ROWS >= 52  # an end of the device lies before it


def cut_off(scene: Scene, bright: Tensor = BRIGHT, cut: float = 1.0, exposure: float = 0.0) -> Scene:
    """The scene with so much more light on a part of the detector, and less in images with the device, than they tell.

    All are logarithms: shadows that are fainter than `cut` are not told before the bright part.
    """
    images = {
        kind: tuple(
            (image + exposure * (kind == "device") - cut * bright).clamp_min(0) for image in of if image is not None
        )
        for kind, of in scene.images.items()
    }
    told = {kind: tuple(bright & (image == 0) for image in of) for kind, of in images.items()}
    return replace(scene, images=images, saturated=told)


def test_a_device_whose_end_lies_before_saturated_light_is_not_taken_for_bent() -> None:
    scene = cut_off(make_scene(TRUTH), cut=3.0)
    (told,) = doubts_about_rigidity(scene, TRUTH, PLAIN)
    assert "the ends of the device" in told
    assert doubts_about_rigidity(scene.where_unsaturated(), TRUTH, PLAIN) == ()


def test_a_bent_device_is_told_by_what_lies_elsewhere() -> None:
    bent = replace(make_scene(TRUTH), images=images_of_broken("device", 2, TRUTH, KINDS))
    (told,) = doubts_about_rigidity(cut_off(bent, ROWS >= 60).where_unsaturated(), TRUTH, PLAIN)
    assert "the ends of the device" in told


def test_saturated_light_that_no_exposure_changes_is_nothing_that_came() -> None:
    plain = make_scene(TRUTH)
    tissue = {kind: tuple(image + 1.5 for image in of if image is not None) for kind, of in plain.images.items()}
    scene = cut_off(replace(plain, images=tissue), cut=2.5, exposure=-0.5)
    assert any(found.more for found in besides(scene, TRUTH, "device", "device"))
    clear = scene.where_unsaturated()
    assert not any(found.more or found.less for found in besides(clear, TRUTH, "device", "device"))


def test_an_image_with_a_device_is_cut_where_that_without_it_is() -> None:
    plain = make_scene(TRUTH)
    assert plain.where_unsaturated() is plain
    shut = torch.ones(88, 88, dtype=torch.bool)
    shut[:10] = False
    masked = replace(plain, saturated={"anatomy": (BRIGHT, None, None)}, fields={"device": (shut, None, None)})
    clear = masked.where_unsaturated()
    assert torch.equal(clear.fields["anatomy"][0], ~BRIGHT)  # type: ignore[arg-type]
    assert torch.equal(clear.fields["device"][0], shut & ~BRIGHT)  # type: ignore[arg-type]
    assert clear.fields["device"][1] is None


def test_nothing_is_said_where_all_is_saturated() -> None:
    everywhere = torch.ones(88, 88, dtype=torch.bool)
    clear = replace(make_scene(TRUTH), saturated={"anatomy": (everywhere,) * 3}).where_unsaturated()
    assert bend(clear, TRUTH, "femur", 0.5, images_of(clear, TRUTH, "femur", PLAIN)) is None
    assert besides(clear, TRUTH, "device", "device") == []
    assert rival(clear, TRUTH, "device", "device", PLAIN) is None


def test_saturated_pixels_are_recognised_when_a_case_is_read(tmp_path: Path) -> None:
    rod = tmp_path / "rod.stl"
    trimesh.creation.cylinder(4.0, 40.0).export(rod)
    raw = 20000 + 20000 * torch.rand((88, 88), generator=torch.Generator().manual_seed(0))
    pose = torch.eye(4, dtype=torch.float64)
    pose[2, 3] = 640
    objects = {"rod": CaseObject("rod", model=Model(rod, 5000.0), start=Start(camera1_from=pose))}
    for light, expected in ((raw, None), (raw.masked_fill(BRIGHT, 65535), BRIGHT)):
        write_image(tmp_path / "view.tif", light.to(torch.uint16))
        scene = prepare_scene(Case(tmp_path, CARM, objects, views=(View({"image": tmp_path / "view.tif"}),)))
        (found,) = scene.saturated["image"]
        assert (found is None) == (expected is None)
        if found is not None:
            assert torch.equal(found, BRIGHT)
            assert scene.missing[0].startswith("up to 41 % of an image is saturated")
