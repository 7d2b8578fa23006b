"""Figures of a plan."""

from collections.abc import Mapping, Sequence
from pathlib import Path as File

import numpy as np
from matplotlib.figure import Figure
from matplotlib.patheffects import withStroke
from matplotlib.ticker import LogLocator, MaxNLocator, NullLocator, StrMethodFormatter

from femoreg_torch.files import temporary_file
from femoreg_torch.planning.convergence import MeshRow
from femoreg_torch.planning.curve import Curve
from femoreg_torch.planning.offsets import Outcome
from femoreg_torch.planning.plan import FemoroplastyPlan
from femoreg_torch.planning.prepare import Prepared

_LEAST_SPAN_POINTS = 4.0  # of an axis of gains: smaller differences lie within the error of the mesh
_PLANES = ("sagittal", "coronal", "axial")  # by the index axis square to them
_AXES = ("R ←   → L", "A ←   → P", "→ head")  # along the index axes
_BAR_MM = 20.0  # length of the bar that tells the scale: places of a part cut out of the CT would mean nothing
_BESIDE_MM = 8.0  # shown around the bone that is modelled


def save(figure: Figure, path: File) -> None:
    """Write a figure as PNG, whole or not at all."""
    with temporary_file(path) as part:
        figure.savefig(part, dpi=110)


def curves_figure(curves: Mapping[str, Curve]) -> Figure:
    """Load over displacement, with the yield point of each curve."""
    figure = Figure(figsize=(7, 5), layout="constrained")
    axis = figure.subplots()
    for name, curve in curves.items():
        (line,) = axis.plot(curve.displacement_mm, curve.load_n, label=f"{name}: {curve.yield_load_n:.0f} N")
        axis.plot(curve.yield_mm, curve.yield_load_n, "o", color=line.get_color())
    axis.set(xlabel="displacement of the pad, mm", ylabel="load on the head, N", title="Modelled load; dot: yield load")
    axis.legend(loc="lower right")
    axis.grid(alpha=0.3)
    return figure


def overlay_figure(prepared: Prepared, plan: FemoroplastyPlan) -> Figure:
    """Three planes through the middle of the cement: CT, cement (filled), optimum (outline) and path (projected).

    They show the part of the femur that is modelled. In the axial plane the front is at the top, as in other viewers.
    Cement is red where it takes a little of a voxel's pores, yellow where it takes all.
    """
    femur = prepared.bone.femur
    weight = plan.cement * prepared.bone.pores
    middle = np.round((np.argwhere(weight > 0) * weight[weight > 0][:, None]).sum(0) / weight.sum()).astype(int)
    ends = femur.index(np.stack([plan.path.entry, plan.path.target]))
    modelled = np.argwhere(prepared.model.voxels)
    edges = np.stack([modelled.min(0), modelled.max(0) + 1]) * femur.spacing + [[-_BESIDE_MM], [_BESIDE_MM]]  # (2, 3)
    edges = np.clip(edges, 0, np.array(femur.mask.shape) * femur.spacing)
    wide = edges[1] - edges[0]
    figure = Figure(figsize=(14, 6), layout="compressed")
    panels = figure.subplots(1, 3, width_ratios=(wide[1] / wide[2], wide[0] / wide[2], wide[0] / wide[1]))
    for normal, (axis, plane) in enumerate(zip(panels, _PLANES, strict=True)):
        across = [n for n in range(3) if n != normal]
        cut = tuple(middle[normal] if n == normal else slice(None) for n in range(3))
        size = [femur.mask.shape[n] * femur.spacing[n] for n in across]
        extent = (0.0, float(size[0]), 0.0, float(size[1]))
        axis.imshow(femur.hu[cut].T, cmap="gray", vmin=-200, vmax=1300, origin="lower", extent=extent)
        filled = np.ma.masked_less(plan.cement[cut].T, 0.05)
        axis.imshow(filled, cmap="autumn", vmin=0, vmax=1, alpha=0.6, origin="lower", extent=extent)
        grid = [(np.arange(femur.mask.shape[n]) + 0.5) * femur.spacing[n] for n in across]
        axis.contour(*grid, plan.optimum.cement[cut].T, levels=[0.5], colors="deepskyblue", linewidths=1.2)
        line = (ends[:, across] + 0.5) * femur.spacing[across]
        axis.plot(*line.T, "-", color="lime", linewidth=2)
        axis.plot(*line[0], "o", color="lime")
        upwards = edges[:, across[1]] if plane != "axial" else edges[::-1, across[1]]
        axis.set(title=plane, xlim=edges[:, across[0]], ylim=upwards, facecolor="black")
        axis.set(xlabel=_AXES[across[0]], ylabel=_AXES[across[1]] if plane != "axial" else "P ←   → A")
        axis.set(xticks=[], yticks=[])
        corner = edges[0, across[0]] + 4, upwards[0] + (4 if plane != "axial" else -4)
        rim = [withStroke(linewidth=5, foreground="black")]  # cortex is as white as the bar
        bar = [corner[0], corner[0] + _BAR_MM], [corner[1], corner[1]]
        axis.plot(*bar, color="white", linewidth=3, path_effects=rim)
        label = axis.annotate(f"{_BAR_MM:g} mm", corner, (0, 4), textcoords="offset points", color="white")
        label.set_path_effects([withStroke(linewidth=3, foreground="black")])
    figure.suptitle(
        "cement as planned (filled; red: little of a voxel's pores, yellow: all), free optimum (blue), "
        "path (green, projected; dot: entry point)\n"
        f"{plan.volume_ml:g} ml, yield load {100 * plan.gain:+.0f} % (optimum {100 * plan.optimum_gain:+.0f} %), "
        "modelled"
    )
    return figure


def offsets_figure(outcomes: Mapping[str, Outcome], baseline_n: float, planned_n: float) -> Figure:
    """Gain in each direction beside that of the plan."""
    figure = Figure(figsize=(8, 4.5), layout="constrained")
    axis = figure.subplots()
    gains = [100 * (outcome.yield_load_n / baseline_n - 1) for outcome in outcomes.values()]
    axis.bar(list(outcomes), gains, color="#3b6ea5")
    axis.tick_params(axis="x", rotation=30)
    axis.axhline(100 * (planned_n / baseline_n - 1), color="#c0602b", label="as planned")
    axis.set(ylabel="gain of yield load, %", title="Plan carried out beside its place, modelled")
    figure.legend(loc="outside lower right")
    return figure


def robustness_figure(outcomes: Sequence[Outcome], baseline_n: float, planned_n: float) -> Figure:
    """Distributions of gain and clearance under errors of registration."""
    figure = Figure(figsize=(11, 4.5), layout="constrained")
    left, right = figure.subplots(1, 2)
    distance = [float(np.linalg.norm(outcome.offset_mm)) for outcome in outcomes]
    gains = [100 * (outcome.yield_load_n / baseline_n - 1) for outcome in outcomes]
    left.plot(distance, gains, "o", color="#3b6ea5")
    left.axhline(100 * (planned_n / baseline_n - 1), color="#c0602b", label="as planned")
    left.set(xlabel="error of the path, mm", ylabel="gain of yield load, %", title="Gain, modelled")
    low, high = left.get_ylim()
    wider = max(0.0, _LEAST_SPAN_POINTS - (high - low)) / 2
    left.set_ylim(low - wider, high + wider)
    left.legend()
    right.hist([outcome.clearance_mm for outcome in outcomes], bins=15, color="#3b6ea5")
    right.set(xlabel="clearance of the path to the surface, mm", ylabel="draws", title="Clearance")
    right.yaxis.set_major_locator(MaxNLocator(integer=True))
    return figure


def mesh_figure(meshes: Mapping[str, Sequence[MeshRow]]) -> Figure:
    """Of each femur: yield load without cement, and gain, over the size of the elements; time over their number."""
    figure = Figure(figsize=(14, 5), layout="constrained")
    left, middle, right = figure.subplots(1, 3)
    for name, rows in meshes.items():
        size = [row.size_mm for row in rows]
        left.plot(size, [row.baseline_n for row in rows], "o-", label=name)
        middle.plot(size, [100 * row.gain for row in rows], "o-")
        right.loglog([row.elements for row in rows], [row.seconds for row in rows], "o-")
    sizes = sorted({row.size_mm for rows in meshes.values() for row in rows})
    left.set(xlabel="elements, mm", ylabel="yield load without cement, N", xticks=sizes)
    middle.set(xlabel="elements, mm", ylabel="gain of the same cement, %", xticks=sizes)
    right.set(xlabel="elements", ylabel="processor time of one curve, s")
    for axis in (left, middle):
        axis.set_ylim(0, 1.08 * axis.get_ylim()[1])
    for axis in (right.xaxis, right.yaxis):
        axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
        axis.set_major_formatter(StrMethodFormatter("{x:.0f}"))
        axis.set_minor_locator(NullLocator())
    for axis in (left, middle, right):
        axis.grid(alpha=0.3)
    figure.legend(loc="outside lower center", ncols=len(meshes))
    figure.suptitle("Each femur with the same cement on finer meshes, modelled")
    return figure
