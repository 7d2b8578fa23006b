"""One scene, stored in every way that pictures are stored, gives one image and one camera inside."""

import itertools

import pytest
import torch

from femoreg_torch.errors import InputError
from femoreg_torch.fluoro import SOURCES, TURNS, Display
from femoreg_torch.geometry import Camera, project_points

CAMERA = Camera(1000.0, (0.5, 0.25), (4, 6), (2.0, 2.5))  # nothing of it is symmetric
DISPLAYS = [Display(*way) for way in itertools.product(SOURCES, (False, True), TURNS)]
# Points in front of a source that stands on each side, mm from the isocentre in LPS; beam and up (S) fix the camera.
POINTS = torch.tensor([[0.1, 0.2, 0.4], [0.6, -0.3, -0.5], [-0.7, 0.5, 0.1]], dtype=torch.float64)


@pytest.mark.parametrize("display", DISPLAYS, ids=str)
def test_pixels_cameras_and_places_go_together_and_come_back(display: Display) -> None:
    image = torch.rand(4, 6, generator=torch.Generator().manual_seed(0))
    stored = display.to_stored(image)
    as_stored = display.stored_camera(CAMERA)
    assert stored.shape == as_stored.shape
    assert torch.equal(display.to_camera(stored), image)
    assert display.camera(as_stored) == CAMERA
    for row, column in itertools.product(range(4), range(6)):
        place = torch.tensor([column, row])
        there = display.pixels_to_stored(place, CAMERA)
        assert stored[there[1], there[0]] == image[row, column]
        assert torch.equal(display.pixels_to_camera(there, CAMERA), place)
    principal = torch.tensor(CAMERA.principal_point_px)
    assert display.pixels_to_stored(principal, CAMERA).tolist() == list(as_stored.principal_point_px)


# Where the patient's left (or, from the sides, back) and head lie in a picture that stands head up, not mirrored, as
# people know it: right and up. Pictures of real patients, in short.
@pytest.mark.parametrize("source", SOURCES)
def test_a_usual_picture_shows_left_on_the_right_whatever_the_side(source: str) -> None:
    display = Display(source)  # type: ignore[arg-type]
    forward = torch.tensor(display.beam, dtype=torch.float64)
    down = torch.tensor([0.0, 0.0, -1.0], dtype=torch.float64)
    right = torch.linalg.cross(down, forward)  # a right-handed camera
    camera_from_lps = torch.stack([right, down, forward])
    camera = Camera(1000.0, (1.0, 1.0), (101, 101), (50.0, 50.0))
    shown = torch.tensor([[1.0, 0, 0], [0, 1, 0], [0, 0, 1]], dtype=torch.float64) * 10  # L, P, S
    seen = project_points(camera, shown @ camera_from_lps.T + torch.tensor([0, 0, 700.0], dtype=torch.float64))
    pixels = display.pixels_to_stored(seen, camera)
    across = 0 if source in ("anterior", "posterior") else 1
    assert pixels[across, 0] > 55  # left, or back, on the right
    assert pixels[across, 1] == pytest.approx(50)
    assert pixels[2, 1] < 45  # head up


def test_turned_is_clockwise() -> None:
    upright = torch.tensor([[1, 2], [3, 4]])
    assert Display(turned_deg=90).to_camera(torch.tensor([[3, 1], [4, 2]])).equal(upright)
    assert Display(mirrored=True).to_camera(torch.tensor([[2, 1], [4, 3]])).equal(upright)


def test_unknown_sides_are_refused() -> None:
    with pytest.raises(InputError, match="display"):
        Display(turned_deg=45)
