"""The report of one registration: a single HTML file that needs nothing beside it."""

import base64
from collections.abc import Iterable, Sequence
from html import escape
from pathlib import Path
from typing import Any

import cv2

from femoreg_torch.case import Case
from femoreg_torch.evaluation.overlay import Picture
from femoreg_torch.evaluation.table import METRIC_COLUMNS, POSE_COLUMNS, metric_rows, pose_rows
from femoreg_torch.files import write_text

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


def write_report(
    path: Path, case: Case, result: dict[str, Any], errors: dict[str, Any] | None, overlay: Picture
) -> None:
    """Write the report of a registration as one HTML file, whole or not at all.

    `result` is what `read_result` gives; `errors` are those against the truth, None if there is none; `overlay` is the
    picture of `overlay_figure`.
    """
    parts = [
        f"<h1>Registration of {escape(case.folder.resolve().name)}</h1>",
        f"<p>{escape(case.side)} hip, {len(case.views)} views, preset <b>{escape(str(result.get('preset')))}</b>, "
        f"seed {escape(str(result.get('seed')))}</p>",
        f'<p class="notice">{_NOTICE}{" " + _SIMULATED if case.truth is not None else ""}</p>',
        _verdict(result),
    ]
    if errors is not None:
        parts += [
            "<h2>Errors</h2>",
            "<p>Of this one registration, absolute, along and about the axes of view 1. Beside them the means of the "
            "paper's 1,000 simulations (Tables I and II), made on another anatomy with another simulator.</p>",
            _table(METRIC_COLUMNS, metric_rows(errors)),
            _table(POSE_COLUMNS, pose_rows(errors)),
        ]
    parts += ["<h2>Overlays</h2>", _figure(overlay), "<h2>Result</h2>", _points(result)]
    parts += ["<h2>Quality</h2>", _table(*_quality(result.get("quality", {})))]
    parts += ["<h2>Time</h2>", _table(("step", "s"), ([k, f"{v:.1f}"] for k, v in result.get("timings_s", {}).items()))]
    parts += ["<h2>Versions</h2>", _table(("", ""), ([k, str(v)] for k, v in result.get("versions", {}).items()))]
    body = "\n".join(parts)
    title = f"FemoReg Torch: {escape(case.folder.resolve().name)}"
    head = f'<meta charset="utf-8"><title>{title}</title><style>{_STYLE}</style>'
    write_text(path, f'<!doctype html>\n<html lang="en"><head>{head}</head><body>\n{body}\n</body></html>\n')


def _verdict(result: dict[str, Any]) -> str:
    doubts = [
        f"{name}: {value.get('reason', 'no reason given')}"
        for name, value in result.get("quality", {}).items()
        if isinstance(value, dict) and value.get("trusted") is False
    ]
    if doubts:
        return f'<p class="bad">Not to be trusted. {escape("; ".join(doubts))}</p>'
    return '<p class="good">No check of the registration failed.</p>'


def _table(columns: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    head = "".join(f"<th>{escape(column)}</th>" for column in columns)
    lines = []
    for row in rows:
        kind = ' class="paper"' if row[0].startswith("  ") else ""
        lines.append(f"<tr{kind}>" + "".join(f"<td>{escape(cell)}</td>" for cell in row) + "</tr>")
    return f"<table><thead><tr>{head}</tr></thead><tbody>{''.join(lines)}</tbody></table>"


def _figure(picture: Picture) -> str:
    encoded, data = cv2.imencode(".png", picture)
    if not encoded:
        raise OSError("the overlay could not be encoded as PNG.")
    source = base64.b64encode(data.tobytes()).decode("ascii")
    caption = (
        "The views from left to right, without and with the device, as on a monitor (bone dark, the patient's left on "
        "the right). Green: edges of the rendered bones and of the device at the estimated poses. Red: landmarks of "
        "the CT. Magenta: planned path."
    )
    image = f'<img alt="overlays" src="data:image/png;base64,{source}">'
    return f"<figure>{image}<figcaption>{caption}</figcaption></figure>"


def _points(result: dict[str, Any]) -> str:
    rows = [
        [name.replace("_", " "), *(f"{value:.{digits}f}" for value in vector.tolist()), unit]
        for key, digits, unit in (("points_camera1", 2, "mm"), ("directions_camera1", 4, ""))
        for name, vector in result.get(key, {}).items()
    ]
    return "<p>In the camera frame of view 1.</p>" + _table(("", "x", "y", "z", ""), rows)


def _quality(quality: dict[str, Any]) -> tuple[list[str], list[list[str]]]:
    """Columns and rows of whatever the registration says of each object's quality."""
    columns = list(dict.fromkeys(key for value in quality.values() for key in value))
    rows = [[name, *(_short(value.get(key)) for key in columns)] for name, value in quality.items()]
    return ["object", *(key.replace("_", " ") for key in columns)], rows


def _short(value: Any) -> str:
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        return f"{value:.3g}"
    if isinstance(value, list):
        return ", ".join(_short(v) for v in value)
    if isinstance(value, dict):
        return ", ".join(f"{k} {_short(v)}" for k, v in value.items())
    return "" if value is None else str(value)
