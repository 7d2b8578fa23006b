"""Draws the 14 landmarks on the bones of a synthetic patient: `python docs/concepts/draw_landmarks.py [FOLDER]`."""

import sys
from dataclasses import dataclass
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.patheffects import withStroke
from numpy.typing import NDArray
from scipy import ndimage

from femoreg_torch.anatomy import HIP, label_table
from femoreg_torch.volume import Volume
from sim.patient import make_patient

Array = NDArray[np.float64]
HERE = Path(__file__).resolve().parent
SEED, PIXEL_MM = 301, 0.7
HIPS, ALL = ("hip_left", "hip_right"), (*HIP.groups["pelvis"], "femur_left", "femur_right")


@dataclass(frozen=True)
class View:
    """What is drawn of which bones, and from where."""

    title: str
    bones: tuple[str, ...]
    yaw_deg: float  # of the eye, towards the patient's left
    pitch_deg: float  # of the eye, upwards
    landmarks: tuple[str, ...]  # names, or what left and right ones begin with
    shift_mm: tuple[float, float]  # of the picture's middle from that of the femoral heads: to its right, to the head
    size_mm: tuple[int, int]


_VIEWS = [
    View("from the front", ALL, 0, 0, ("FH", "ASIS", "SPS", "IPS"), (0, 30), (320, 270)),
    View("hip bones from the front and below", HIPS, 0, -25, ("IOF", "MOF", "SPS", "IPS"), (0, -25), (190, 130)),
    View("the left hip bone from the left", HIPS[:1], 90, 0, ("GSN-l", "ASIS-l", "IOF-l"), (0, 30), (240, 270)),
]


def towards(yaw_deg: float, pitch_deg: float) -> Array:
    """Rows (3, 3), LPS: to the right of the picture, up in it, and away from an eye that looks at the patient."""
    yaw, pitch = np.radians([yaw_deg, pitch_deg])
    away = -np.array([np.sin(yaw) * np.cos(pitch), -np.cos(yaw) * np.cos(pitch), np.sin(pitch)])
    right = np.array([np.cos(yaw), np.sin(yaw), 0.0])  # seen from the front, the patient's left lies on the right
    return np.array([right, np.cross(right, away), away])


def shaded(labels: Volume, ids: list[int], rows: Array, middle: Array, size_mm: tuple[int, int]) -> Array:
    """The surface of labels as an eye far away sees it (rows, columns), 0 to 1; NaN where there is none."""
    width, height = (np.array(size_mm) / PIXEL_MM).astype(int)
    depth = int(300 / PIXEL_MM)
    lps_from_cell = np.eye(4)  # cell (deep, row from above, column)
    lps_from_cell[:3, :3] = PIXEL_MM * np.column_stack([rows[2], -rows[1], rows[0]])
    lps_from_cell[:3, 3] = middle - lps_from_cell[:3, :3] @ (np.array([depth, height, width]) / 2)
    cell = np.linalg.inv(labels.lps_from_index.numpy()) @ lps_from_cell  # index x, y, z
    bone = np.isin(labels.data.numpy(), ids).astype(np.float32)
    bone = ndimage.gaussian_filter(bone, 0.7)
    there = ndimage.affine_transform(bone, cell[2::-1, :3], cell[2::-1, 3], (depth, height, width), order=1) > 0.5
    deep = np.where(there.any(0), there.argmax(0), np.nan)
    smooth = ndimage.gaussian_filter(np.nan_to_num(deep, nan=depth), 1.0)
    down, across = np.gradient(smooth)
    facing: Array = 1 / np.sqrt(1 + down**2 + across**2)
    return np.where(np.isnan(deep), np.nan, 0.25 + 0.75 * facing)


def show(axes: Axes, labels: Volume, points: dict[str, Array], view: View) -> None:
    """The bones of a view, and its landmarks with their names."""
    rows, (to_right, to_head), size = towards(view.yaw_deg, view.pitch_deg), view.shift_mm, view.size_mm
    middle = (points["FH-l"] + points["FH-r"]) / 2 + to_right * rows[0] + to_head * np.array([0.0, 0.0, 1.0])
    ids = [n for bone in view.bones for n in label_table("femoreg")[bone]]
    picture = shaded(labels, ids, rows, middle, size)
    half = np.array(size) / 2
    axes.imshow(picture, cmap="gray", vmin=0, vmax=1.1, extent=(-half[0], half[0], -half[1], half[1]))
    for name, point in points.items():
        if name in view.landmarks or name[:-2] in view.landmarks:
            x, y, _ = rows @ (point - middle)
            axes.plot(x, y, "o", ms=6, mfc="#e4572e", mec="white", mew=0.8)
            outwards = 1 if (x > 0) == (abs(x) < 0.36 * size[0]) else -1  # the text stays in the picture
            axes.annotate(name, (x, y), (7 * outwards, 5), textcoords="offset points", fontsize=9, color="#10316b",
                          ha="left" if outwards > 0 else "right", fontweight="bold",
                          path_effects=[withStroke(linewidth=2, foreground="white")])  # fmt: skip
    axes.set_title(view.title, fontsize=10)
    axes.set_axis_off()


def draw(folder: Path) -> None:
    """Write `landmarks.png`."""
    patient = make_patient(SEED)
    points = {name: point.numpy() for name, point in patient.landmarks.items()}
    figure, axes = plt.subplots(1, 3, figsize=(13, 4.9), width_ratios=[1.15, 1.15, 0.95], layout="constrained")
    for place, view in zip(axes, _VIEWS, strict=True):
        show(place, patient.labels, points, view)
    figure.savefig(folder / "landmarks.png", dpi=90)
    plt.close(figure)


if __name__ == "__main__":
    draw(Path(sys.argv[1]) if len(sys.argv) > 1 else HERE)
