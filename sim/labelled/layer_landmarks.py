"""The 14 landmarks of a patient that has been taken apart into layers, by the same rules as everywhere in `sim`.

A landmark carried along by a deformation is the place it was, not the place that the rule would choose on the new
bone: the most anterior point of an iliac wing is another one after the wing has been turned. On one shape the rules
jump by 2 to 7 mm when its surface is smoothed a little more, so their points are averaged over smoothings.
"""

import numpy as np
import torch
from scipy import ndimage
from torch import Tensor

from femoreg_torch.anatomy import HIP
from femoreg_torch.errors import InputError
from femoreg_torch.volume import Volume
from sim.labelled.attenuation_layers import Layers
from sim.patient.distance_field import Field
from sim.patient.landmarks import Points, find_on_hips
from sim.patient.skeleton import SIDES

_SMOOTHINGS_MM = (0.8, 1.2, 1.8)  # standard deviations
_JUMP_MM = 15.0  # a rule that lands further off has lost its place, for instance in a hole of thin bone
_MARGIN = 6  # voxels around a bone


def landmarks_by_rule(layers: Layers) -> Tensor:
    """Landmarks (L, 3) of `layers` in LPS mm, found on the masks of both hip bones.

    The heads stay as they are. A landmark whose rule lands more than 15 mm from `layers.landmarks` keeps that place,
    and so do all of a patient whose obturator foramina are to be seen on none of the smoothed surfaces. Raises
    `InputError` if the masks' axes do not run along +x, +y, +z.
    """
    known = dict(zip(HIP.landmark_names, layers.landmarks.numpy(), strict=True))
    heads = {side: known[f"FH-{side[0]}"] for side in SIDES}
    centre = (heads["left"] + heads["right"]) / 2
    centred = {side: head - centre for side, head in heads.items()}
    masks = {side: layers.masks[f"hip_{side}"] for side in SIDES}
    found = []
    for smoothing in _SMOOTHINGS_MM:
        hips = {side: _field(mask, centre, smoothing) for side, mask in masks.items()}
        try:
            points = find_on_hips(hips, centred)
        except InputError:  # a thin ring that was bent may break, or close, on one of the surfaces
            continue
        found.append(np.stack([points[name] for name in HIP.landmark_names]) + centre)
    if not found:
        return layers.landmarks
    mean = torch.from_numpy(np.mean(found, 0))
    lost = (mean - layers.landmarks).norm(dim=1, keepdim=True) > _JUMP_MM
    return torch.where(lost, layers.landmarks, mean)


def _field(mask: Volume, origin: Points, smoothing_mm: float) -> Field:
    """Signed distance, mm, to the surface where `mask` is one half; `origin` (3,) LPS mm becomes 0."""
    affine = mask.lps_from_index.numpy()
    step = affine[0, 0]
    if step <= 0 or not np.allclose(affine[:3, :3], step * np.eye(3)):
        raise InputError("landmarks: the axes of the masks do not run left, back and up. Resample the case to LPS.")
    bone = np.pad(mask.data.numpy().transpose(2, 1, 0) > 0.5, _MARGIN)
    distance = ndimage.distance_transform_edt(~bone) - ndimage.distance_transform_edt(bone)
    distance -= np.sign(distance) * 0.5  # from the middle of a voxel to the face of the next
    low = affine[:3, 3] - origin - _MARGIN * step
    return Field((step * distance).astype(np.float32), low, step).smoothed(smoothing_mm)
