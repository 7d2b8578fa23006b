"""Bones found in whole CTs around shapes that no training has seen: Dice, distances of surfaces, open joints.

    python benchmarks/segmentation.py s31.nii.gz s33.nii.gz … --cache FOLDER [--weights FILE] [--ways refined network …]

Around each label map (ids of the table `autoseg`) a CT of 1 mm is computed by `sim.patient`, whose bone, soft tissue
and noise are not those of the training's random CTs; the maps have no spine, so these CTs have none. Femora that a map
cuts go on downwards as they end. Folders of synthetic patients (ct.nii.gz, labels.nii.gz, landmarks.json) are read as
they are. Ways: `network` its outlines alone, `refined` what `femoreg segment` gives, `graph_cut` what it gives with
`--way graph_cut`, `cuts` the same with `--unrefined`, `true` the refinement of the true labels averaged to the
network's voxels.
"""

import argparse
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch
from measure import machine, table, write_section
from numpy.typing import NDArray
from scipy import ndimage
from torch.nn import functional as F

from femoreg_torch.anatomy import HIP, label_table
from femoreg_torch.errors import InputError
from femoreg_torch.segment import load_bone_network, propose_landmarks, segment_bones, segment_bones_without_network
from femoreg_torch.segment.network import BoneNetwork
from femoreg_torch.segment.refine import contact, refined_labels
from femoreg_torch.volume import (
    Volume,
    bone_labels,
    read_ct,
    read_label_map,
    read_labels,
    read_landmarks,
    resample_isotropic,
)
from sim.patient.from_labels import make_label_patient
from sim.patient.writing import write_patient

_BONES = ("hip_left", "hip_right", "sacrum", "femur_left", "femur_right")
_SHAFT_MM = 60.0  # by which femora go on below their cut
_RAGGED_MM = 6.0  # above the cut, where outlines are often ragged
_SEED = 100

Labels = NDArray[np.uint8]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("cases", type=Path, nargs="+", help="label maps, or folders of synthetic patients")
    parser.add_argument("--weights", type=Path, help="by default the shipped ones")
    parser.add_argument("--cache", type=Path, required=True, help="where CTs around label maps are kept")
    parser.add_argument("--ways", nargs="+", default=["refined", "graph_cut", "network", "cuts", "true"])
    parser.add_argument("--title", default="Bones of whole CTs around held-out shapes")
    options = parser.parse_args()
    network = load_bone_network(options.weights)
    ways: dict[str, Callable[[Volume, Labels], Labels]] = {
        "refined": lambda ct, _: segment_bones(ct, network).labels.data.numpy(),
        "network": lambda ct, _: segment_bones(ct, network, refine=False).labels.data.numpy(),
        "graph_cut": lambda ct, _: segment_bones_without_network(ct).labels.data.numpy(),
        "cuts": lambda ct, _: segment_bones_without_network(ct, refine=False).labels.data.numpy(),
        "true": lambda ct, truth: _from_truth(ct, truth, network),
    }
    rows = []
    for path in options.cases:
        folder = path if path.is_dir() else _patient_around(path, options.cache)
        ct = read_ct(folder / "ct.nii.gz")
        truth = read_labels(folder / "labels.nii.gz", ct).data.numpy().astype(np.uint8)
        points = read_landmarks(folder / "landmarks.json")
        for way in options.ways:
            start = time.process_time()
            found = ways[way](ct, truth)
            seconds = time.process_time() - start
            marks = _landmark_errors(ct, found, points) if way in ("refined", "graph_cut", "true") else "–"
            row = [_name(path), way, *_row(found, truth, np.array(ct.spacing_mm)[::-1]), marks, f"{seconds:.0f}"]
            print(*row, sep=" | ", flush=True)
            rows.append(row)
    header = [
        *("CT", "way", *(bone.replace("_", " ") for bone in _BONES), "95 % of surface within, mm"),
        *("joint: femur touches hip bone, mm²", "landmarks: mean, largest, heads, mm", "CPU s"),
    ]
    write_section(options.title, f"{machine('cpu', [])}\n\n{table(header, rows)}")


def _name(path: Path) -> str:
    return path.name.split(".")[0] if path.is_file() else path.parent.name


def _patient_around(path: Path, cache: Path) -> Path:
    """Folder with the CT around a label map, its true labels and landmarks; made once."""
    folder = cache / path.name.split(".")[0]
    if not folder.is_dir():
        labels, ids = read_label_map(path), label_table("autoseg")
        femora = [n for side in ("left", "right") for n in ids[f"femur_{side}"]]
        patient = make_label_patient(_longer(labels, femora), ids, _SEED + sum(map(ord, path.name)))
        folder.mkdir(parents=True)
        write_patient(folder, patient)
    return folder


def _longer(labels: Volume, ids: list[int]) -> Volume:
    """The label map with its femora going on below their cuts."""
    data = labels.data.clone()
    lowest, ends = len(data), []
    for number in ids:
        first = int(torch.nonzero((data == number).flatten(1).any(1))[0]) + round(_RAGGED_MM / labels.spacing_mm[2])
        ends.append((number, first, data[first] == number))
        lowest = min(lowest, first)
    count = round(_SHAFT_MM / labels.spacing_mm[2])
    data = torch.cat([torch.zeros((count, *data.shape[1:]), dtype=data.dtype), data[lowest:]])
    for number, first, end in ends:
        data[: count + first - lowest][data[: count + first - lowest] == number] = 0
        data[: count + first - lowest, end] = number
    affine = labels.lps_from_index.clone()
    affine[:3, 3] += affine[:3, 2] * (lowest - count)
    return Volume(data, affine)


def _from_truth(ct: Volume, truth: Labels, network: BoneNetwork) -> Labels:
    """The refinement alone: what it makes of the true labels, averaged to the voxels of the network."""
    grid = resample_isotropic(ct, network.voxel_mm)
    shares = [
        F.interpolate(torch.from_numpy(truth == k)[None, None].float(), grid.data.shape, mode="area")[0, 0]
        for k in range(1 + len(HIP.bones))
    ]
    return refined_labels(ct, torch.stack(shares), grid, HIP).numpy()


def _landmark_errors(ct: Volume, found: Labels, truth: dict[str, torch.Tensor]) -> str:
    """Mean and largest distance of the landmarks proposed on labels, and the mean of the femoral heads, mm."""
    try:
        bones = bone_labels(Volume(torch.from_numpy(found), ct.lps_from_index), ct, label_table("femoreg"), HIP, {})
        points = propose_landmarks(ct, bones).points
    except InputError as error:
        return str(error)
    off = {name: float((points[name] - truth[name]).norm()) for name in truth if name in points}
    heads = [off[name] for name in off if name.startswith("FH")]
    lacking = "" if len(off) == len(truth) else f" ({len(truth) - len(off)} lacking)"
    return f"{np.mean(list(off.values())):.1f}, {max(off.values()):.1f}, {np.mean(heads):.1f}{lacking}"


def _row(found: Labels, truth: Labels, spacing: NDArray[np.float64]) -> list[str]:
    dice, far = [], 0.0
    for bone in _BONES:
        number = 1 + HIP.bone_names.index(bone)
        one, other = found == number, truth == number
        dice.append(2 * (one & other).sum() / max(1, one.sum() + other.sum()))
        far = max(far, _distance_95(one, other, spacing))
    face = float(np.mean([spacing[0] * spacing[1], spacing[0] * spacing[2], spacing[1] * spacing[2]]))
    touching = [
        contact(found, *(1 + HIP.bone_names.index(f"{bone}_{side}") for bone in ("femur", "hip"))).sum() / 2 * face
        for side in ("left", "right")
    ]
    return [*(f"{value:.3f}" for value in dice), f"{far:.1f}", " / ".join(f"{area:.0f}" for area in touching)]


def _distance_95(one: NDArray[np.bool_], other: NDArray[np.bool_], spacing: NDArray[np.float64]) -> float:
    """95th percentile of the distances of either surface from the other one, mm."""
    if not (one.any() and other.any()):
        return float("inf")
    box = ndimage.find_objects((one | other).astype(np.uint8))[0]
    box = tuple(slice(max(0, s.start - 1), s.stop + 1) for s in box)
    rims = [mask[box] & ~ndimage.binary_erosion(mask[box], border_value=1) for mask in (one, other)]
    apart = [ndimage.distance_transform_edt(~rims[1 - k], spacing)[rims[k]] for k in range(2)]
    return float(np.percentile(np.concatenate(apart), 95))


if __name__ == "__main__":
    main()
