"""The section of a registration's report on the cement plan that its path is from."""

import base64

from femoreg_torch.evaluation.report.parts import Material, Section, Table
from femoreg_torch.files import read_json
from femoreg_torch.planning.quote import quoted_gain, response_of

# Pictures beside a plan.json, and what is written below them.
FIGURES = (("overlay.png", "Cement, free optimum and path in three planes."), ("curves.png", "Modelled loads."))
_LOADS = ("femur", "modelled yield load, N", "gain")
_INJECTIONS = ("depth from the entry point, mm", "semi-axis along, mm", "semi-axis across, mm", "ml", "minutes")


def planning(material: Material) -> Section | None:
    """Path, injections, modelled gain, what the registration's uncertainty leaves of it, and the plan's figures.

    None if the case's path is not from a plan of `femoreg plan`. Raises `InputError` for a plan that cannot be read.
    """
    case = material.case
    if case.plan is None or case.plan.file is None:
        return None
    content = read_json(case.plan.file)
    quoted = quoted_gain(response_of(case), material.result)
    paragraphs = [] if quoted is None else [quoted.sentence]
    if "length_mm" in content:
        clear = content.get("clearances", {}).get("cortex_mm")
        told = "" if clear is None else f", {clear:.1f} mm to the surface where it is nearest"
        paragraphs.append(f"Path of {content['length_mm']:.1f} mm{told}.")
    paragraphs += [str(content["notice"])] if "notice" in content else []
    loads = [(name, content[name]) for name in ("baseline", "planned", "optimum") if name in content]
    rows = [[name, f"{value['yield_load_n']:.0f}", _percent(value.get("gain"))] for name, value in loads]
    injections = [
        [f"{entry[key]:.1f}" for key in ("depth_mm", "along_mm", "across_mm", "volume_ml", "minutes")]
        for entry in content.get("injections", [])
    ]
    tables = [Table(_LOADS, rows, "Modelled loads"), Table(_INJECTIONS, injections, "Injections, from deep to shallow")]
    files = [(case.plan.file.parent / name, caption) for name, caption in FIGURES]
    figures = [
        {"png": base64.b64encode(file.read_bytes()).decode("ascii"), "caption": caption}
        for file, caption in files
        if file.is_file()
    ]
    tables = [table for table in tables if table.rows]
    return Section("planning", "Planning", paragraphs, tables, "planning.html", {"figures": figures})


def _percent(gain: float | None) -> str:
    return "" if gain is None else f"{100 * gain:+.0f} %"
