"""The report of one registration: a single HTML file that needs nothing beside it."""

import base64
import math
from collections.abc import Iterable, Sequence
from html import escape
from typing import Any

import cv2

from femoreg_torch.case import Case, Result, Verdict
from femoreg_torch.evaluation.overlay import Picture
from femoreg_torch.evaluation.planning_section import planning_section
from femoreg_torch.evaluation.table import METRIC_COLUMNS, POSE_COLUMNS, metric_rows, pose_rows

_STYLE = """
body { font: 15px/1.5 system-ui, sans-serif; max-width: 72rem; margin: 2rem auto; padding: 0 1rem; color: #1c2430; }
h1 { font-size: 1.6rem; margin-bottom: 0; } h2 { font-size: 1.15rem; margin-top: 2rem; }
.notice { background: #fff4d6; border-left: 4px solid #d99a00; padding: .5rem .8rem; }
.bad { color: #b3261e; font-weight: 600; } .good { color: #1b7f3b; font-weight: 600; }
table { border-collapse: collapse; margin: .5rem 0; } th, td { padding: .2rem .7rem; text-align: right; }
th { border-bottom: 2px solid #8593a5; } td:first-child, th:first-child { text-align: left; }
tr.paper td { color: #6b7785; } tbody tr { border-bottom: 1px solid #e3e8ee; }
img { max-width: 100%; } figcaption { color: #4b5866; }
"""
_NOTICE = "Research software, not a medical device: its output must not guide the treatment of a patient."
_SIMULATED = "The images of this case are simulated, and so is the truth that the errors are measured against."
_MEASURED = "The truth that the errors are measured against was itself measured, by beads, and has an error of its own."


def _origin(case: Case) -> str:
    """Where a truth is from: only a simulation knows where the anchor is."""
    return _SIMULATED if case.truth is not None and case.anchor in case.truth.camera1_from else _MEASURED


def report_page(case: Case, result: Result, errors: dict[str, Any] | None, overlay: Picture) -> str:
    """The report of a registration as the text of one HTML file.

    `errors` are those against the truth, None if there is none; `overlay` is the picture of `overlay_figure`.
    """
    side = f"{case.side} side, " if case.side else ""
    parts = [
        f"<h1>Registration of {escape(case.folder.resolve().name)}</h1>",
        f"<p>{escape(side)}{len(case.views)} views, preset <b>{escape(result.preset)}</b>, seed {result.seed}</p>",
        f'<p class="notice">{_NOTICE}{" " + _origin(case) if case.truth is not None else ""}</p>',
        _verdict(result.verdict),
        _skipped(result.skipped),
    ]
    if errors is not None:
        parts += [
            "<h2>Errors</h2>",
            "<p>Of this one registration, absolute, along and about the axes of view 1. Beside them the means of the "
            "paper's 1,000 simulations (Tables I and II), made on another anatomy with another simulator.</p>",
            _table(METRIC_COLUMNS, metric_rows(errors)),
            _table(POSE_COLUMNS, pose_rows(errors)),
        ]
    parts += ["<h2>Overlays</h2>", _figure(overlay, case), "<h2>Result</h2>", _points(result)]
    parts.append(planning_section(case, result))
    parts += ["<h2>Quality</h2>", _QUALITY_NOTE, _table(_QUALITY_COLUMNS, _quality(result))]
    if result.cameras:
        parts += ["<h2>C-arm</h2>", _CAMERA_NOTE, _table(_CAMERA_COLUMNS, _cameras(result))]
    parts += ["<h2>Time</h2>", _table(("step", "s"), ([k, f"{v:.1f}"] for k, v in result.timings_s.items()))]
    parts += ["<h2>Versions</h2>", _table(("", ""), ([k, v] for k, v in result.versions.items()))]
    body = "\n".join(parts)
    title = f"FemoReg Torch: {escape(case.folder.resolve().name)}"
    head = f'<meta charset="utf-8"><title>{title}</title><style>{_STYLE}</style>'
    return f'<!doctype html>\n<html lang="en"><head>{head}</head><body>\n{body}\n</body></html>\n'


def _verdict(verdict: Verdict) -> str:
    return f'<p class="{"good" if verdict.trusted else "bad"}">{escape(verdict.sentence)}</p>'


def _skipped(skipped: Sequence[str]) -> str:
    if not skipped:
        return ""
    return "<p>What was left out:</p><ul>" + "".join(f"<li>{escape(note)}</li>" for note in skipped) + "</ul>"


def _table(columns: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    head = "".join(f"<th>{escape(column)}</th>" for column in columns)
    lines = []
    for row in rows:
        kind = ' class="paper"' if row[0].startswith("  ") else ""
        lines.append(f"<tr{kind}>" + "".join(f"<td>{escape(cell)}</td>" for cell in row) + "</tr>")
    return f"<table><thead><tr>{head}</tr></thead><tbody>{''.join(lines)}</tbody></table>"


def _figure(picture: Picture, case: Case) -> str:
    encoded, data = cv2.imencode(".png", picture)
    if not encoded:
        raise OSError("the overlay could not be encoded as PNG.")
    source = base64.b64encode(data.tobytes()).decode("ascii")
    caption = (
        "The views from left to right, a row for each kind of images, as on a monitor (bone dark). Green: edges of the "
        "objects, rendered at the estimated poses, in the first images that show them."
    )
    caption += " Red: landmarks of the CT." if case.landmarks else ""
    caption += " Magenta: planned path." if case.plan is not None else ""
    image = f'<img alt="overlays" src="data:image/png;base64,{source}">'
    return f"<figure>{image}<figcaption>{caption}</figcaption></figure>"


def _points(result: Result) -> str:
    rows = [
        [name.replace("_", " "), *(f"{value:.{digits}f}" for value in vector.tolist()), unit]
        for vectors, digits, unit in ((result.points_camera1, 2, "mm"), (result.directions_camera1, 4, ""))
        for name, vector in vectors.items()
    ]
    return "<p>In the camera frame of view 1.</p>" + _table(("", "x", "y", "z", ""), rows)


_QUALITY_NOTE = (
    "<p>Standard deviations are the largest along and about any axis. The pull is where all images together would move "
    "the object, were everything free. Similarity is mean patch Grad-NCC, at most 1; gain is what drawing the object "
    "adds to it, in the view where it adds least.</p>"
)
_QUALITY_COLUMNS = (
    "object",
    "trusted",
    "because",
    "deviation mm",
    "deviation °",
    "pull mm",
    "pull °",
    "similarity",
    "gain",
)


def _quality(result: Result) -> Iterable[list[str]]:
    """A row for every object."""
    for name, quality in result.quality.items():
        similarities = [view.similarity for view in quality.views]
        gains = [view.gain for view in quality.views]
        yield [
            name,
            "yes" if quality.trusted else "no",
            quality.reason,
            _number(max(quality.translation_deviation_mm, default=math.nan), 2),
            _number(max(quality.rotation_deviation_deg, default=math.nan), 2),
            _number(quality.common_pull[1], 2),
            _number(quality.common_pull[0], 2),
            _number(sum(similarities) / len(similarities) if similarities else math.nan, 3),
            _number(min(gains, default=math.nan), 3),
        ]


_CAMERA_NOTE = (
    "<p>Source distance and principal point were refined together with the poses, as far as the C-arm's file is "
    "uncertain of them; with standard deviations.</p>"
)
_CAMERA_COLUMNS = ("view", "source distance mm", "±", "column px", "±", "row px", "±")


def _cameras(result: Result) -> Iterable[list[str]]:
    """A row for every view."""
    for number, camera in enumerate(result.cameras, 1):
        column, row = camera.principal_point_px
        column_deviation, row_deviation = camera.principal_point_deviation_px
        values = (camera.sdd_mm, camera.sdd_deviation_mm, column, column_deviation, row, row_deviation)
        yield [str(number), *(_number(value, 1) for value in values)]


def _number(value: float, digits: int) -> str:
    return f"{value:.{digits}f}" if math.isfinite(value) else "unknown"
