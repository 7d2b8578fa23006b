"""The same femur and cement on a mesh of another size: how far load and gain hang on the mesh, and what it costs."""

import time
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from femoreg_torch.planning.prepare import Prepared

Array = NDArray[np.float64]


@dataclass(frozen=True)
class MeshRow:
    """One mesh."""

    size_mm: float  # edge of its elements
    elements: int
    baseline_n: float  # yield load without cement
    gain: float  # of the cement, over that
    seconds: float  # of processor time for one curve, the mean of the two


def on_mesh(prepared: Prepared, cement: Array, size_mm: float) -> MeshRow:
    """Yield load without cement, and gain of the cement (X, Y, Z), with elements of some size.

    Raises `InputError` for a mesh with more elements than the settings allow.
    """
    other = prepared.on_elements(size_mm)
    began = time.process_time()
    without = other.curve().yield_load_n
    gain = other.curve(cement).yield_load_n / without - 1
    seconds = (time.process_time() - began) / 2
    return MeshRow(float(size_mm), len(other.model.mesh.elements), without, gain, seconds)
