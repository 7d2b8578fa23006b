"""The start pose made better, and checked: bones drawn where PnP puts them, against where the network sees them.

A few landmarks of one bone leave the rotation open by ten degrees and more; the outline of the bone does not. The pose
is the most probable one given PnP's pose with its covariance, and the network's segmentation.
"""

from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn import functional as F

from femoreg_torch.anatomy import Anatomy
from femoreg_torch.detect import to_network_grid
from femoreg_torch.drr import project, project_with_jacobian
from femoreg_torch.geometry import Camera, about_point, exp_se3, transform_points, twist_rates
from femoreg_torch.optimize import LevenbergMarquardt, Quadratic, SmoothObjective
from femoreg_torch.registration.prepare.outline import OUTLINE_SPACING_MM
from femoreg_torch.registration.scene import Outline, Segmentation
from femoreg_torch.registration.weights import dilated
from femoreg_torch.volume import Volume

_OPAQUE_MM = 2.0  # path in bone after which a pixel is labelled with probability 1 − 1/e; labels begin at 1.5 mm
# Standard deviation of a pixel's probability, as if pixels were independent; chosen on procedural patient 101, with the
# band. Pixels of one outline err together, so it is far greater than that of one pixel.
_PIXEL_DEVIATION = 1.0
_BAND_MM = 15.0  # on the detector, about the bone that is seen; further off a shutter may hide what is drawn
_HIDDEN_MARGIN_MM = 3.0
_BEYOND_MM, _BOX_MM = 200.0, 5.0  # a CT that cuts the bones: how far they may go on, and how finely that is drawn
_ABOUT_CUT_MM = 40.0  # how far they may flare there
_CUT = 0.3  # of the mask on the CT's border, from which a bone is cut there
_STEP = 1e-5  # of a twist in standard deviations, for derivatives of the pose
_SEARCH = LevenbergMarquardt(max_iterations=15, tol_x=0.02, tol_f=0.01, candidates=60, starts=3)


@dataclass(frozen=True)
class SilhouetteFit:
    """A pose, and how far the bones drawn there cover those seen."""

    camera_from_ct: Tensor  # (4, 4) float64
    overlap: float | None  # Dice in the band about the bone that is seen; None where nothing of that can be compared
    covariance: Tensor  # (6, 6) of (rotation in rad, translation in mm), camera axes, about the centre given
    beyond: float = 0.0  # share of the bone that is seen which lies beyond a CT that cuts it, and so was not compared

    @property
    def rotation_deviation_deg(self) -> float:
        """Standard deviation of the rotation, over all axes."""
        return float(torch.rad2deg(self.covariance[:3, :3].trace().sqrt()))


def refine_by_silhouette(
    outline: Outline,
    anatomy: Anatomy,
    camera_from_ct: Tensor,
    centre: Tensor,
    covariance: Tensor,
    seen: Segmentation,
    attenuation: Tensor,
    camera: Camera,
    field: Tensor | None = None,
) -> SilhouetteFit:
    """The pose near `camera_from_ct` (4, 4) where the bones of `outline` cover those of the segmentation.

    `covariance` (6, 6) of the start is about `centre` (3,), mm in the camera frame. `attenuation` (H, W) of `camera` is
    the image; outside its exposed `field` (H, W), bool, and where it stands at its least or greatest value (shutters,
    saturation) nothing is compared, nor where the segmentation sees bones that may hide those of the outline, nor, of
    a CT that cuts these, what lies beyond it.
    """
    there = _looked_at(seen, outline, anatomy, attenuation, camera, field)
    beyond = _beyond(outline.mask, camera_from_ct, seen.camera)
    looked_at = (there & ~beyond).flatten().nonzero()[:, 0]
    probability = seen.probabilities[list(anatomy.classes(outline.bones))].sum(0)
    left_out = float((probability > 0.5)[there & beyond].sum() / (probability > 0.5)[there].sum().clamp_min(1))
    target = probability.flatten()[looked_at].double()
    root = torch.linalg.cholesky(covariance.double())  # twist = root · u, with u of unit variance

    def poses(units: Tensor) -> Tensor:
        return about_point(exp_se3(units @ root.T), centre) @ camera_from_ct

    def seen_of(lengths: Tensor) -> Tensor:
        return 1 - torch.exp(-lengths.flatten(-2)[..., looked_at].double() / _OPAQUE_MM)

    def drawn(units: Tensor) -> Tensor:
        return seen_of(project([outline.mask], poses(units)[:, None], seen.camera, OUTLINE_SPACING_MM))

    def values(units: Tensor) -> Tensor:
        misfit = (drawn(units) - target).square().sum(1).cpu() / _PIXEL_DEVIATION**2
        return 0.5 * (misfit + units.square().sum(1))

    def quadratic(unit: Tensor) -> Quadratic:
        steps = _STEP * torch.eye(6, dtype=torch.float64)
        pose, above, below = poses(torch.cat([unit[None], unit + steps, unit - steps])).split([1, 6, 6])
        twists = twist_rates((above - below) / (2 * _STEP), pose[0], centre).to(target.device, non_blocking=True)
        lengths, jacobian = project_with_jacobian(outline.mask, pose, seen.camera, centre, OUTLINE_SPACING_MM)
        here = seen_of(lengths[0])
        by_unit = twists.T @ jacobian[0].flatten(0, 1)[looked_at].double().T  # (6, pixels)
        slopes = by_unit * (1 - here) / (_OPAQUE_MM * _PIXEL_DEVIATION)
        misfit = (here - target) / _PIXEL_DEVIATION
        sums = torch.cat([(misfit @ misfit)[None], slopes @ misfit, (slopes @ slopes.T).flatten()]).cpu()
        squared, gradient, hessian = sums.split([1, 6, 36])
        value = 0.5 * float(squared[0] + unit @ unit)
        return Quadratic(value, (gradient + unit)[None], hessian.view(6, 6) + torch.eye(6, dtype=torch.float64))

    best = _SEARCH.minimise(SmoothObjective(values, quadratic), 6, seed=0).delta
    inside = drawn(best[None])[0] > 0.5
    bone = target > 0.5
    hidden = len(target) == 0 and bool((probability > 0.5).any())
    overlap = None if hidden else 2 * float((inside & bone).sum()) / max(float(inside.sum() + bone.sum()), 1.0)
    posterior = root @ torch.linalg.inv(quadratic(best).hessian) @ root.T
    return SilhouetteFit(poses(best[None])[0], overlap, posterior, left_out)


def _looked_at(
    seen: Segmentation,
    outline: Outline,
    anatomy: Anatomy,
    attenuation: Tensor,
    camera: Camera,
    field: Tensor | None,
) -> Tensor:
    """Pixels (h, w) of the segmentation's grid that are compared."""
    others = (*anatomy.hides_outline, *(bone for bone in anatomy.outline if bone not in outline.bones))
    compared, hiding = (
        seen.probabilities[list(anatomy.classes(bones))].sum(0) > 0.5 for bones in (outline.bones, others)
    )
    near = dilated(compared, _BAND_MM, seen.camera)
    hidden = dilated(hiding, _HIDDEN_MARGIN_MM, seen.camera)
    field = torch.ones_like(attenuation, dtype=torch.bool) if field is None else field
    low, high = attenuation[field].aminmax()
    extreme = to_network_grid(((attenuation <= low) | (attenuation >= high) | ~field).float(), camera)
    covered = F.interpolate(extreme[None, None], seen.camera.shape, mode="area")[0, 0] > 0.5
    return near & ~hidden & ~dilated(covered, _HIDDEN_MARGIN_MM, seen.camera)


def _cut_faces(mask: Volume) -> list[tuple[int, bool]]:
    """The faces of a CT that cut the bones of its mask: axis (0 is x of the index), and whether it is the last one."""
    faces = [(axis, last) for axis in range(3) for last in (False, True)]
    return [face for face in faces if float(_on_face(mask, *face).max()) > _CUT]


def _on_face(mask: Volume, axis: int, last: bool) -> Tensor:
    """The mask on a face of its CT, (1, H, W), (D, 1, W) or (D, H, 1)."""
    return mask.data.narrow(2 - axis, mask.data.shape[2 - axis] - 1 if last else 0, 1)


def _beyond(mask: Volume, camera_from_ct: Tensor, camera: Camera) -> Tensor:
    """Pixels (h, w) of a camera that see where bones go on beyond those faces of a CT that cut those of its mask.

    That is before the cut and `_ABOUT_CUT_MM` about it: along a beam that meets the face, all of a picture lies beyond.
    """
    spacing = torch.tensor(mask.spacing_mm, dtype=torch.float64)
    size = torch.tensor(mask.data.shape).flip(0) * spacing
    found = torch.zeros(camera.shape, dtype=torch.bool, device=mask.data.device)
    for axis, last in _cut_faces(mask):
        cut = (_on_face(mask, axis, last) > _CUT).nonzero().flip(1).cpu()  # (N, 3) x, y, z
        first = (cut.amin(0) * spacing - _ABOUT_CUT_MM).clamp_min(0)  # mm along the axes, from the CT's corner
        extent = torch.minimum((cut.amax(0) + 1) * spacing + _ABOUT_CUT_MM, size) - first
        extent[axis], first[axis] = _BEYOND_MM, size[axis] if last else -_BEYOND_MM
        counts = (extent / _BOX_MM).ceil()
        affine = mask.lps_from_index.clone()
        affine[:3, :3] *= extent / counts / spacing
        corner = transform_points(mask.lps_from_index, (first / spacing - 0.5)[None])[0]
        affine[:3, 3] = corner + affine[:3, :3].sum(1) / 2
        box = Volume(torch.ones(counts.flip(0).int().tolist(), device=mask.data.device), affine)
        path = project([box], camera_from_ct[None, None], camera, _BOX_MM)[0]
        found |= dilated(path > _BOX_MM, _HIDDEN_MARGIN_MM, camera)
    return found
