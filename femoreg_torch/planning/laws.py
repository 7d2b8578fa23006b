"""Density into Young's modulus and strength of bone."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from femoreg_torch.planning.settings import BoneSettings

Array = NDArray[np.float64]

# Tension and compression of Morgan's law: yield strains of the femoral neck, as parosol-py's `hip_keaveny` has them.
TENSION_STRAIN, COMPRESSION_STRAIN = 0.0061, 0.0085


@dataclass(frozen=True, eq=False)
class Material:
    """Young's modulus and the strengths in tension and compression, MPa, all of one shape."""

    modulus: Array
    tension: Array
    compression: Array


def bone_material(ash: Array, settings: BoneSettings) -> Material:
    """Stiffness and strength of bone of some ash density in g/cc.

    keyak: E = 14900 ρ^1.86, S = 102 ρ^1.80 with ρ the ash density in g/cc (Keyak 2005, as implemented by Sas et al.
    2020), the same in tension and compression. morgan: E = 6850 ρ^1.49 with ρ the apparent density, of the femoral neck
    (Morgan et al. 2003); strengths are E times the yield strains 0.61 % and 0.85 %.
    """
    ash = np.maximum(ash, settings.least_density_g_cc)
    if settings.law == "keyak":
        strength = 102.0 * ash**1.80
        return Material(14900.0 * ash**1.86, strength, strength)
    modulus = 6850.0 * (ash / settings.ash_of_apparent) ** 1.49
    return Material(modulus, TENSION_STRAIN * modulus, COMPRESSION_STRAIN * modulus)
