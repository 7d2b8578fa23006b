"""What the pointer does to landmarks and objects: against the pinhole camera, by hand."""

import math
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from femoreg_torch.case import Case, read_case
from femoreg_torch.errors import InputError
from femoreg_torch.fluoro import Display
from femoreg_torch.geometry import Poses, project_points, transform_points
from femoreg_torch.registration import Scene
from femoreg_torch.review.kept import forget, keep_landmarks, keep_poses, landmarks_path, start_path, with_kept
from femoreg_torch.review.placing import (
    ALL,
    Mark,
    Move,
    Placed,
    as_stored,
    by_landmarks,
    in_camera,
    marked,
    moved,
    placed_at_first,
    unmarked,
)

DrawnScene = tuple[Case, Scene]


@pytest.fixture
def placed(drawn_scene: DrawnScene, true_pose: torch.Tensor) -> Placed:
    """Both bones where they are, and two views, the second from 20° beside the first."""
    turned = torch.eye(4, dtype=torch.float64)
    angle = math.radians(20)
    turned[:3, :3] = torch.tensor(
        [[math.cos(angle), 0, math.sin(angle)], [0, 1, 0], [-math.sin(angle), 0, math.cos(angle)]]
    )
    turned[:3, 3] = torch.tensor([-700 * math.sin(angle), 0, 700 * (1 - math.cos(angle))])
    cameras = torch.stack([torch.eye(4, dtype=torch.float64), turned])
    return Placed({}, Poses(cameras, {"pelvis": true_pose, "femur": true_pose.clone()}), frozenset({0, 1}))


def seen(scene: Scene, placed: Placed, name: str, view: int, points: torch.Tensor | None = None) -> torch.Tensor:
    points = scene.objects[name].reference_point[None] if points is None else points
    return project_points(scene.carm.camera, transform_points(placed.poses.camera_from(name)[view], points))


@pytest.mark.parametrize("view", [1, 2])
def test_a_shift_moves_the_reference_point_by_so_many_pixels(
    drawn_scene: DrawnScene, placed: Placed, view: int
) -> None:
    _, scene = drawn_scene
    after = moved(scene, placed, Move("femur", view, shift_px=[7.0, -4.0]))
    there = seen(scene, after, "femur", view - 1) - seen(scene, placed, "femur", view - 1)
    assert torch.allclose(there, torch.tensor([[7.0, -4.0]], dtype=torch.float64), atol=1e-9)
    assert after.poses.camera1_from["pelvis"] is placed.poses.camera1_from["pelvis"]


def test_a_turn_is_clockwise_in_the_image_and_about_the_reference_point(
    drawn_scene: DrawnScene, placed: Placed
) -> None:
    """What lies to the right of the reference point comes to lie below it, as rows count downwards."""
    _, scene = drawn_scene
    beside = scene.objects["femur"].reference_point + torch.tensor([20.0, 0, 0], dtype=torch.float64)  # LPS: left
    points = torch.stack([scene.objects["femur"].reference_point, beside])
    after = moved(scene, placed, Move("femur", 1, turn_deg=90.0))
    middle, end = seen(scene, after, "femur", 0, points)
    assert torch.allclose(middle, seen(scene, placed, "femur", 0)[0], atol=1e-9)
    assert float((end - middle)[1]) > 5
    assert abs(float((end - middle)[0])) < 1e-6


def test_depth_leaves_the_reference_point_where_it_is_seen(drawn_scene: DrawnScene, placed: Placed) -> None:
    _, scene = drawn_scene
    after = moved(scene, placed, Move("femur", 1, depth_mm=40.0))
    assert torch.allclose(seen(scene, after, "femur", 0), seen(scene, placed, "femur", 0), atol=1e-9)
    point = scene.objects["femur"].reference_point[None]
    depths = [float(transform_points(p.poses.camera1_from["femur"], point)[0, 2]) for p in (placed, after)]
    assert depths[1] - depths[0] == pytest.approx(40.0)


def test_all_objects_move_as_one(drawn_scene: DrawnScene, placed: Placed) -> None:
    _, scene = drawn_scene
    move = Move(ALL, 2, shift_px=[3.0, 2.0], turn_deg=10.0, tilt_deg=[4.0, -3.0], depth_mm=15.0)
    after = moved(scene, placed, move).poses.camera1_from
    assert torch.allclose(after["pelvis"], after["femur"], atol=1e-9)
    assert not torch.allclose(after["pelvis"], placed.poses.camera1_from["pelvis"], atol=1.0)


@pytest.mark.parametrize(
    ("move", "says"),
    [
        (Move("tibia", 1), "no object 'tibia'"),
        (Move("femur", 3), "where the C-arm stood for view 3 is not known"),
        (Move("femur", 1, depth_mm=-800.0), "between source and detector"),
        (Move("femur", 1, depth_mm=500.0), "between source and detector"),
    ],
)
def test_what_cannot_be_is_refused_in_words(drawn_scene: DrawnScene, placed: Placed, move: Move, says: str) -> None:
    with pytest.raises(InputError, match=says):
        moved(drawn_scene[1], placed, move)


def test_landmarks_are_put_and_taken_away(drawn_scene: DrawnScene, placed: Placed) -> None:
    case, _ = drawn_scene
    there = marked(case, placed, Mark("FH-l", 10.0, 20.0))
    assert there.landmarks == {"FH-l": (10.0, 20.0)}
    assert unmarked(there, "FH-l").landmarks == {}
    with pytest.raises(InputError, match="no landmark 'nose'"):
        marked(case, placed, Mark("nose", 1.0, 1.0))
    with pytest.raises(InputError, match="not in the image"):
        unmarked(placed, "FH-l")


def test_landmarks_place_the_bones(drawn_scene: DrawnScene, placed: Placed, true_pose: torch.Tensor) -> None:
    case, scene = drawn_scene
    pixels = project_points(scene.carm.camera, transform_points(true_pose, torch.stack(list(case.landmarks.values()))))
    first = placed_at_first(case, scene, None)
    assert first.views == {0}
    for name, (column, row) in zip(case.landmarks, pixels.tolist(), strict=True):
        first = marked(case, first, Mark(name, column, row))
    assert not torch.allclose(first.poses.camera1_from["pelvis"], true_pose, atol=1.0)
    after = by_landmarks(case, scene, first).poses.camera1_from
    assert torch.allclose(after["pelvis"], true_pose, atol=0.5)
    assert torch.equal(after["femur"], after["pelvis"])


def test_the_first_guess_is_head_up_in_the_isocentre(drawn_scene: DrawnScene) -> None:
    """Seen from in front, the patient's left is on the right of the image, and the head at its top."""
    case, scene = drawn_scene
    pose = placed_at_first(case, scene, None).poses.camera1_from["pelvis"]
    middle = scene.objects["pelvis"].reference_point
    points = middle + torch.tensor([[0.0, 0, 0], [10, 0, 0], [0, 0, 10]], dtype=torch.float64)
    centre, left, head = project_points(scene.carm.camera, transform_points(pose, points))
    assert torch.allclose(transform_points(pose, middle[None])[0], torch.tensor(case.carm.isocentre_mm).double())
    assert left[0] > centre[0] + 1
    assert head[1] < centre[1] - 1


def test_places_go_to_stored_images_and_back(drawn_case: Path) -> None:
    """In a picture that was mirrored and then turned by 90° clockwise, the camera's top left is at the bottom right."""
    case = read_case(drawn_case)
    turned = replace(case, display=Display(mirrored=True, turned_deg=90))
    stored = as_stored(turned, {"FH-l": (0.0, 0.0)})
    assert stored == {"FH-l": (95.0, 95.0)}
    assert in_camera(turned, stored) == {"FH-l": (0.0, 0.0)}


def test_what_is_placed_is_kept_until_it_is_forgotten(drawn_scene: DrawnScene, placed: Placed, tmp_path: Path) -> None:
    case, scene = drawn_scene
    run = tmp_path / "out" / "run"
    first = placed_at_first(case, scene, None)
    assert with_kept(run, case, scene, first) is first
    marks = marked(case, placed, Mark("FH-l", 10.25, 20.5))
    keep_landmarks(run, case, marks)
    keep_poses(run, marks)
    again = with_kept(run, case, scene, first)
    assert again.landmarks == {"FH-l": (10.25, 20.5)}
    assert torch.allclose(again.poses.camera1_from["femur"], placed.poses.camera1_from["femur"], atol=1e-8)
    start_path(run).write_text('{"camera1_from_nose": [[1,0,0,0],[0,1,0,0],[0,0,1,0],[0,0,0,1]]}', encoding="utf-8")
    with pytest.raises(InputError, match=r"run\.start\.json: there is no object 'nose'"):
        with_kept(run, case, scene, first)
    forget(run)
    assert not landmarks_path(run).exists()
    assert not start_path(run).exists()
