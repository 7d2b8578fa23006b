"""The section of a registration's report on the cement plan that its path is from."""

import base64
from collections.abc import Sequence
from html import escape
from pathlib import Path

from femoreg_torch.case import Case, Result
from femoreg_torch.files import read_json
from femoreg_torch.planning.quote import quoted_gain, response_of

_FIGURES = (("overlay.png", "Cement, free optimum and path in three planes."), ("curves.png", "Modelled loads."))


def planning_section(case: Case, result: Result) -> str:
    """HTML: path, injections, modelled gain, what the registration's uncertainty leaves of it, and the plan's figures.

    Empty if the case's path is not from a plan of `femoreg plan`. Raises `InputError` for a plan that cannot be read.
    """
    if case.plan is None or case.plan.file is None:
        return ""
    file = case.plan.file
    content = read_json(file)
    parts = ["<h2>Planning</h2>", f"<p>{escape(str(content.get('notice', '')))}</p>"]
    loads = [(name, content[name]) for name in ("baseline", "planned", "optimum") if name in content]
    rows = [(name, f"{value['yield_load_n']:.0f}", _percent(value.get("gain"))) for name, value in loads]
    parts.append(_table(("femur", "modelled yield load, N", "gain"), rows))
    quoted = quoted_gain(response_of(case), result)
    if quoted is not None:
        parts.append(f"<p><b>{escape(quoted.sentence)}</b></p>")
    if "length_mm" in content:
        clear = content.get("clearances", {}).get("cortex_mm")
        told = "" if clear is None else f", {clear:.1f} mm to the surface where it is nearest"
        parts.append(f"<p>Path of {content['length_mm']:.1f} mm{told}. Injections from deep to shallow:</p>")
    injections = [
        [f"{entry[key]:.1f}" for key in ("depth_mm", "along_mm", "across_mm", "volume_ml", "minutes")]
        for entry in content.get("injections", [])
    ]
    head = ("depth from the entry point, mm", "semi-axis along, mm", "semi-axis across, mm", "ml", "minutes")
    parts.append(_table(head, injections))
    parts += [_figure(file.parent / name, caption) for name, caption in _FIGURES if (file.parent / name).is_file()]
    return "\n".join(parts)


def _percent(gain: float | None) -> str:
    return "" if gain is None else f"{100 * gain:+.0f} %"


def _table(columns: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    head = "".join(f"<th>{escape(column)}</th>" for column in columns)
    lines = ["<tr>" + "".join(f"<td>{escape(cell)}</td>" for cell in row) + "</tr>" for row in rows]
    return f"<table><thead><tr>{head}</tr></thead><tbody>{''.join(lines)}</tbody></table>"


def _figure(file: Path, caption: str) -> str:
    source = base64.b64encode(file.read_bytes()).decode("ascii")
    image = f'<img alt="{escape(caption)}" src="data:image/png;base64,{source}">'
    return f"<figure>{image}<figcaption>{escape(caption)}</figcaption></figure>"
