"""All bones of one patient in LPS: the standard shapes scaled, varied, posed and carved."""

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from sim.patient.distance_field import Field
from sim.patient.parameters import PatientParameters
from sim.patient.procedural import femur, hip, spine
from sim.patient.procedural.hip import Warp
from sim.patient.skeleton import SIDES, Skeleton

Points = NDArray[np.float64]
STANDARD_ASIS, STANDARD_HEIGHT, STANDARD_DEPTH = 248.0, 209.0, 150.0  # mm, of the shapes in `procedural.hip`


def smooth_warp(rng: np.random.Generator, amplitude_mm: float, waves: int = 6) -> Warp:
    """Random smooth displacement: a few sine waves of 90 to 260 mm, root mean square `amplitude_mm` per axis."""
    wavelengths = rng.uniform(90, 260, waves)
    directions = rng.standard_normal((waves, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    phases = rng.uniform(0, 2 * np.pi, waves)
    weights = rng.standard_normal((waves, 3)) * amplitude_mm * np.sqrt(2 / waves)

    def warp(points: Points) -> Points:
        angles = points @ (directions * (2 * np.pi / wavelengths[:, None])).T + phases
        moved: Points = points + np.sin(angles) @ weights
        return moved

    return warp


def _pelvis_warp(parameters: PatientParameters, variation: Warp) -> Warp:
    """From the left half of the standard pelvis to the patient's, both in the anterior pelvic plane's frame."""
    ring, wing = parameters.inter_head / (2 * hip.HEAD[0]), parameters.inter_asis / STANDARD_ASIS
    height, depth = parameters.pelvis_height / STANDARD_HEIGHT, parameters.pelvis_depth / STANDARD_DEPTH
    head_shift = variation(hip.HEAD[None])[0] - hip.HEAD

    def warp(points: Points) -> Points:
        near_head = np.exp(-((np.linalg.norm(points - hip.HEAD, axis=1, keepdims=True) / 45) ** 2))
        x, y, z = (variation(points) - near_head * head_shift).T  # the head's centre stays put
        outer = np.clip((x - 55) / 50, 0, 1) * np.clip((z - 15) / 60, 0, 1)
        return np.stack([x * (ring + outer * (wing - ring)), y * depth, z * height], 1)

    return warp


def _mirrored(warp: Warp) -> Warp:
    """The warp of the left half on both halves; on the midline nothing moves sideways."""

    def both(points: Points) -> Points:
        sign = np.where(points[:, :1] < 0, [-1.0, 1, 1], [1.0, 1, 1])
        left = points * sign
        moved = warp(left)
        moved[:, 0] = left[:, 0] + (moved[:, 0] - left[:, 0]) * np.clip(left[:, 0] / 25, 0, 1)
        result: Points = moved * sign
        return result

    return both


def _around_own_head(balls: Points, parameters: PatientParameters) -> Points:
    """Move the balls around the socket so that its wall keeps its thickness for the patient's own head radius."""
    away = balls[:, :3] - [parameters.inter_head / 2, 0, 0]
    distance = np.linalg.norm(away, axis=1, keepdims=True)
    growth = (parameters.head_radius - hip.HEAD_RADIUS) * np.clip((62 - distance) / 28, 0, 1)
    return np.c_[balls[:, :3] + growth * away / np.maximum(distance, 1), balls[:, 3]]


def _femur(
    parameters: PatientParameters, name: str, head: Points, rng: np.random.Generator
) -> tuple[Field, Points, Points]:
    """Field in LPS, `lps_from_femur` (3, 3), and the unit vector along the neck."""
    p, mirror = parameters, np.diag([SIDES[name], 1.0, 1.0])
    neck_shaft, anteversion = p.neck_shaft + rng.normal(0, 1), p.anteversion + rng.normal(0, 2)
    shape = femur.FemurShape(p.head_radius, neck_shaft, anteversion, p.femoral_offset, p.head_radius / hip.HEAD_RADIUS)
    flexion, abduction, rotation = p.leg_angles(name)
    angles = [-flexion, -SIDES[name] * abduction, SIDES[name] * rotation]
    lps_from_femur = Rotation.from_euler("XYZ", angles, degrees=True).as_matrix()
    balls, variation = femur.femur_balls(shape), smooth_warp(rng, 0.9)
    beyond_head = np.clip((np.linalg.norm(balls[:, :3], axis=1, keepdims=True) - 15) / 30, 0, 1)
    balls[:, :3] += (variation(balls[:, :3]) - balls[:, :3]) * beyond_head
    placed = np.c_[balls[:, :3] @ (lps_from_femur @ mirror).T + head, balls[:, 3]]
    neck = lps_from_femur @ mirror @ femur.neck_axis(shape)
    return femur.femur_field(placed, head, p.head_radius), lps_from_femur, neck


def build_skeleton(parameters: PatientParameters, rng: np.random.Generator) -> Skeleton:
    """All bones of a patient; `rng` draws the free variation of the shapes."""
    p = parameters
    size = p.pelvis_height / STANDARD_HEIGHT
    warp = _mirrored(_pelvis_warp(p, smooth_warp(rng, 2.2)))
    turns = [p.pelvic_tilt, p.pelvic_list, p.pelvic_turn]
    lps_from_pelvis = Rotation.from_euler("XYZ", turns, degrees=True).as_matrix()

    def placed(balls: Points) -> Points:
        return np.c_[balls[:, :3] @ lps_from_pelvis.T, balls[:, 3] * size]

    bones: dict[str, Field] = {}
    heads: dict[str, Points] = {}
    for name, side in SIDES.items():
        heads[name] = lps_from_pelvis @ [side * p.inter_head / 2, 0, 0]
        balls = hip.warped(hip.warped(hip.hip_balls(), warp), smooth_warp(rng, 0.5))
        balls = _around_own_head(balls * [1, 1, 1, rng.normal(1, 0.03)], p) * [side, 1, 1, 1]
        bones[f"hip_{name}"] = hip.hip_field(placed(balls), heads[name], p.head_radius, lps_from_pelvis, side)
    holes = [
        (lps_from_pelvis @ warp(start[None])[0], lps_from_pelvis @ warp(end[None])[0], radius * size)
        for start, end, radius in spine.sacral_holes()
    ]
    sacrum = placed(hip.warped(spine.sacrum_balls(), warp))
    bones["sacrum"] = spine.sacrum_field(sacrum, holes, [bones["hip_left"], bones["hip_right"]])
    bones["vertebrae"] = spine.lumbar_field(placed(hip.warped(spine.lumbar_balls(), warp)))
    lps_from_femur: dict[str, Points] = {}
    neck: dict[str, Points] = {}
    for name in SIDES:
        bones[f"femur_{name}"], lps_from_femur[name], neck[name] = _femur(p, name, heads[name], rng)
    return Skeleton(bones, heads, p.head_radius, lps_from_pelvis, lps_from_femur, neck)
