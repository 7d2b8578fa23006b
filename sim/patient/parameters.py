"""What makes one patient differ from another: numbers drawn from a seed within published ranges."""

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class PatientParameters:
    """One patient. Lengths mm, angles degrees; pelvic lengths in the anterior pelvic plane's frame.

    `habitus` scales the fat layer (1 is lean to normal), `bone_density` the spongy bone above fatty marrow (1 is
    healthy), `cortex` the thickness of the cortical shell. Positive rotation of a leg is outwards.
    """

    female: bool
    head_radius: float
    inter_head: float
    inter_asis: float
    pelvis_height: float
    pelvis_depth: float
    neck_shaft: float
    anteversion: float
    femoral_offset: float
    pelvic_tilt: float
    pelvic_turn: float
    pelvic_list: float
    flexion_left: float
    flexion_right: float
    abduction_left: float
    abduction_right: float
    rotation_left: float
    rotation_right: float
    bone_density: float
    cortex: float
    habitus: float

    def leg_angles(self, side: str) -> tuple[float, float, float]:
        """Flexion, abduction and outward rotation of the `left` or `right` femur, degrees."""
        if side == "left":
            return self.flexion_left, self.abduction_left, self.rotation_left
        return self.flexion_right, self.abduction_right, self.rotation_right


def _within(rng: np.random.Generator, mean: float, deviation: float, low: float, high: float) -> float:
    """Normal draw, drawn again while it lies outside [low, high]."""
    while not low <= (value := rng.normal(mean, deviation)) <= high:
        pass
    return float(value)


def draw_parameters(rng: np.random.Generator) -> PatientParameters:
    """One adult.

    Means, deviations and limits follow: femoral head diameter 46 ± 5 mm, neck-shaft angle 125 ± 7°, offset 43 ± 7 mm
    (Noble et al., "The anatomic basis of femoral component design", Clin. Orthop. 235, 1988); about 5 mm between the
    head diameters of the sexes, and anteversion 10 ± 9° (Toogood et al., "Proximal femoral anatomy in the normal human
    population", Clin. Orthop. 467, 2009; Milner and Boldsen, J. Forensic Sci. 57, 2012); distance of the hip centres
    and of the ASIS, wider pelvic ring for its height in women (Seidel et al., "Hip joint center location from palpable
    bony landmarks", J. Biomech. 28, 1995; Bell et al., J. Biomech. 23, 1990). Supine tilt of the anterior pelvic
    plane 4 ± 6° (Lembeck et al., Acta Orthop. 76, 2005). The pose of the legs and the habitus are our own ranges.
    """
    female = bool(rng.random() < 0.6)
    size = _within(rng, 0.965 if female else 1.03, 0.035, 0.88, 1.12)
    breadth = size * (1.045 if female else 0.985)
    bone_density = _within(rng, 0.8, 0.18, 0.4, 1.1)
    return PatientParameters(
        female=female,
        head_radius=np.clip(
            23.6 * size * _within(rng, 1.0, 0.03, 0.93, 1.07) * (0.97 if female else 1.03), 19.5, 28.0
        ).item(),
        inter_head=np.clip(180 * breadth * _within(rng, 1.0, 0.03, 0.93, 1.07), 150.0, 215.0).item(),
        inter_asis=np.clip(237 * breadth * _within(rng, 1.0, 0.05, 0.9, 1.12), 190.0, 290.0).item(),
        pelvis_height=np.clip(
            212 * size * _within(rng, 1.0, 0.03, 0.93, 1.07) * (0.98 if female else 1.02), 175.0, 250.0
        ).item(),
        pelvis_depth=np.clip(148 * size * _within(rng, 1.0, 0.03, 0.93, 1.07), 120.0, 175.0).item(),
        neck_shaft=_within(rng, 126, 5.5, 113, 140),
        anteversion=_within(rng, 11, 8, -8, 30),
        femoral_offset=np.clip(41.5 * size * _within(rng, 1.0, 0.09, 0.8, 1.2), 30.0, 56.0).item(),
        pelvic_tilt=_within(rng, 4, 7, -14, 20),
        pelvic_turn=_within(rng, 0, 2.5, -6, 6),
        pelvic_list=_within(rng, 0, 2.0, -5, 5),
        flexion_left=_within(rng, 4, 5, -6, 18),
        flexion_right=_within(rng, 4, 5, -6, 18),
        abduction_left=_within(rng, -3, 4, -10, 10),
        abduction_right=_within(rng, -3, 4, -10, 10),
        rotation_left=_within(rng, -4, 9, -25, 18),
        rotation_right=_within(rng, -4, 9, -25, 18),
        bone_density=bone_density,
        cortex=float(np.sqrt(bone_density)) * _within(rng, 1.05, 0.08, 0.85, 1.25),
        habitus=_within(rng, 1.2, 0.45, 0.5, 2.4),
    )
