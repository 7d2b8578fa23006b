"""The section of `docs/limits.md` that tells a study's errors beside their bounds: tables, and a figure."""

from pathlib import Path

import pandas as pd
from matplotlib import rc_context

from femoreg_torch.errors import InputError
from femoreg_torch.files import temporary_file
from femoreg_torch.statistics.figures import write_figures
from femoreg_torch.statistics.figures.limits import limits
from femoreg_torch.statistics.figures.style import STYLE
from femoreg_torch.statistics.formats import pipe_table
from femoreg_torch.statistics.limit_tables import limit_tables
from sim.study.page import machine, write_section

PAGE, TITLE = "limits.md", "Measured"


def write_limits(rows: pd.DataFrame, bounds: pd.DataFrame, command: str, out: Path, docs: Path) -> str:
    """Put the tables and the figure of the runs of one condition into `docs`; the figure into `out`, too.

    Returns the section. Raises `InputError` where no bound is one of these runs.
    """
    tables = limit_tables(rows, bounds)
    with rc_context(STYLE):
        plot = limits(rows, bounds)
    if plot is None:
        raise InputError(f"{out}: holds no bounds of these runs.")
    (picture,) = write_figures([plot], out)
    parts = [f"`{command}`, on simulated procedures. Measured on: {machine()}"]
    for table in tables:
        parts += [f"### {table.title}", table.note, pipe_table(table.columns, table.rows, table.texts)]
    parts.append(f"![{plot.title}]({plot.name}.png)")
    text = "\n\n".join(parts)
    write_section(docs, TITLE, text, PAGE)
    with temporary_file(docs / f"{plot.name}.png") as part:
        part.write_bytes(picture.png)
    return text
