"""A patient around real bone shapes: a label map of thick slices becomes smooth bones with invented grey values."""

from pathlib import Path

import numpy as np
import torch

from femoreg_torch.anatomy import HIP, LabelTable
from femoreg_torch.files import new_folder, write_json
from femoreg_torch.volume import Volume, read_label_map
from sim.patient.from_labels.bones import skeleton_from_labels
from sim.patient.landmarks import find_landmarks
from sim.patient.parameters import draw_parameters
from sim.patient.scan import Patient, scan_skeleton
from sim.patient.skeleton import LABEL_IDS
from sim.patient.writing import ORIGIN_NAME, write_patient


def make_label_patient(labels: Volume, bones: LabelTable, seed: int, spacing_mm: float = 1.0) -> Patient:
    """The patient whose bones `labels` holds, on voxels of `spacing_mm`, in the map's LPS frame.

    The map's axes must run along +x, +y, +z. `bones` holds the map's ids of hip bones, femora and sacrum, and of the
    vertebrae, if the map has them; both sides may share an id. `seed` draws bone density, soft tissue and noise. Raises
    `InputError` if a bone is missing, or the two femora are not apart or too short.
    """
    skeleton, centre, bottom_mm = skeleton_from_labels(labels, bones)
    landmarks = find_landmarks(skeleton)
    drawing_seed, tissue_seed, noise_seed, *bone_seeds = np.random.SeedSequence(seed).spawn(3 + len(LABEL_IDS))
    parameters = draw_parameters(np.random.default_rng(drawing_seed))
    seeds = [seed for bone, seed in zip(LABEL_IDS, bone_seeds, strict=True) if bone in skeleton.bones]
    seeds = [tissue_seed, noise_seed, *seeds]
    [(ct, numbers)] = scan_skeleton(skeleton, parameters, bottom_mm, seeds, [spacing_mm])

    def moved(volume: Volume) -> Volume:
        affine = volume.lps_from_index.clone()
        affine[:3, 3] += torch.from_numpy(centre)
        return Volume(volume.data, affine)

    points = {name: torch.from_numpy(landmarks[name] + centre) for name in HIP.landmark_names}
    drawn = {name: float(getattr(parameters, name)) for name in ("bone_density", "cortex", "habitus")}
    return Patient(moved(ct), moved(numbers), points, drawn)


def write_label_patient(path: Path, bones: LabelTable, out: Path, seed: int, spacing_mm: float = 1.0) -> None:
    """Write the patient of the label map in file `path` as folder `out`, whole or not at all.

    It holds ct.nii.gz, labels.nii.gz, landmarks.json, and origin.json: what it is made from.

    Raises `InputError` as `read_label_map` and `make_label_patient` do.
    """
    patient = make_label_patient(read_label_map(path), bones, seed, spacing_mm)
    with new_folder(out) as folder:
        write_patient(folder, patient)
        origin = {"source": path.name, "licence": "that of the label map", "seed": seed, "spacing_mm": spacing_mm}
        write_json(folder / ORIGIN_NAME, {"what": "synthetic CT: bones of a label map, invented HU", **origin})
