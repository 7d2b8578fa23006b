"""Draws the frames of the concept pages: `python docs/concepts/draw.py [FOLDER]` writes its SVG files.

What the figures show of the camera, the orbit and the displays is computed by the library, not sketched.
"""

import sys
from pathlib import Path

import matplotlib as mpl
import matplotlib.pyplot as plt
import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.figure import Figure

import femoreg_torch as femoreg
from femoreg_torch.fluoro.display import Display
from femoreg_torch.geometry import project_points

HERE = Path(__file__).resolve().parent
STYLE = {"svg.fonttype": "none", "svg.hashsalt": "femoreg", "font.size": 9, "font.family": "sans-serif"}
X, Y, Z, BONE, DARK = "#c0392b", "#2e8b57", "#2a6fbb", "#d9a441", "#333333"
# What looks from the page at a camera: its z to the right and a little up, its y down, its x towards the reader.
_OBLIQUE = np.array([[-0.42, 0.0, 1.0], [-0.30, -1.0, 0.10]])
# A person with the left arm raised: lines through points in LPS, mm, and thickness.
_PERSON = [
    ([(0, 0, 60), (0, 0, -60)], 26),
    ([(0, 0, 88), (0, 0, 100)], 20),
    ([(0, 0, 50), (60, 0, 95)], 9),
    ([(0, 0, 50), (-45, 0, -10)], 9),
    ([(-12, 0, -60), (-18, 0, -130)], 11),
    ([(12, 0, -60), (18, 0, -130)], 11),
    ([(0, 0, 90), (0, -28, 90)], 6),
]
# camera from LPS (rotations) for a source on each side: head up, z away from the source
_ROTATION = {
    "anterior": [[1, 0, 0], [0, 0, -1], [0, 1, 0]],
    "posterior": [[-1, 0, 0], [0, 0, -1], [0, -1, 0]],
    "left": [[0, 1, 0], [0, 0, -1], [-1, 0, 0]],
    "right": [[0, -1, 0], [0, 0, -1], [1, 0, 0]],
}


def arrow(axes: Axes, start: np.ndarray, end: np.ndarray, colour: str, text: str = "", **style: float) -> None:
    """An arrow in the figure's mm, its name at the tip."""
    axes.plot(*end, alpha=0)  # or the arrow would not count for the limits of the axes
    axes.annotate("", end, start, arrowprops={"arrowstyle": "-|>", "color": colour, "lw": style.get("lw", 1.6)})
    if text:
        along = (end - start) / np.linalg.norm(end - start)
        axes.text(*(end + style.get("gap", 30) * along), text, color=colour, ha="center", va="center")


def bare(axes: Axes) -> None:
    """Equal scales and no frame."""
    axes.set_aspect("equal")
    axes.axis("off")


def camera_frame() -> Figure:
    """Source, detector, axes and principal point of the shipped C-arm."""
    carm = femoreg.load_carm("cios_fusion")
    camera = carm.camera
    rows, columns = camera.shape
    corners_px = np.array([(-0.5, -0.5), (columns - 0.5, -0.5), (columns - 0.5, rows - 0.5), (-0.5, rows - 0.5)])
    row_mm, column_mm = camera.pixel_mm
    c, r = camera.principal_point_px

    def flat(point: object) -> np.ndarray:
        return _OBLIQUE @ np.asarray(point, float)

    def on_detector(column: float, row: float) -> np.ndarray:
        return flat(((column - c) * column_mm, (row - r) * row_mm, camera.sdd_mm))

    figure, axes = plt.subplots(figsize=(7.2, 3.6))
    source = flat((0, 0, 0))
    corners = np.array([on_detector(*corner) for corner in corners_px])
    axes.fill(*corners.T, facecolor="#eef2f7", edgecolor=DARK, lw=1)
    for corner in corners:
        axes.plot(*np.array([source, corner]).T, color="#bbbbbb", lw=0.6)
    axes.plot(*np.array([source, on_detector(c, r)]).T, color="#888888", lw=0.8, ls="--")
    for direction, colour, name in (((1, 0, 0), X, "x"), ((0, 1, 0), Y, "y"), ((0, 0, 1), Z, "z")):
        arrow(axes, source, flat(180 * np.array(direction)), colour, name)
    axes.plot(*source, "o", color=DARK)
    axes.text(source[0] - 20, source[1] + 40, "X-ray source:\norigin of the camera", ha="right")
    isocentre = flat(carm.isocentre_mm)
    axes.plot(*isocentre, "x", color=DARK)
    axes.text(isocentre[0], isocentre[1] + 32, f"isocentre, z = {carm.isocentre_mm[2]:.0f} mm", ha="center")
    axes.plot(*on_detector(c, r), "+", color=DARK, markersize=9)
    axes.text(*(on_detector(c, r) + np.array([70, -60])), f"principal point\n({c:g}, {r:g}) px", fontsize=8)
    first = on_detector(0, 0)
    arrow(axes, first, on_detector(columns * 0.45, 0), X, "columns", gap=75)
    arrow(axes, first, on_detector(0, rows * 0.45), Y, "rows", gap=22)
    axes.plot(*first, "s", color=DARK, markersize=3)
    axes.text(first[0] + 8, first[1] + 26, "pixel (0, 0)", fontsize=8)
    axes.text(
        *(0.5 * (corners[2] + corners[3]) + np.array([0, -75])), f"detector, z = {camera.sdd_mm:.0f} mm", ha="center"
    )
    bare(axes)
    return figure


def orbit() -> Figure:
    """Sources and detectors after the C-arm has turned, seen along the orbit's axis from the patient's feet."""
    carm = femoreg.load_carm("cios_fusion")
    half = carm.camera.shape[1] / 2 * carm.camera.pixel_mm[1]
    figure, axes = plt.subplots(figsize=(5.6, 5.2))
    for angle, colour in ((0.0, DARK), (30.0, Z), (-30.0, X)):
        moved_from_first = carm.orbit(torch.deg2rad(torch.tensor(angle, dtype=torch.float64))).numpy()
        first_from_moved = np.linalg.inv(moved_from_first)

        def seen(x: float, z: float, pose: np.ndarray = first_from_moved) -> np.ndarray:
            point = pose @ (x, 0, z, 1)
            return np.array([point[0], -point[2]])  # z downwards: the source stands above the patient

        source, sdd = seen(0, 0), carm.camera.sdd_mm
        left, right = seen(-half, sdd), seen(half, sdd)
        axes.plot(*np.array([left, right]).T, color=colour, lw=3)
        for end in (left, right):
            axes.plot(*np.array([source, end]).T, color=colour, lw=0.6)
        axes.plot(*source, "o", color=colour)
        axes.text(*(source + np.array([0, 35])), f"{angle:+.0f}°" if angle else "view 1", color=colour, ha="center")
    isocentre = np.array([carm.isocentre_mm[0], -carm.isocentre_mm[2]])
    body = np.linspace(0, 2 * np.pi, 90)
    axes.fill(isocentre[0] + 190 * np.cos(body), isocentre[1] + 110 * np.sin(body), color=BONE, alpha=0.25, lw=0)
    axes.plot(*isocentre, "x", color=DARK)
    axes.text(*(isocentre + np.array([14, -34])), "isocentre", fontsize=8)
    axes.text(isocentre[0] + 150, isocentre[1], "L", weight="bold")
    axes.text(isocentre[0] - 165, isocentre[1], "R", weight="bold")
    corner = np.array([-430.0, 40.0])
    arrow(axes, corner, corner + np.array([110, 0]), X, "x", gap=18)
    arrow(axes, corner, corner + np.array([0, -110]), Z, "z", gap=18)
    axes.text(*(corner + np.array([-22, 10])), "y: out of\nthe page", color=Y, ha="right", fontsize=8, va="center")
    axes.set_xlim(-640, 480)
    bare(axes)
    return figure


def patient_space() -> Figure:
    """LPS on a person seen from the front, and on an axial slice as CT programs show it."""
    figure, (front, axial) = plt.subplots(1, 2, figsize=(7.2, 3.6))
    for points, thickness in _PERSON:
        line = np.array(points)[:, [0, 2]]
        front.plot(*line.T, color=BONE, lw=thickness * 0.8, solid_capstyle="round", alpha=0.6)
    origin = np.array([0.0, 0.0])
    arrow(front, origin, origin + np.array([95, 0]), X, "x: left", gap=26)
    arrow(front, origin, origin + np.array([0, 165]), Z, "z: head", gap=14)
    front.text(-14, -14, "y: to the back,\ninto the page", color=Y, ha="right", fontsize=8, va="top")
    front.set(title="seen from the front", xlim=(-160, 170), ylim=(-150, 200))
    body = np.linspace(0, 2 * np.pi, 90)
    axial.fill(130 * np.cos(body), 80 * np.sin(body), color=BONE, alpha=0.35, lw=0)
    for side in (-70, 70):
        axial.add_patch(plt.Circle((side, 0), 22, color=BONE))
    arrow(axial, origin, origin + np.array([165, 0]), X, "x: left", gap=32)
    arrow(axial, origin, origin + np.array([0, 115]), Y, "y: back", gap=14)
    axial.text(-12, -12, "z: to the head,\naway from the reader", color=Z, ha="right", va="top", fontsize=8)
    axial.text(0, -98, "front", ha="center", fontsize=8)
    axial.set(title="an axial slice, as it is shown: from the feet", xlim=(-160, 210), ylim=(130, -130))
    for axes in (front, axial):
        bare(axes)
    return figure


def _seen_from(source: str) -> np.ndarray:
    """The person as a camera at that side sees it: (H, W), dark lines."""
    camera = femoreg.load_carm("cios_fusion").camera.downsampled(12)
    rotation = torch.tensor(_ROTATION[source], dtype=torch.float64)
    figure, axes = plt.subplots(figsize=(1.28, 1.28), dpi=100)
    figure.subplots_adjust(0, 0, 1, 1)
    axes.set(xlim=(0, camera.shape[1]), ylim=(camera.shape[0], 0))
    axes.axis("off")
    for points, thickness in _PERSON:
        in_camera = 0.78 * torch.tensor(points, dtype=torch.float64) @ rotation.T
        in_camera[:, 2] += 640
        pixels = project_points(camera, in_camera)
        axes.plot(*pixels.T.numpy(), color=DARK, lw=thickness * 0.28, solid_capstyle="round")
    figure.canvas.draw()
    grey = np.asarray(figure.canvas.buffer_rgba())[..., 0].copy()  # type: ignore[attr-defined]  # of Agg
    plt.close(figure)
    return grey


def displays() -> Figure:
    """What the source sees, and the picture that is stored, for each side, and for pictures mirrored or turned."""
    columns = [Display(source) for source in _ROTATION]  # type: ignore[arg-type]
    columns += [Display(mirrored=True), Display(turned_deg=90)]
    names = [*(f"source: {name}" for name in _ROTATION), "mirrored: true", "turned: 90"]
    figure, panels = plt.subplots(2, len(columns), figsize=(9.2, 3.5))
    for (upper, lower), display, name in zip(panels.T, columns, names, strict=True):
        camera = torch.from_numpy(_seen_from(display.source))
        for axes, picture in ((upper, camera), (lower, display.to_stored(camera))):
            axes.imshow(picture, cmap="gray", vmin=0, vmax=255)
            axes.set(xticks=[], yticks=[])
        upper.set_title(name, fontsize=9)
    panels[0, 0].set_ylabel("the source sees")
    panels[1, 0].set_ylabel("stored")
    figure.tight_layout()
    return figure


def pixels() -> Figure:
    """Pixel centres at integers, and the principal point after averaging by two."""
    figure, panels = plt.subplots(1, 2, figsize=(6.4, 3.0))
    camera = femoreg.load_carm("cios_fusion").camera
    small = type(camera)(camera.sdd_mm, (1.0, 1.0), (4, 6), (3.2, 1.4))
    for axes, shown, title in zip(
        panels, (small, small.downsampled(2)), ("6 × 4 pixels", "averaged by 2"), strict=True
    ):
        rows, columns = shown.shape
        for edge in range(columns + 1):
            axes.plot([edge - 0.5] * 2, [-0.5, rows - 0.5], color="#999999", lw=0.8)
        for edge in range(rows + 1):
            axes.plot([-0.5, columns - 0.5], [edge - 0.5] * 2, color="#999999", lw=0.8)
        grid = np.stack(np.meshgrid(np.arange(columns), np.arange(rows)), -1).reshape(-1, 2)
        axes.plot(*grid.T, ".", color=DARK)
        c, r = shown.principal_point_px
        axes.plot(c, r, "+", color=X, markersize=11, mew=2)
        axes.set(title=f"{title}: principal point ({c:g}, {r:g})", xticks=range(columns), yticks=range(rows))
        axes.title.set_fontsize(9)
        axes.set_aspect("equal")
        axes.invert_yaxis()
        axes.spines[:].set_visible(False)
    return figure


def errors() -> Figure:
    """Entry point, tip, path and guide, true and estimated, in the plane of the page."""
    figure, axes = plt.subplots(figsize=(7.2, 4.2))
    head, entry = np.array([60.0, 62.0]), np.array([0.0, 0.0])
    true_tip = np.array([-10.0, -4.0])
    turn = np.deg2rad(9)
    rotation = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    head_found = head + np.array([3, 7])
    entry_found = head_found + rotation @ (entry - head)
    tip_found = true_tip + np.array([5, -9])
    guide, guide_found = true_tip + np.array([-46, -44]), tip_found + np.array([-50, -38])
    for points, style, alpha in (
        ((head, entry, true_tip, guide), "-", 1.0),
        ((head_found, entry_found, tip_found, guide_found), "--", 0.75),
    ):
        h, e, t, g = points
        axes.add_patch(plt.Circle(h, 21, fill=False, color=BONE, lw=2, ls=style, alpha=alpha))
        axes.plot(*np.array([e, h]).T, color=BONE, ls=style, lw=2, alpha=alpha)
        axes.plot(*np.array([t, g]).T, color=Y, ls=style, lw=4 if style == "-" else 2, alpha=alpha)
        axes.plot(*e, "o", color=BONE, alpha=alpha)
        axes.plot(*t, "^", color=Y, alpha=alpha)
    for start, end, text, place in (
        (entry, entry_found, "entry point (9)", (22, -6)),
        (true_tip, tip_found, "guide tip (10)", (16, -13)),
    ):
        arrow(axes, start, end, X, lw=1.4)
        axes.text(*(0.5 * (start + end) + place), text, color=X, ha="left", fontsize=9)
    axes.text(
        *(head_found + np.array([27, 8])),
        "femur path (12): the angle between\nboth lines from entry to head",
        fontsize=8,
    )
    axes.text(*(guide + np.array([-2, 18])), "guide path (13): the\nangle between both guides", fontsize=8, ha="right")
    axes.plot([], [], color=DARK, ls="-", label="true")
    axes.plot([], [], color=DARK, ls="--", label="estimated")
    base = np.array([86.0, -24.0])
    moved, tip_moved = 2.5 * (entry_found - entry), 2.5 * (tip_found - true_tip)  # larger, to be seen
    arrow(axes, base, base + moved, X, lw=1.2)
    arrow(axes, base, base + tip_moved, X, lw=1.2)
    arrow(axes, base + tip_moved, base + moved, Z, lw=2)
    axes.text(
        *(base + np.array([34, -18])),
        "entry point to tip (11):\nwhat is left of the one\nwithout the other\n(enlarged)",
        color=Z,
        fontsize=8,
    )
    axes.legend(loc="upper left", frameon=False)
    axes.set(xlim=(-100, 165), ylim=(-60, 100))
    bare(axes)
    return figure


FIGURES = {
    "camera": camera_frame,
    "orbit": orbit,
    "patient": patient_space,
    "displays": displays,
    "pixels": pixels,
    "errors": errors,
}


def main(folder: Path = HERE) -> None:
    """Write all figures."""
    with mpl.rc_context(STYLE):
        for name, draw in FIGURES.items():
            figure = draw()
            figure.savefig(folder / f"{name}.svg", bbox_inches="tight", metadata={"Date": None, "Creator": None})
            plt.close(figure)


if __name__ == "__main__":
    mpl.use("agg")
    main(*map(Path, sys.argv[1:]))
