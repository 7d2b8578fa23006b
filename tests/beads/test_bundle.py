"""All views at once: exact input, covariance against Monte Carlo, outliers, and what is left open."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from bead_scenes import CAMERA, DEVICE, FEMUR, pose
from scipy.optimize import least_squares
from torch import Tensor

from femoreg_torch.beads import Beads, Sight, bundle, metric_deviations, object_rows, pose_uncertainty
from femoreg_torch.beads.uncertainty import view_rows
from femoreg_torch.case import PlannedPath
from femoreg_torch.errors import InputError
from femoreg_torch.evaluation import ReferencePoints, errors
from femoreg_torch.evaluation.errors import paper_from_camera
from femoreg_torch.geometry import Poses, about_point, exp_se3, invert_rigid, log_so3, project_points, transform_points

ISOCENTRE = torch.tensor([0.0, 0.0, 632.0], dtype=torch.float64)
VIEWS = ((0.0, 0.0), (0.01, 0.18), (0.02, -0.26))  # of the C-arm: turns about columns and rows, rad
TRUE = Poses(
    torch.stack([about_point(exp_se3(torch.tensor([x, y, 0, 50 * x, 0, 0]).double()), ISOCENTRE) for x, y in VIEWS]),
    {
        "femur": pose((0.1, -0.1, 0.2, 5, 8, 0), 755, FEMUR),
        "device": pose((0.4, 0.2, -0.3, -5, 3, 4), 560, DEVICE),
    },
)
POINTS = ReferencePoints(
    {"femur": FEMUR.mean(0) + torch.tensor([-10.0, 4, 8]), "device": DEVICE.mean(0)},
    PlannedPath("femur", FEMUR[6], FEMUR[0], "device"),
    (torch.tensor([0.0, 0, 0]).double(), torch.tensor([0.0, 0, 100]).double()),
)


def beads(deviation_mm: float = 0.0) -> list[Beads]:
    """Of both objects."""
    names = ("abcdefg", "ABCDE")
    return [
        Beads(name, tuple(letters), points, 1.0, torch.full((len(points),), deviation_mm, dtype=torch.float64))
        for name, letters, points in zip(("femur", "device"), names, (FEMUR, DEVICE), strict=True)
    ]


def sights(noise_px: float, bead_mm: float, seed: int, views: int = 3) -> list[Sight]:
    """Shadows of beads that lie elsewhere by `bead_mm`, with noise, drawn by the pinhole formula."""
    rng = torch.Generator().manual_seed(seed)
    found = []
    for name, points in (("femur", FEMUR), ("device", DEVICE)):
        moved = points + bead_mm * torch.randn(points.shape, generator=rng, dtype=torch.float64)
        for view in range(views):
            places = transform_points(TRUE.camera_from(name)[view], moved).numpy()
            x, y = CAMERA.principal_point_px
            columns = x + places[:, 0] / places[:, 2] * CAMERA.sdd_mm / CAMERA.pixel_mm[1]
            rows = y + places[:, 1] / places[:, 2] * CAMERA.sdd_mm / CAMERA.pixel_mm[0]
            noisy = (
                np.stack([columns, rows], 1) + noise_px * torch.randn(len(points), 2, generator=rng).double().numpy()
            )
            found += [Sight(name, n, view, f"view{view + 1}.tif", (c, r)) for n, (c, r) in enumerate(noisy.tolist())]
    return found


def off(views: int = 3) -> Poses:
    """The truth some degrees and millimetres off, as a single view leaves it."""
    nudge = exp_se3(torch.tensor([0.004, -0.006, 0.003, 0.3, -0.2, 6.0]).double())
    cameras = TRUE.camera_from_camera1[:views].clone()
    cameras[1:] = nudge @ cameras[1:]
    return Poses(cameras, {name: nudge @ placed for name, placed in TRUE.camera1_from.items()})


def change(found: Poses) -> Tensor:
    """Twists (12,) of femur and device from the truth: rotation vector, displacement of the reference point."""
    rows = []
    for name in ("femur", "device"):
        there, here = TRUE.camera1_from[name], found.camera1_from[name]
        point = POINTS.objects[name][None]
        shift = (transform_points(here, point) - transform_points(there, point))[0]
        rows += [log_so3(here[:3, :3] @ there[:3, :3].T), shift]
    return torch.cat(rows)


def test_exact_shadows_give_the_truth() -> None:
    found = bundle(beads(), sights(0, 0, 0), off(), CAMERA)
    assert change(found.poses).abs().max() < 1e-6
    torch.testing.assert_close(found.poses.camera_from_camera1, TRUE.camera_from_camera1, atol=1e-6, rtol=0)
    assert found.used.all()
    assert found.redundancy == pytest.approx(2 * 36 - 24, abs=1e-6)  # 36 shadows, two objects and two views


def test_derivatives_are_those_of_differences() -> None:
    """Against SciPy, which minimises the same residuals with differences and without our derivatives."""
    given = sights(0.5, 0, 1)
    found = bundle(beads(), given, off(), CAMERA, 0.5)
    pixels = np.array([sight.pixel for sight in given])
    views = torch.tensor([sight.view for sight in given])
    known = {"femur": FEMUR, "device": DEVICE}

    def residuals(x: np.ndarray) -> np.ndarray:
        moves = exp_se3(torch.from_numpy(x).reshape(4, 6))
        centres = torch.stack([torch.tensor([0, 0, z]).double() for z in (755, 560, 650, 650)])
        moves = about_point(moves, centres)
        cameras = torch.cat([TRUE.camera_from_camera1[:1], moves[2:] @ TRUE.camera_from_camera1[1:]])
        placed = {"femur": moves[0] @ TRUE.camera1_from["femur"], "device": moves[1] @ TRUE.camera1_from["device"]}
        points = torch.stack([transform_points(placed[s.object], known[s.object][s.bead][None])[0] for s in given])
        drawn = project_points(CAMERA, transform_points(cameras[views], points[:, None]))[:, 0]
        return ((drawn.numpy() - pixels) / 0.5).ravel()

    free = least_squares(residuals, np.zeros(24), x_scale=np.tile([1e-3] * 3 + [0.5] * 3, 4), xtol=1e-14, ftol=1e-14)
    ours = (found.residuals_px / 0.5).ravel()
    assert (ours**2).sum() == pytest.approx(2 * free.cost, rel=1e-6)


@pytest.mark.parametrize(("noise_px", "bead_mm", "views"), [(0.5, 0.0, 3), (0.3, 0.1, 3), (1.0, 0.3, 1)])
def test_covariance_is_that_of_monte_carlo(noise_px: float, bead_mm: float, views: int) -> None:
    """The mean squared Mahalanobis length of 12 errors is 12; single deviations agree within their sampling error."""
    changes, lengths = [], []
    for seed in range(24):
        found = bundle(beads(bead_mm), sights(noise_px, bead_mm, seed, views), off(views), CAMERA, noise_px)
        sure = pose_uncertainty(found, POINTS)
        twist = change(found.poses)
        changes.append(twist)
        lengths.append(float(twist @ torch.linalg.solve(sure.covariance, twist)))
    assert np.mean(lengths) == pytest.approx(12, abs=3.5 * np.sqrt(24 / 24))
    ratio = torch.stack(changes).pow(2).mean(0).sqrt() / sure.covariance.diagonal().sqrt()
    assert ((ratio > 0.5) & (ratio < 1.6)).all()


def test_estimated_noise_is_that_of_the_shadows() -> None:
    estimates = [bundle(beads(0.1), sights(0.4, 0.1, seed), off(), CAMERA) for seed in range(10)]
    assert all(found.estimated for found in estimates)
    assert np.mean([found.deviation_px for found in estimates]) == pytest.approx(0.4, rel=0.12)


@pytest.mark.parametrize("number", [0, 9, 30])
def test_an_outlier_is_left_out(number: int) -> None:
    given = sights(0.3, 0, 4)
    column, row = given[number].pixel
    wrong = Sight(given[number].object, given[number].bead, given[number].view, "", (column + 25, row - 10))
    found = bundle(beads(), [*given[:number], wrong, *given[number + 1 :]], off(), CAMERA)
    assert not found.used[number]
    assert found.used.sum() >= len(given) - 1
    assert change(found.poses)[3:6].norm() < 0.5


def test_metrics_agree_with_monte_carlo() -> None:
    """What the beads leave open of the paper's errors, against the errors of many noisy truths."""
    samples: dict[str, list[float]] = {}
    rows: list[dict[str, float]] = []
    for seed in range(24):
        found = bundle(beads(0.1), sights(0.5, 0.1, seed), off(), CAMERA, 0.5)
        told = errors(TRUE, found.poses, POINTS)
        for key, value in metric_deviations(pose_uncertainty(found, POINTS), found.poses, POINTS).items():
            samples.setdefault(key, []).append(told[key])
            rows.append({key: value})
    for key, values in samples.items():
        expected = next(row[key] for row in rows if key in row)
        assert np.sqrt(np.mean(np.square(values))) == pytest.approx(expected, rel=0.4), key
    assert set(samples) == {"entry_point_mm", "tip_mm", "relative_mm", "path_deg", "guide_deg"}


def test_rows_are_told_along_the_axes_of_the_paper() -> None:
    found = bundle(beads(0.05), sights(0.5, 0.05, 2), off(), CAMERA, 0.5)
    sure = pose_uncertainty(found, POINTS)
    row = object_rows(sure)["femur"]
    assert row["mm_xyz"][2] > 3 * max(row["mm_xyz"][:2])  # depth is what projection tells least
    assert row["mm"] == pytest.approx(np.linalg.norm(row["mm_xyz"]))
    camera_axes = sure.of("femur").diagonal()[3:].sqrt()
    assert torch.tensor(row["mm_xyz"]) == pytest.approx((paper_from_camera("anterior").abs() @ camera_axes).numpy())


def test_views_are_as_sure_as_monte_carlo_says() -> None:
    sources = []
    for seed in range(20):
        found = bundle(beads(0.1), sights(0.5, 0.1, seed), off(), CAMERA, 0.5)
        apart = invert_rigid(found.poses.camera_from_camera1[2]) - invert_rigid(TRUE.camera_from_camera1[2])
        sources.append(float(apart[:3, 3].norm()))
    assert np.sqrt(np.mean(np.square(sources))) == pytest.approx(view_rows(found)["view3"]["mm"], rel=0.4)


def test_more_views_know_more() -> None:
    rows = [
        object_rows(pose_uncertainty(bundle(beads(0.05), sights(0.5, 0.05, 1, n), off(n), CAMERA, 0.5), POINTS))
        for n in (1, 3)
    ]
    assert rows[1]["femur"]["mm"] < rows[0]["femur"]["mm"]
    assert rows[1]["device"]["deg"] < rows[0]["device"]["deg"]


def test_an_object_that_no_pose_fits_is_told() -> None:
    given = sights(0.3, 0, 4)
    rng = np.random.default_rng(0)
    scattered = [
        Sight(s.object, s.bead, s.view, s.image, (float(rng.uniform(0, 1500)), float(rng.uniform(0, 1500))))
        if s.object == "device" and s.bead > 1
        else s
        for s in given
    ]
    with pytest.raises(InputError, match=r"beads of device: \d agree") as caught:
        bundle(beads(), scattered, off(), CAMERA, 0.3)
    assert "\n" not in str(caught.value)


def test_a_shadow_that_is_less_sure_counts_less() -> None:
    """Weights are those of least squares: one hundred times as unsure is as good as left out."""
    given = sights(0.3, 0.0, 3)
    without = bundle(beads(), given[1:], off(), CAMERA, 0.3)
    moved = replace(given[0], pixel=(given[0].pixel[0] + 5, given[0].pixel[1]), spread=100.0)
    kept = bundle(beads(), [moved, *given[1:]], off(), CAMERA, 0.3)
    assert kept.used.all()
    assert change(kept.poses).sub(change(without.poses)).abs().max() < 0.02
    torch.testing.assert_close(kept.covariance, without.covariance, rtol=2e-3, atol=1e-6)
    evenly = bundle(beads(), [replace(sight, spread=2.0) for sight in given], off(), CAMERA, 0.15)
    torch.testing.assert_close(evenly.covariance, bundle(beads(), given, off(), CAMERA, 0.3).covariance)
