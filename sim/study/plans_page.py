"""The section of `docs/planning.md` on what plans are worth, written by `python -m sim.study plans`."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from femoreg_torch.planning.convergence import MeshRow
from femoreg_torch.planning.figures import mesh_figure, save
from femoreg_torch.planning.offsets import directions
from femoreg_torch.statistics.formats import number, pipe_table
from sim.study.page import write_section
from sim.study.plans import LAWS, MESH_SIZES_MM, OFFSET_MM, VOLUME_ML, Measured, gain_percent, six_directions

PAGE, TITLE = "planning.md", "What was measured"
_LOAD_PERCENT, _GAIN_POINTS = 5.0, 3.0  # wanted of a mesh against the finest
_CADAVER = (2.64, 1.36)  # mean errors of entry point to tip, mm, and of the path, degrees (Gao et al. 2020, section IV)
_MEAN_OF_NORM = (1.596, 1.253)  # of three and of two independent normal numbers of deviation 1: 2 √(2 / π), √(π / 2)
# Gao et al. 2020, section IV-C: without cement, with the optimal pattern, with it 4 mm inferior.
_PAPER = ("paper: one specimen, another model", "1400", "–", "2005 (+43 %)", "–", "inferior: 1970 (+41 %)")
_FEMORA = """The procedural femur is computed, its grey values invented: spongy bone 0.45 and cortex 0.64 of a healthy
one's. The two others are real CTs of patients with a tumour of soft tissue nearby (theibsi/data_sets, CC BY 3.0), with
real grey values of 1 × 1 × 3.3 mm and bone that nobody called osteoporotic; they were scanned without a phantom, came
without labels, and were cut out by threshold, the head by a sphere placed by eye. The first two are calibrated
by air, fat and muscle with densities that are not confirmed; the third, where a tumour hides the peak of muscle, is not
calibrated at all."""
_LAWS_TOLD = """Beside them: femora of 54 donors of 79 ± 11 years, tested in a fall on the trochanter, failed at 3951 ±
1659 N (doi 10.1359/JBMR.0301247, abstract). Fracture loads in stance and in a fall go together (r = 0.901, 17 pairs;
abstract at wbldb.lievers.net/10200690.html). No source with a mean load in stance could be read, so the loads in stance
stand without a comparison. Yield comes before failure."""
_COMPARABLE = """The paper's row is one osteoporotic specimen under a model whose mesh, materials and supports were
not published. **Compare** the order of the gain, and what 4 mm cost in points. **Do not compare** loads in N with it:
these are other bones, and supports alone move a load by a factor of two. Between the other rows settings are equal, so
their loads may be compared as far as their calibration may.
*Generic* is a third of the cement at each quarter of the neck's axis, up to the head's centre."""


def plans_text(all_found: Sequence[Measured], command: str, figure: str) -> str:
    """The section: what was run, the table, its directions, cost, meshes."""
    text = [
        f"By `{command}`: models, no test of bones, with {VOLUME_ML:g} ml and the default settings. What was not "
        "run is shown as –.",
        _FEMORA,
        _loads(all_found),
        _COMPARABLE,
        f"Gain with the path {OFFSET_MM:g} mm beside, cement spread anew; directions are those of the patient as "
        "scanned, and the real legs are bent by 33 to 37°:",
        pipe_table(
            ("femur", *directions("left")),
            [[f.subject.title, *(_points(gain_percent(f, name)) for name in directions("left"))] for f in all_found],
        ),
        _laws(all_found),
        _errors(all_found),
        _costs(all_found),
        _meshes(all_found, figure),
    ]
    return "\n\n".join(part for part in text if part)


def write_plans(all_found: Sequence[Measured], command: str, docs: Path) -> str:
    """Put the section into `docs/planning.md`, with its figure; returns the section."""
    figure = "planning_mesh.png"
    meshes = {found.subject.title: found.meshes for found in _compared(all_found)}
    text = plans_text(all_found, command, figure)
    if meshes:
        save(mesh_figure(meshes), docs / figure)
    write_section(docs, TITLE, text, PAGE)
    return text


def _loads(all_found: Sequence[Measured]) -> str:
    rows = []
    for found in all_found:
        bare = found.plan["baseline"]["yield_load_n"]
        free = found.plan["optimum"]["yield_load_n"]
        moved = six_directions(found)
        beside = "–" if moved[0] != moved[0] else f"{_points(moved.min())} to {_points(moved.max())}"
        generic = gain_percent(found, "generic")
        planned = found.plan["planned"]["yield_load_n"]
        cells = [_load(bare, load) for load in (bare * (1 + generic / 100), planned, free)]
        rows.append([found.subject.title, f"{bare:.0f}", *cells, beside])
    header = ("femur", "bare, N", "generic, N", "planned, N", "free optimum, N", f"{OFFSET_MM:g} mm beside")
    return pipe_table(header, [*rows, list(_PAPER)])


def _load(bare: float, load: float) -> str:
    return "–" if load != load else f"{load:.0f} ({_points(100 * (load / bare - 1))})"


def _points(gain: float) -> str:
    return "–" if gain != gain else f"{gain:+.0f} %"


def _laws(all_found: Sequence[Measured]) -> str:
    names = [f"{kind} {law}" for kind, law in LAWS]
    rows = [
        [
            found.subject.title,
            *(f"{found.laws[name]['yield_load_n']:.0f}" if name in found.laws else "–" for name in names),
        ]
        for found in all_found
        if found.laws
    ]
    if not rows:
        return ""
    header = ("bare, N", *(f"{kind}, {law.capitalize()}" for kind, law in LAWS))
    return f"Other loads and the other law of bone, without cement:\n\n{pipe_table(header, rows)}\n\n{_LAWS_TOLD}"


def _errors(all_found: Sequence[Measured]) -> str:
    """Gains under the errors of registrations: of the toolkit's study, and as large as the paper's on cadavers."""
    drawn = [
        f"**Registration errors**, {found.subject.title}: {len(found.draws['outcomes']['draws'])} draws from the "
        f"{found.draws['study_runs']} trusted runs of [60 of the paper's procedures](results/README.md), each after "
        "the correction that it tells, cement anew: "
        f"gain {found.draws['gain_percent_median']:.1f} % (5 to 95 %: {found.draws['gain_percent_p5']:.1f} to "
        f"{found.draws['gain_percent_p95']:.1f} %), as planned {found.draws['planned_gain_percent']:.1f} %."
        for found in all_found
        if found.draws
    ]
    sigma = np.repeat([mean / norm for mean, norm in zip(_CADAVER, _MEAN_OF_NORM, strict=True)], 3)
    quoted = []
    for found in all_found:
        if found.response is not None:
            q = found.response.under(np.diag(sigma**2))
            quoted.append(f"{found.subject.title} {q.gain_percent:.0f} ± {q.deviation_percent:.0f} %")
    if quoted:
        drawn.append(
            f"With errors as large as the paper measured on cadavers ({_CADAVER[0]:g} mm and {_CADAVER[1]:g}° in the "
            f"mean; taken as normal and alike along all axes), by the plans' quadratics: {'; '.join(quoted)}."
        )
    return "\n\n".join(drawn)


def _costs(all_found: Sequence[Measured]) -> str:
    rows = [
        [
            found.subject.title,
            f"{found.plan['elements']}",
            number(found.cost["processor_s"], 0),
            number(found.cost["wall_s"], 0),
            number(found.cost["peak_gb"], 1),
        ]
        for found in all_found
        if found.cost
    ]
    if not rows:
        return ""
    header = ("`femoreg plan` as a command", "elements", "processor time, s", "wall time, s", "memory, GB")
    cores = all_found[0].cost.get("cores", "?")
    told = f"The whole plan, one thread, on {cores} cores that other work shared (idle ones take less):"
    return f"{told}\n\n{pipe_table(header, rows)}"


def _compared(all_found: Sequence[Measured]) -> list[Measured]:
    return [found for found in all_found if len(found.meshes) > 1]


def _meshes(all_found: Sequence[Measured], figure: str) -> str:
    compared = _compared(all_found)
    if not compared:
        return ""
    rows = [
        [
            found.subject.title,
            f"{row.size_mm:g} mm",
            f"{row.elements}",
            f"{row.baseline_n:.0f}",
            f"{_load_percent(row, found):+.1f} %",
            f"{100 * row.gain:+.1f} %",
            f"{_gain_points(row, found):+.1f}",
            f"{row.seconds:.0f}",
        ]
        for found in compared
        for row in found.meshes
    ]
    header = (
        *("femur", "elements", "number", "bare, N", "against finest", "gain", "points"),
        "processor time of a curve to its yield, s",
    )
    told = f"**Meshes**, the planned cement. Wanted: {_LOAD_PERCENT:g} % of the load and {_GAIN_POINTS:g} points of the"
    return "\n\n".join(
        [
            f"{told} gain, against the finest.",
            pipe_table(header, rows),
            "\n".join(f"- {found.subject.title}: {_verdict(found)}" for found in compared),
            f"![Load, gain and time over the mesh]({figure})",
        ]
    )


def _load_percent(row: MeshRow, found: Measured) -> float:
    return 100 * (row.baseline_n / found.meshes[-1].baseline_n - 1)


def _gain_points(row: MeshRow, found: Measured) -> float:
    return 100 * (row.gain - found.meshes[-1].gain)


def _verdict(found: Measured) -> str:
    kept = [
        row
        for row in found.meshes
        if abs(_load_percent(row, found)) <= _LOAD_PERCENT and abs(_gain_points(row, found)) <= _GAIN_POINTS
    ]
    told = ", ".join(f"{row.size_mm:g} mm" for row in kept)
    off = "".join(
        f" **{row.size_mm:g} mm is not**: {_load_percent(row, found):+.1f} % of the load, "
        f"{_gain_points(row, found):+.1f} points of the gain."
        for row in found.meshes
        if row not in kept
    )
    missing = [f"{size:g} mm" for size in MESH_SIZES_MM if size not in {row.size_mm for row in found.meshes}]
    not_run = f" Not run: {', '.join(missing)}." if missing else ""
    return f"within both of the finest ({found.meshes[-1].size_mm:g} mm): {told}.{off}{not_run}"
