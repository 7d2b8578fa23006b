"""What a detection must offer to start a registration."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from femoreg_torch.anatomy import HIP
from femoreg_torch.case import Case, CaseObject, View
from femoreg_torch.detect import Detection
from femoreg_torch.errors import InputError
from femoreg_torch.fluoro import Display
from femoreg_torch.geometry import CArm, centred_camera, project_points, rotation_angle, transform_points
from femoreg_torch.registration import RigidObject, Scene
from femoreg_torch.registration.run import register
from femoreg_torch.registration.start.by_hand import start_by_landmarks
from femoreg_torch.registration.start.by_network import start_by_detection
from femoreg_torch.registration.start.find import find_start
from femoreg_torch.volume import Volume, axis_aligned

CAMERA = centred_camera(1020.0, (0.776, 0.776), (384, 384))
CARM = CArm(CAMERA, (0.0, 0.0, 632.0), (0.0, 1.0, 0.0))
NAMES = HIP.landmark_names
SIX = [[75.0, 15, -25], [48, 10, -120], [30, -10, -112], [4, -45, -108], [4, -20, -120], [125, -75, -25]]
POSE = torch.tensor([[1.0, 0, 0, -30], [0, 0, -1, -80], [0, 1, 0, 740], [0, 0, 0, 1]], dtype=torch.float64)


def case_of(landmarks: dict[str, torch.Tensor]) -> Case:
    return Case(
        folder=Path("case"),
        carm=CARM,
        objects={"pelvis": CaseObject("pelvis", bones=("pelvis",))},
        views=(View({"anatomy": Path("view1.tif")}),),
        anatomy=HIP,
        landmarks=landmarks,
    )


def scene() -> Scene:
    box = Volume(torch.ones(4, 4, 4), axis_aligned((10.0, 10.0, 10.0), (0.0, 0.0, 0.0)))
    objects = {"pelvis": RigidObject(box, torch.zeros(3, dtype=torch.float64), ("anatomy",))}
    image = torch.rand(CAMERA.shape, generator=torch.Generator().manual_seed(3))
    return Scene(CARM, objects, {"anatomy": (image,)})


def hip_case() -> Case:
    return case_of({name: torch.zeros(3, dtype=torch.float64) for name in NAMES})


def detection(visible: int, inverted: bool) -> Detection:
    seen = torch.arange(len(NAMES)) < visible
    ones = torch.ones(len(NAMES), dtype=torch.float64)
    pixels = torch.zeros(len(NAMES), 2, dtype=torch.float64)
    return Detection(pixels, ones, ones, seen, torch.zeros(1 + len(HIP.bones), 96, 96), CAMERA, False, inverted)


def test_too_few_landmarks_are_refused() -> None:
    with pytest.raises(InputError, match=r"view1.tif: 3 usable landmarks found, at least 4"):
        start_by_detection(hip_case(), scene(), detection(3, inverted=False))


def test_a_view_from_a_side_asks_for_landmarks_by_hand() -> None:
    case = replace(hip_case(), display=Display("left"))
    with pytest.raises(InputError, match=r"taken from a side, .* \(--landmarks\)"):
        start_by_detection(case, scene(), detection(3, inverted=False))


def test_inverted_grey_values_are_refused_however_many_landmarks_there_are() -> None:
    with pytest.raises(InputError, match=r"view1.tif: bone seems to be darker.*\(--landmarks\)"):
        start_by_detection(hip_case(), scene(), detection(14, inverted=True))


def test_a_picture_with_hardly_a_grey_value_where_bones_are_is_told_so() -> None:
    """As one of 8 bits in proportion to the light; that bone were dark would be told falsely."""
    full = scene()
    coarse = (4 * full.images["anatomy"][0]).round() / 4
    with pytest.raises(InputError, match=r"view1.tif: half of the picture.* no more than 3 grey values.*16 bits"):
        start_by_detection(hip_case(), replace(full, images={"anatomy": (coarse,)}), detection(14, inverted=True))


@pytest.mark.parametrize(
    ("display", "turned"), [(Display(), 90), (Display(turned_deg=90), 180), (Display("posterior"), 270)]
)
def test_a_picture_that_shows_more_when_turned_is_asked_to_be(display: Display, turned: int) -> None:
    """The landmarks are found in the picture turned by a quarter, which the network is asked for after it failed."""
    landmarks = dict(zip(NAMES[:6], torch.tensor(SIX, dtype=torch.float64), strict=True))
    found = detection(6, inverted=False)
    pose = POSE if display.source == "anterior" else POSE @ torch.diag(torch.tensor([-1.0, -1, 1, 1]).double())
    found.pixels[:6] = project_points(CAMERA, transform_points(pose, torch.stack(list(landmarks.values()))))
    case, plain = replace(case_of(landmarks), display=display), scene()
    image = plain.image("anatomy", 0)

    def find(shown: torch.Tensor, _: object) -> Detection:
        return found if torch.equal(shown, image.rot90(1)) else detection(1, inverted=False)

    with pytest.raises(InputError, match=rf"view1.tif: 1 usable .* 6 landmarks that agree.*turned: {turned}\}}"):
        start_by_detection(case, plain, find(image, CAMERA), find)
    with pytest.raises(InputError, match=r"\(--start\)\.$"):
        start_by_detection(case, plain, find(image, CAMERA), lambda *_: detection(1, inverted=False))


@pytest.mark.parametrize("display", [Display(), Display("left")])
def test_a_view_that_shows_more_is_asked_to_be_the_first(display: Display) -> None:
    landmarks = dict(zip(NAMES[:6], torch.tensor(SIX, dtype=torch.float64), strict=True))
    found = detection(6, inverted=False)
    found.pixels[:6] = project_points(CAMERA, transform_points(CENTRED, torch.stack(list(landmarks.values()))))
    images = tuple(torch.rand(CAMERA.shape, generator=torch.Generator().manual_seed(seed)) for seed in (3, 4, 5))
    views = (
        View({"anatomy": Path("view1.tif")}, display=display),
        *[View({"anatomy": Path("other.tif")}, display=Display())] * 2,
    )
    case = replace(case_of(landmarks), views=views)

    def find(shown: torch.Tensor, _: object) -> Detection:
        return found if torch.equal(shown, images[2]) else detection(3, inverted=False)

    three = replace(scene(), images={"anatomy": images})
    with pytest.raises(InputError, match=r"view1.tif: .*View 3 shows 6 landmarks that agree: list it first, and"):
        start_by_detection(case, three, detection(3, inverted=False), find)
    with pytest.raises(InputError) as nothing:
        start_by_detection(case, three, detection(3, inverted=False), lambda *_: detection(3, inverted=False))
    assert "list it first" not in str(nothing.value)


def test_a_rotation_left_open_is_refused_where_no_outline_can_mend_it() -> None:
    """Six landmarks of one hip, seen exactly but trusted to some mm only."""
    points = torch.tensor(SIX, dtype=torch.float64)
    landmarks = dict(zip(NAMES[:6], points, strict=True))
    found = detection(6, inverted=False)
    found.pixels[:6] = project_points(CAMERA, transform_points(POSE, points))
    start = find_start(landmarks, found, torch.rand(CAMERA.shape), CAMERA, None, HIP)
    assert rotation_angle(start.camera_from_ct[:3, :3] @ POSE[:3, :3].mT) < 0.02
    vague = replace(found, deviation_px=9 * found.deviation_px)
    with pytest.raises(InputError, match=r"fix the rotation only to \d+°, and no outlines help"):
        find_start(landmarks, vague, torch.rand(CAMERA.shape), CAMERA, None, HIP)


def test_landmarks_picked_by_hand_place_the_first_object() -> None:
    points = torch.tensor([*SIX, [-75.0, 15, -25], [-60, -75, -25]], dtype=torch.float64)
    names = [*NAMES[:6], "FH-x", "ASIS-x"]  # names of the user's own
    case = case_of(dict(zip(names, points, strict=True)))
    pixels = dict(zip(names, project_points(CAMERA, transform_points(POSE, points)), strict=True))
    start = start_by_landmarks(case, "pelvis", pixels)
    torch.testing.assert_close(start.camera1_from_object, POSE, atol=0.05, rtol=0)
    assert start.object == "pelvis"
    assert all(mark.used for mark in start.landmarks.values())
    wrong = pixels | {names[0]: pixels[names[0]] + 90}
    outlier = start_by_landmarks(case, "pelvis", wrong)
    assert [name for name, mark in outlier.landmarks.items() if not mark.used] == [names[0]]
    torch.testing.assert_close(outlier.camera1_from_object[:3, 3], POSE[:3, 3], atol=3.0, rtol=0)


CENTRED = POSE - 0
CENTRED[0, 3] = 0.0


def picked(landmarks: dict[str, torch.Tensor]) -> torch.Tensor:
    return project_points(CAMERA, transform_points(CENTRED, torch.stack(list(landmarks.values()))))


def pelvis() -> dict[str, torch.Tensor]:
    """A hip of the user's own with landmarks on both sides, LPS mm, seen from the front."""
    left = {
        "GSN": (60.0, 8, -70),
        "IOF": (60, -18, -118),
        "MOF": (45, 10, -118),
        "SPS": (12, -18, -80),
        "ASIS": (90, -60, -22),
    }
    sides = (("l", 1.0), ("r", -1.0))
    return {
        f"{name}-{end}": torch.tensor([sign * x, y, z], dtype=torch.float64)
        for name, (x, y, z) in left.items()
        for end, sign in sides
    }


def test_landmarks_beside_the_picture_were_not_picked_in_it() -> None:
    case = case_of(pelvis())
    right = dict(zip(case.landmarks, picked(pelvis()), strict=True))
    start_by_landmarks(case, "pelvis", right)
    with pytest.raises(InputError, match=r"GSN-l at \(-.* and 7 more lie outside the picture of 384 × 384 .* says RAS"):
        start_by_landmarks(case, "pelvis", {name: -place for name, place in right.items()})
    with pytest.raises(
        InputError, match=r"lie outside the picture of 384 × 384 pixels. Are they of a picture of another"
    ):
        start_by_landmarks(case, "pelvis", {name: 4 * place for name, place in right.items()})
    start_by_landmarks(case, "pelvis", right | {"MOF-r": torch.tensor([400.0, 40.0]).double()})  # an outlier


@pytest.mark.parametrize("pixel_mm", [0.776, 0.388])
def test_landmarks_in_mm_are_refused(pixel_mm: float) -> None:
    """The patient seems to lie on the detector, or far behind it."""
    camera = centred_camera(1020.0, (pixel_mm, pixel_mm), (round(298 / pixel_mm),) * 2)
    case = replace(case_of(pelvis()), carm=replace(CARM, camera=camera))
    far = CENTRED + torch.tensor([[0.0], [0], [40], [0]]) * torch.tensor([0.0, 0, 0, 1])
    pixels = project_points(camera, transform_points(far, torch.stack(list(pelvis().values()))))
    start_by_landmarks(case, "pelvis", dict(zip(pelvis(), pixels, strict=True)))
    with pytest.raises(InputError, match=r"They fit in mm instead of pixels, as 3D Slicer shows them"):
        start_by_landmarks(case, "pelvis", dict(zip(pelvis(), pixel_mm * pixels, strict=True)))


@pytest.mark.parametrize(
    ("wrong", "says"),
    [
        (
            lambda name, place: (name, torch.stack([place[0], 383 - place[1]])),
            "They fit with rows counted from below.$",
        ),
        (lambda name, place: (name, place.flip(0)), "They fit with column and row exchanged.$"),
        (
            lambda name, place: (name[:-1] + {"l": "r", "r": "l"}[name[-1]], place),
            r"They fit with left and right exchanged \(-l and -r\), or in a picture that is mirrored.$",
        ),
    ],
)
def test_landmarks_that_fit_if_they_are_meant_otherwise(
    wrong: Callable[[str, torch.Tensor], tuple[str, torch.Tensor]], says: str
) -> None:
    case = case_of(pelvis())
    marks = dict(wrong(name, place) for name, place in zip(pelvis(), picked(pelvis()), strict=True))
    with pytest.raises(InputError, match=says):
        start_by_landmarks(case, "pelvis", marks)


def test_too_few_landmarks_by_hand_are_refused() -> None:
    case = case_of(dict(zip(NAMES[:6], torch.tensor(SIX, dtype=torch.float64), strict=True)))
    pixels = {name: torch.zeros(2, dtype=torch.float64) for name in (*NAMES[:3], "knee", "ankle")}
    with pytest.raises(InputError, match="3 have the name of a landmark of the case"):
        start_by_landmarks(case, "pelvis", pixels)


@pytest.mark.parametrize(
    ("poses", "says"),
    [
        (POSE[None], r"camera_from_camera1\[0\]: the identity was expected, as camera 1 is the frame"),
        (torch.eye(4, dtype=torch.float64).repeat(2, 1, 1), r"camera_from_camera1: \(1, 4, 4\) was expected"),
    ],
)
def test_given_poses_of_the_c_arm_are_in_the_frame_of_camera_1(poses: torch.Tensor, says: str) -> None:
    with pytest.raises(InputError, match=says):
        register(hip_case(), camera_from_camera1=poses)
