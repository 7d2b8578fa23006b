"""Where a model ends along its guide, of shapes whose ends are known."""

import math

import pytest
import torch
import trimesh
from torch import Tensor

from femoreg_torch.registration.prepare.models import told_of_end, told_of_middle
from femoreg_torch.volume import Volume, guide_end, voxelise_mesh

TIP, BASE = torch.zeros(3, dtype=torch.float64), torch.tensor([0.0, 0.0, 100.0], dtype=torch.float64)


def needle(radius: float = 2.0, along: Tensor = BASE) -> trimesh.Trimesh:
    """A rod of 100 mm whose end lies at the origin."""
    return trimesh.creation.cylinder(radius, segment=[[0, 0, 0], along.tolist()])


def voxels(*meshes: trimesh.Trimesh) -> Volume:
    return voxelise_mesh(trimesh.util.concatenate(meshes), 0.5, 5000.0)


def test_a_right_tip_lies_at_the_end_of_the_model() -> None:
    end = guide_end(voxels(needle()), BASE, TIP)
    assert end is not None
    assert end.beyond_mm == pytest.approx(0, abs=0.5)
    assert end.off_middle_mm < 0.1
    assert end.aside_mm == 0
    assert told_of_end("device", voxels(needle()), {"tip": TIP, "base": BASE}) == ()
    assert told_of_middle("device", voxels(needle()), {"tip": TIP, "base": BASE}) == ()


def test_a_thin_point_is_the_end_of_its_model() -> None:
    """Of a wire of 1 mm: the last voxels hold next to nothing of it."""
    wire = trimesh.creation.cylinder(0.5, segment=[[0, 0, 10], [0, 0, 100]])
    point = trimesh.creation.cone(0.5, 10, transform=trimesh.transformations.rotation_matrix(math.pi, [1, 0, 0]))
    point.apply_translation([0, 0, 10])
    assert point.bounds[0, 2] == pytest.approx(0)
    assert told_of_end("device", voxels(wire, point), {"tip": TIP, "base": BASE}) == ()


def test_a_point_tells_where_the_model_ends_if_the_tip_does_not() -> None:
    inside = {"tip": TIP + 0.12 * BASE, "base": BASE}
    (told,) = told_of_end("device", voxels(needle()), inside)
    assert "tell the point `end` too" in told
    assert told_of_end("device", voxels(needle()), {**inside, "end": TIP}) == ()
    (told,) = told_of_end("device", voxels(needle()), {**inside, "end": TIP - 0.05 * BASE})
    assert "the point end of the device" in told
    assert "beyond the end of its model" in told
    (told,) = told_of_end("device", voxels(needle()), {"tip": TIP - 0.5 * BASE, "base": BASE})
    assert "far from where its model ends" in told


@pytest.mark.parametrize("direction", [[0.0, 0.0, 1.0], [0.6, -0.64, 0.48]])
@pytest.mark.parametrize(("along", "across"), [(3.0, 0.0), (-4.0, 0.0), (0.0, 3.0), (2.5, 4.0)])
def test_another_origin_is_told_by_as_much(direction: list[float], along: float, across: float) -> None:
    axis = torch.tensor(direction, dtype=torch.float64)
    aside = torch.linalg.cross(axis, torch.tensor([1.0, 2.0, 3.0], dtype=torch.float64))
    shift = -along * axis + across * aside / aside.norm()
    end = guide_end(voxels(needle(2.0, 100 * axis)), 100 * axis + shift, TIP + shift)
    assert end is not None
    assert end.beyond_mm == pytest.approx(along, abs=0.8)  # partly filled voxels count
    assert end.off_middle_mm == pytest.approx(across, abs=0.15)
    assert end.aside_mm == pytest.approx(max(0, across - 2), abs=0.5)
    points = {"tip": TIP + shift, "base": 100 * axis + shift}
    assert len(told_of_end("device", voxels(needle(2.0, 100 * axis)), points)) == (along != 0)
    assert len(told_of_middle("device", voxels(needle(2.0, 100 * axis)), points)) == (across != 0)


def test_a_line_within_a_thick_sleeve_passes_beside_its_middle() -> None:
    sleeve = trimesh.creation.annulus(4.5, 6.0, 100)
    sleeve.apply_translation([0, 0, 50])
    end = guide_end(voxels(sleeve), BASE, TIP + 0.05 * torch.linalg.cross(BASE, torch.tensor([0.0, 1, 0]).double()))
    assert end is not None
    assert end.off_middle_mm == pytest.approx(5, abs=0.3)
    assert end.aside_mm == 0


def test_what_stands_beside_a_guide_is_no_end_of_it() -> None:
    pin = trimesh.creation.cylinder(2.0, segment=[[12, 0, -14], [12, 0, 40]])
    end = guide_end(voxels(needle(), pin), BASE, TIP)
    assert end is not None
    assert end.beyond_mm == pytest.approx(0, abs=0.5)
    assert guide_end(voxels(pin), BASE, TIP) is None


@pytest.mark.parametrize("radius", [0.8, 2.0, 5.0])
@pytest.mark.parametrize("deg", [0.0, 2.0, 4.0])
def test_a_line_that_leans_is_told_by_its_angle(radius: float, deg: float) -> None:
    """A rod that was turned about its end against the points that are told of it, thick and thin."""
    turned = torch.tensor([math.sin(math.radians(deg)), 0, math.cos(math.radians(deg))], dtype=torch.float64)
    end = guide_end(voxels(needle(radius, 100 * turned)), BASE, TIP)
    assert end is not None
    assert end.leaning_deg == pytest.approx(deg, abs=0.4)


def test_a_plate_a_hook_and_a_cone_do_not_lean() -> None:
    """A plate beside the guide, an end that is not straight, and sides that lean about a middle that does not."""
    plate = trimesh.creation.box((60, 4, 60), trimesh.transformations.translation_matrix([20, 0, 40]))
    hook = trimesh.creation.cylinder(2.0, segment=[[0, 0, 14], [5, 0, 22]])
    back = trimesh.creation.cylinder(2.0, segment=[[5, 0, 22], [0, 0, 40]])
    straight = trimesh.creation.cylinder(2.0, segment=[[0, 0, 0], [0, 0, 14]])
    cone = trimesh.creation.cone(7.0, 60, transform=trimesh.transformations.rotation_matrix(math.pi, [1, 0, 0]))
    cone.apply_translation([0, 0, 60])
    models = voxels(needle(), plate), voxels(cone), voxels(straight, hook, back)
    ends = [guide_end(model, BASE, TIP) for model in models]
    leaning = [end.leaning_deg for end in ends if end is not None]
    assert leaning[:2] == pytest.approx([0, 0], abs=0.3)
    assert math.isnan(leaning[2])
