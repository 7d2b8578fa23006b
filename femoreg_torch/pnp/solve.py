"""Pose of an object from its landmarks in one image (perspective-n-point), robust against outliers.

Hypotheses from small subsets (SQPnP: Terzakis and Lourakis, ECCV 2020), the one with the best consensus (MSAC: Torr and
Zisserman, CVIU 78, 2000), then a refinement that minimises the Huber loss of the reprojection residuals of the inliers.
Where standard deviations of the landmarks are known, the pose is the maximum a posteriori over all landmarks, with a
weak prior on the direction of the beam.
"""

from dataclasses import dataclass
from itertools import combinations
from math import comb

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from scipy.optimize import least_squares
from torch import Tensor

from femoreg_torch.errors import InputError
from femoreg_torch.geometry import Camera, project_points, transform_points

Array = NDArray[np.float64]

MINIMUM = 4  # points that must agree
INLIER_MM = 10.0  # on the detector; twice the mean error of published landmark networks
_HUBER_MM = 3.0  # on the detector, where the loss turns from square to linear
_FLOOR_MM = 1.0  # least standard deviation of a landmark that the covariance assumes, on the detector
_HYPOTHESES = 400
_SUBSET_SIZES = (4, 5, 6)
_DEPTHS = (0.2, 1.0)  # of the source-to-detector distance: the object lies between source and detector
_MIDDLE_DEPTHS = (0.45, 0.95)  # the same for the points' centroid: no patient lies on the tube or on the detector
_HUBER_DEVIATIONS = 1.5
_MOST_MISFIT = 8.0  # of one point, an outlier: that of 4 standard deviations
_ROTATION_DEG = 10.0  # greatest standard deviation, over all axes, of a pose that is given
_STEPS = (0.01, 0.01, 0.01, 1, 1, 10)  # typical sizes of a twist, rad and mm
_ADVICE = "Take a view that shows more of the object, or give landmarks placed by hand."
MIRRORED_ADVICE = "Is the picture mirrored, or are left and right, or columns and rows, exchanged?"
_TILT_DEG = 30.0  # prior standard deviation of the beam about the axis of the patient that it runs along, each way
FRONT_TO_BACK = (0.0, 1.0, 0.0)  # a beam in LPS whose source stands in front of the patient


@dataclass(frozen=True)
class PnpResult:
    """A pose and how far to trust it."""

    camera_from_object: Tensor  # (4, 4) float64
    inliers: Tensor  # (N,) bool: within 10 mm on the detector
    rms_px: float  # root mean square reprojection residual of the inliers
    covariance: Tensor  # (6, 6) of (rotation in rad, translation in mm), camera axes, about the used points' centroid
    misfit: float = float("nan")  # negative log likelihood of all points, each at most 8; only if deviations are known

    @property
    def rotation_deviation_deg(self) -> float:
        """Standard deviation of the rotation, over all axes."""
        return float(torch.rad2deg(self.covariance[:3, :3].trace().sqrt()))


def solve_pnp(
    points: Tensor,
    pixels: Tensor,
    camera: Camera,
    weights: Tensor | None = None,
    deviations_px: Tensor | None = None,
    point_deviations_mm: Tensor | None = None,
    beam: tuple[float, float, float] = FRONT_TO_BACK,
) -> PnpResult:
    """Pose of `points` (N, 3) in LPS mm that were seen at `pixels` (N, 2) (column, row) of `camera`.

    `weights` (N,) are positive, for instance the confidences. `deviations_px` (N,) are standard deviations of the
    landmarks along each axis in the image, `point_deviations_mm` (N,) those of the points themselves (0 if not given),
    which the image shows magnified; with the former the pose is the maximum a posteriori, with the prior that the beam
    runs along `beam`, an axis of LPS from source to detector, within about 30°, and the covariance is that of the
    posterior. Only poses are considered that have the points between source and detector and the beam entering from
    that side. The image must be as the source sees it: no pose fits a mirrored one. The result does not depend on
    chance.

    Raises `InputError` "too few usable landmarks …" when fewer than four, or fewer than half of the points, agree, or
    if by `deviations_px` the rotation is uncertain by more than 10°; "no usable pose …" when they agree on one alone
    that has the points not between source and detector, or the beam entering from another side.
    """
    weights = torch.ones(len(points)) if weights is None else weights
    _check(points, pixels, weights, deviations_px)
    object_points, image_points = (p.to(torch.float64).numpy() for p in (points, pixels))
    scale = weights.to(torch.float64).numpy()
    pixel_mm = float(np.mean(camera.pixel_mm))
    limit_px = INLIER_MM / pixel_mm

    along = np.asarray(beam, dtype=np.float64)
    pose = _consensus(object_points, image_points, scale, camera, limit_px, along)
    inliers = np.zeros(len(scale), dtype=bool) if pose is None else _distances(pose, points, pixels, camera) < limit_px
    for _ in range(3):
        if pose is None or not _enough(inliers):
            break
        pose, covariance = _refine(pose, points[inliers], pixels[inliers], scale[inliers], camera)
        inliers = _distances(pose, points, pixels, camera) < limit_px
    if pose is not None and _enough(inliers) and deviations_px is not None:
        spread = _spread_px(pose.numpy(), object_points, deviations_px, point_deviations_mm, camera)
        pose, covariance = _most_probable(pose, object_points, image_points, spread, camera, along)
        inliers = _distances(pose, points, pixels, camera) < limit_px
    if pose is None or not _enough(inliers):
        raise InputError(
            f"too few usable landmarks: {int(inliers.sum())} of {len(points)} agree on a pose, but at least {MINIMUM} "
            f"and half of them must. {_ADVICE}"
        )
    if not _plausible(pose.numpy(), object_points, camera, along):
        raise InputError(
            f"no usable pose: {int(inliers.sum())} of {len(points)} landmarks agree on one, but by it "
            f"{_why_not(pose.numpy(), object_points, camera, along)}. {MIRRORED_ADVICE}"
        )
    distances = _distances(pose, points, pixels, camera)
    misfit = float("nan")
    if deviations_px is not None:
        spread = _spread_px(pose.numpy(), object_points, deviations_px, point_deviations_mm, camera)
        misfit = float(np.minimum((distances / spread) ** 2 / 2, _MOST_MISFIT).sum())
    rms_px = float(np.sqrt((distances[inliers] ** 2).mean()))
    result = PnpResult(pose, torch.from_numpy(inliers), rms_px, covariance, misfit)
    if deviations_px is not None and result.rotation_deviation_deg > _ROTATION_DEG:
        raise InputError(
            f"too few usable landmarks: {int(inliers.sum())} of {len(points)} agree, but they fix the rotation only to "
            f"{result.rotation_deviation_deg:.0f}°. {_ADVICE}"
        )
    return result


def _spread_px(
    camera_from_object: Array, points: Array, deviations_px: Tensor, point_deviations_mm: Tensor | None, camera: Camera
) -> Array:
    """Standard deviation (N,) along each axis between a point's shadow and where it was seen."""
    seen = deviations_px.double().numpy()
    if point_deviations_mm is None:
        return np.asarray(seen)
    depth = points @ camera_from_object[2, :3] + camera_from_object[2, 3]
    magnified = point_deviations_mm.double().numpy() * camera.sdd_mm / depth / float(np.mean(camera.pixel_mm))
    return np.asarray(np.hypot(seen, magnified))


def _check(points: Tensor, pixels: Tensor, weights: Tensor, deviations_px: Tensor | None) -> None:
    count = len(points)
    if points.shape != (count, 3) or pixels.shape != (count, 2) or weights.shape != (count,):
        raise InputError(
            f"solve_pnp: points (N, 3), pixels (N, 2) and weights (N,) were expected, got {tuple(points.shape)}, "
            f"{tuple(pixels.shape)} and {tuple(weights.shape)}."
        )
    if not all(torch.isfinite(values).all() for values in (points, pixels, weights)) or (weights <= 0).any():
        raise InputError("solve_pnp: points, pixels and weights must be finite, and weights positive.")
    if deviations_px is not None and (deviations_px.shape != (count,) or not (deviations_px > 0).all()):
        raise InputError(f"solve_pnp: deviations_px must be ({count},) and positive.")
    if count < MINIMUM:
        raise InputError(f"too few usable landmarks: {count} given, at least {MINIMUM} are needed. {_ADVICE}")


def _enough(inliers: NDArray[np.bool_]) -> bool:
    return bool(inliers.sum() >= max(MINIMUM, len(inliers) / 2))


def _subsets(count: int) -> list[tuple[int, ...]]:
    """Index subsets to try: all of the sizes 4 to 6 where there are few, a fixed random choice of them else."""
    sizes = [size for size in _SUBSET_SIZES if size <= count]
    if sum(comb(count, size) for size in sizes) <= _HYPOTHESES:
        return [subset for size in sizes for subset in combinations(range(count), size)]
    rng = np.random.default_rng(0)
    return [tuple(rng.choice(count, sizes[n % len(sizes)], replace=False)) for n in range(_HYPOTHESES)]


def _plausible(camera_from_object: Array, points: Array, camera: Camera, beam: Array) -> bool:
    """Whether all points lie between source and detector and the beam runs the way of `beam` (3,) rather than back."""
    depth = points @ camera_from_object[2, :3] + camera_from_object[2, 3]
    low, high = (share * camera.sdd_mm for share in _DEPTHS)
    nearest, furthest = (share * camera.sdd_mm for share in _MIDDLE_DEPTHS)
    between = depth.min() > low and depth.max() < high and nearest < depth.mean() < furthest
    return bool(between and camera_from_object[2, :3] @ beam > 0)


def _why_not(camera_from_object: Array, points: Array, camera: Camera, beam: Array) -> str:
    """In words, why a pose is not plausible."""
    depth = points @ camera_from_object[2, :3] + camera_from_object[2, 3]
    if camera_from_object[2, :3] @ beam <= 0:
        return "the beam enters the patient from the other side than `display` says"
    return (
        f"they lie {depth.min():.0f} to {depth.max():.0f} mm from the source, and the detector {camera.sdd_mm:.0f} mm, "
        "where no patient fits"
    )


def _consensus(
    points: Array, pixels: Array, weights: Array, camera: Camera, limit_px: float, beam: Array
) -> Tensor | None:
    """The hypothesis of least truncated squared residuals (MSAC), or None if no subset has a plausible pose."""
    matrix = camera.matrix().numpy()
    best, best_cost = None, np.inf
    for subset in _subsets(len(points)):
        chosen = list(subset)
        try:
            found, rotations, translations, _ = cv2.solvePnPGeneric(
                points[chosen], pixels[chosen], matrix, None, flags=cv2.SOLVEPNP_SQPNP
            )
        except cv2.error:  # points too close together: OpenCV asserts a least variance
            continue
        for n in range(found):
            pose = np.eye(4)
            pose[:3, :3] = cv2.Rodrigues(rotations[n])[0]
            pose[:3, 3] = translations[n].ravel()
            if not _plausible(pose, points, camera, beam):
                continue
            projected = points @ pose[:3, :3].T + pose[:3, 3]
            projected = projected @ matrix.T
            squared = ((projected[:, :2] / projected[:, 2:] - pixels) ** 2).sum(1)
            cost = float((weights * np.minimum(squared, limit_px**2)).sum())
            if cost < best_cost:
                best, best_cost = pose, cost
    return None if best is None else torch.from_numpy(best)


def _distances(camera_from_object: Tensor, points: Tensor, pixels: Tensor, camera: Camera) -> Array:
    """Reprojection residuals (N,): pixels between projected points and `pixels`; infinite behind the source."""
    projected = project_points(camera, transform_points(camera_from_object, points.to(torch.float64)))
    return (projected - pixels).norm(dim=1).nan_to_num(torch.inf).numpy()


@dataclass(frozen=True)
class Movable:
    """Points about a pose that is turned about their centroid and shifted by a twist (rotation vector, translation)."""

    arms: Array  # (N, 3) from the centroid, camera axes
    centre: Array  # (3,) the centroid in the camera frame
    matrix: Array  # (3, 3) of the camera

    def pixels(self, twist: Array) -> Array:
        """(column, row) (N, 2) after the twist."""
        turned = self.arms @ cv2.Rodrigues(twist[:3])[0].T + self.centre + twist[3:]
        projected = turned @ self.matrix.T
        return np.asarray(projected[:, :2] / projected[:, 2:])

    def pose(self, twist: Array, camera_from_object: Array) -> Tensor:
        """`camera_from_object` (4, 4) after the twist."""
        turn = cv2.Rodrigues(twist[:3])[0]
        pose = np.eye(4)
        pose[:3, :3] = turn @ camera_from_object[:3, :3]
        pose[:3, 3] = turn @ (camera_from_object[:3, 3] - self.centre) + self.centre + twist[3:]
        return torch.from_numpy(pose)


def movable(camera_from_object: Array, points: Array, camera: Camera) -> Movable:
    """Points (N, 3) of an object at a pose (4, 4), to be turned about their own centre."""
    in_camera = points @ camera_from_object[:3, :3].T + camera_from_object[:3, 3]
    centre = in_camera.mean(0)
    return Movable(in_camera - centre, centre, camera.matrix().numpy())


def by_huber(offset: Array) -> Array:
    """Residuals (N, 2), in standard deviations, so that their squares are Huber's loss of offsets (N, 2)."""
    length = np.linalg.norm(offset, axis=1, keepdims=True).clip(1e-12)
    linear = np.sqrt(np.maximum(2 * _HUBER_DEVIATIONS * length - _HUBER_DEVIATIONS**2, 0)) / length
    return np.asarray(np.where(length < _HUBER_DEVIATIONS, 1, linear) * offset)


def _refine(
    camera_from_object: Tensor, points: Tensor, pixels: Tensor, weights: Array, camera: Camera
) -> tuple[Tensor, Tensor]:
    """The pose of least Huber loss near `camera_from_object`, and its covariance (6, 6)."""
    start = camera_from_object.numpy()
    moving = movable(start, points.double().numpy(), camera)
    seen, pixel_mm = pixels.double().numpy(), float(np.mean(camera.pixel_mm))
    root = np.sqrt(weights / weights.mean())[:, None]

    def residuals_mm(twist: Array) -> Array:
        return np.asarray((root * (moving.pixels(twist) - seen) * pixel_mm).ravel())

    solution = least_squares(residuals_mm, np.zeros(6), loss="huber", f_scale=_HUBER_MM, x_scale=_STEPS)
    freedom = max(1, len(solution.fun) - 6)
    variance = max(_FLOOR_MM**2, float((solution.fun**2).sum()) / freedom)
    normal = solution.jac.T @ solution.jac
    return moving.pose(solution.x, start), torch.from_numpy(variance * np.linalg.pinv(normal))


def _most_probable(
    camera_from_object: Tensor, points: Array, pixels: Array, deviations_px: Array, camera: Camera, beam: Array
) -> tuple[Tensor, Tensor]:
    """The maximum a posteriori pose near `camera_from_object`, and its covariance (6, 6) about the points' centroid.

    Residuals are in standard deviations; beyond 1.5 of them they count by Huber's rule. The beam's direction in the
    patient is the third row of the rotation; its parts across the axis `beam` are the prior's residuals.
    """
    start = camera_from_object.numpy()
    moving = movable(start, points, camera)
    tilt = np.sin(np.radians(_TILT_DEG))

    def residuals(twist: Array) -> Array:
        offset = (moving.pixels(twist) - pixels) / deviations_px[:, None]
        direction = (cv2.Rodrigues(twist[:3])[0] @ start[:3, :3])[2]
        across = direction[beam == 0] / tilt
        return np.append(by_huber(offset).ravel(), across)

    solution = least_squares(residuals, np.zeros(6), x_scale=_STEPS)
    return moving.pose(solution.x, start), torch.from_numpy(np.linalg.pinv(solution.jac.T @ solution.jac))
