"""The CT scan of a patient around bone surfaces, its label map and its landmarks."""

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from scipy import ndimage

from femoreg_torch.errors import InputError
from femoreg_torch.segment.rules import find_surface_landmarks
from femoreg_torch.volume import Volume, axis_aligned
from sim.patient.around_surfaces.bone import FINE_MM, model_bone
from sim.patient.around_surfaces.soft_tissue import make_soft_tissue
from sim.patient.around_surfaces.surfaces import BoneSurfaces
from sim.patient.around_surfaces.trunk import Surfaces, body_box, measure_trunk
from sim.patient.around_surfaces.voxels import block_mean, halved_voxels
from sim.patient.scan import BLUR_MM, Patient
from sim.patient.skeleton import LABEL_IDS, SIDES

Array = NDArray[np.float32]
Labels = NDArray[np.uint8]
Mask = NDArray[np.bool_]
Points = NDArray[np.float64]

_NOISE_HU = {1.0: 15.0, 0.5: 25.0}  # by voxel size in mm; thinner slices are noisier
_BELOW_MM = (100, 300)
_BONE, _TISSUE, _NOISE = 1, 2, 3  # first number of the key of each part's random stream
_HU_STEP = 4  # far below the noise; a third off the file


@dataclass(frozen=True)
class Options:
    """What is invented around the bones, and how it is scanned. Equal options give the same volumes.

    `spacing_mm` chooses how the patient is scanned, all else draws the patient: volumes of 0.5 mm and 1 mm with
    otherwise equal options show the same patient inside the same outer edges. Raises `InputError` for what is out of
    range.
    """

    seed: int = 7  # of texture, soft tissue and noise
    spacing_mm: float = 1.0  # 0.5 or 1
    osteoporotic: float = 1.0  # 1 healthy, down to 0.1: scales spongy bone above marrow; its root scales the cortex
    below_mm: int = 165  # femur in the scan below the heads

    def __post_init__(self) -> None:
        if self.seed < 0:
            raise InputError(f"patient: seed is {self.seed}, expected 0 or more.")
        if self.spacing_mm not in _NOISE_HU:
            raise InputError(f"patient: spacing is {self.spacing_mm:g} mm, expected 0.5 or 1 mm.")
        if not 0.1 <= self.osteoporotic <= 1:
            raise InputError(f"patient: osteoporotic is {self.osteoporotic:g}, expected 0.1 to 1.")
        if not _BELOW_MM[0] <= self.below_mm <= _BELOW_MM[1]:
            raise InputError(f"patient: below is {self.below_mm} mm, expected {_BELOW_MM[0]} to {_BELOW_MM[1]} mm.")

    def stream(self, *key: int) -> np.random.Generator:
        """Generator of one part of the patient, so that no part depends on the order of the others."""
        return np.random.default_rng([self.seed, *key])


def patient_around(surfaces: BoneSurfaces, options: Options) -> Patient:
    """The patient whose bones are those of `surfaces`, in their LPS frame; CT in whole HU.

    On two cores, 1 mm takes 1.5 minutes and 3.5 GB of memory, 0.5 mm 2.5 minutes and 8 GB.
    """
    found = find_surface_landmarks(surfaces.bones)
    # modelled with the origin between the femoral heads
    shift = np.round((found.points["FH-l"] + found.points["FH-r"]) / 2)
    bones = {name: mesh.copy().apply_translation(-shift) for name, mesh in surfaces.bones.items()}
    landmarks = {name: point - shift for name, point in found.points.items()}
    trunk = measure_trunk(bones, found.pelvic_frame)
    low, high = body_box(bones, trunk, options.below_mm)
    hu, filled, labels = _placed_bones(bones, low, high, landmarks, found.head_radius, options)

    per_mm = round(1 / options.spacing_mm)
    coarse = filled if per_mm == 1 else block_mean(filled, per_mm)
    soft, body = make_soft_tissue(low, coarse, bones, trunk, landmarks, lambda n: options.stream(_TISSUE, n))
    soft[_in_joint(labels[::per_mm, ::per_mm, ::per_mm]) & (coarse < 1)] = 95  # cartilage between head and socket
    outside = ~ndimage.binary_dilation(body, iterations=2)
    if per_mm > 1:
        soft, outside = halved_voxels(soft), outside.repeat(per_mm, 0).repeat(per_mm, 1).repeat(per_mm, 2)
    hu += (1 - filled) * soft
    del soft, filled, coarse
    scanned = _scanned(hu, outside, options)
    x, y, z = (low + shift + options.spacing_mm / 2).tolist()
    lps_from_index = axis_aligned((options.spacing_mm,) * 3, (x, y, z))
    ct, numbers = (
        Volume(torch.from_numpy(np.ascontiguousarray(values.transpose(2, 1, 0))), lps_from_index)
        for values in (scanned, labels)
    )
    points = {name: torch.from_numpy(point) for name, point in found.points.items()}
    return Patient(ct, numbers, points, {"osteoporotic": options.osteoporotic, "below_mm": float(options.below_mm)})


def _placed_bones(
    bones: Surfaces,
    low: Points,
    high: Points,
    landmarks: dict[str, Points],
    head_radius: dict[str, float],
    options: Options,
) -> tuple[Array, Array, Labels]:
    """HU times filled fraction, that fraction, and labels, [x, y, z] of the whole volume."""
    per_mm = round(1 / options.spacing_mm)
    counts = (high - low).astype(int) * per_mm
    hu, filled = np.zeros(counts, np.float32), np.zeros(counts, np.float32)
    labels, most = np.zeros(counts, np.uint8), np.full(counts, 0.5, np.float32)
    for name, mesh in bones.items():
        side = "right" if name.endswith("right") else "left"
        first = np.maximum(np.floor(mesh.bounds[0]) - 3, low)
        end = np.minimum(np.ceil(mesh.bounds[1]) + 3, high)
        rng = options.stream(_BONE, LABEL_IDS[name])
        head, radius = landmarks[f"FH-{side[0]}"], head_radius[side]
        part, part_hu = model_bone(name, mesh, first, end, head, radius, options.osteoporotic, rng)
        if options.spacing_mm != FINE_MM:
            part, part_hu = block_mean(part), block_mean(part_hu)
        box = tuple(slice(int(a), int(b)) for a, b in zip((first - low) * per_mm, (end - low) * per_mm, strict=True))
        filled[box] += part
        hu[box] += part_hu
        wins = part >= most[box]
        labels[box][wins], most[box][wins] = LABEL_IDS[name], part[wins]
    over = filled > 1
    hu[over] /= filled[over]
    filled[over] = 1
    return hu, filled, labels


def _in_joint(labels: Labels) -> Mask:
    """Voxels of 1 mm that are near to both a hip bone and a femur."""
    hips, femora = (np.isin(labels, [LABEL_IDS[f"{bone}_{side}"] for side in SIDES]) for bone in ("hip", "femur"))
    near_hips, near_femora = (ndimage.gaussian_filter(m.astype(np.float32), 1.5) > 0.02 for m in (hips, femora))
    both: Mask = near_hips & near_femora
    return both


def _scanned(hu: Array, outside: Mask, options: Options) -> NDArray[np.int16]:
    """The volume as the scanner gives it: blurred, noisy, in steps of some HU. `hu` is used up."""
    ndimage.gaussian_filter(hu, BLUR_MM / options.spacing_mm, output=hu)
    noise = options.stream(_NOISE).standard_normal(hu.shape, dtype=np.float32)
    ndimage.gaussian_filter(noise, 0.55, output=noise)
    noise *= _NOISE_HU[options.spacing_mm] / noise.std()
    hu += noise
    hu[outside] = -1000
    scanned: NDArray[np.int16] = np.clip(_HU_STEP * np.rint(hu / _HU_STEP), -1024, 3071).astype(np.int16)
    return scanned
