"""The same femur and cement on meshes of other sizes: how far loads and gain hang on the mesh."""

import dataclasses
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from femoreg_torch.planning.curve import Press
from femoreg_torch.planning.loading import make_loading
from femoreg_torch.planning.model import make_model
from femoreg_torch.planning.prepare import Prepared

Array = NDArray[np.float64]


def on_meshes(prepared: Prepared, cement: Array, sizes_mm: Sequence[float]) -> list[tuple[float, float, float]]:
    """Size mm, yield load without cement N, and gain of the cement (X, Y, Z), for each size of the elements.

    Raises `InputError` for a mesh with more elements than the settings allow.
    """
    bone, planning = prepared.bone, prepared.planning
    rows = []
    for size in sizes_mm:
        model = make_model(bone, planning, size)
        loading = make_loading(model.mesh, bone.femur.frame, planning.load)
        press = Press(model.mesh, loading, planning.bone.poisson, planning.load.pad_modulus_mpa)
        other = dataclasses.replace(prepared, model=model, press=press)
        without = other.curve().yield_load_n
        rows.append((float(size), without, other.curve(cement).yield_load_n / without - 1))
    return rows
