"""One table, and its ways to be written: Markdown, CSV, LaTeX, HTML, and for the terminal."""

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path
from typing import Literal

import pandas as pd
from rich import box
from rich.markup import escape as escape_markup
from rich.table import Table as RichTable

from femoreg_torch.files import write_text

PAPER = "paper"  # cells of the first two columns that start so make a row of the paper's values


@dataclass(frozen=True)
class Table:
    """Cells as they are read, and the numbers behind them, a row of `data` per number or per row of cells."""

    name: str  # of its files
    title: str
    note: str  # what has to be known to read it
    columns: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    data: pd.DataFrame

    @property
    def texts(self) -> int:
        """How many of the first columns hold text, to be aligned left."""
        return 2 if len(self.columns) > 1 and self.columns[1] == "" else 1


def of_paper(row: Sequence[str]) -> bool:
    """Whether a row holds the paper's values."""
    return any(cell.startswith(PAPER) for cell in row[:2])


def number(value: float, digits: int, sign: Literal["+", "-"] = "-") -> str:
    """A number for a cell: – if it is not known, ∞ if it is infinite. `sign` + tells that of positive numbers too."""
    if math.isnan(value):
        return "–"
    return f"{value:{sign}.{digits}f}".replace("-", "−") if math.isfinite(value) else "∞"


def between(interval: tuple[float, float], digits: int) -> str:
    """An interval for a cell."""
    return "–" if math.isnan(interval[0]) else f"{number(interval[0], digits)} to {number(interval[1], digits)}"


def plus_minus(mean: float, deviation: float, digits: int) -> str:
    """Mean ± standard deviation for a cell; the mean alone where there is no deviation."""
    if math.isnan(deviation):
        return number(mean, digits)
    return f"{number(mean, digits)} ± {number(deviation, digits)}"


def percent(share: float) -> str:
    """A share for a cell."""
    return "–" if math.isnan(share) else f"{100 * share:.1f} %"


def pipe_table(columns: Sequence[str], rows: Iterable[Sequence[str]], texts: int = 1) -> str:
    """The lines of a Markdown table, its first `texts` columns to the left, all others to the right."""
    lines = [columns, ["---" if n < texts else "---:" for n in range(len(columns))]]
    cells = [[cell.replace("|", "\\|") for cell in line] for line in (*lines, *rows)]
    return "\n".join(f"| {' | '.join(line)} |" for line in cells)


def markdown(table: Table) -> str:
    """As a Markdown table, with title and note."""
    body = pipe_table(table.columns, table.rows, table.texts)
    return "\n\n".join(part for part in (f"**{table.title}**", body, table.note) if part) + "\n"


_LATEX = {
    "\\": r"\textbackslash{}",
    **{sign: f"\\{sign}" for sign in "&%$#_{}"},
    "~": r"\textasciitilde{}",
    "^": r"\textasciicircum{}",
    "±": r"$\pm$",
    "°": r"$^\circ$",
    "≤": r"$\leq$",
    "∞": r"$\infty$",
    "σ": r"$\sigma$",
    "ρ": r"$\rho$",
    "²": "$^2$",
    "–": "--",
    "−": "$-$",
    "×": r"$\times$",
}


def latex(table: Table) -> str:
    """As a LaTeX table; it needs the package booktabs."""

    def line(cells: Sequence[str]) -> str:
        return " & ".join("".join(_LATEX.get(sign, sign) for sign in cell) for cell in cells) + r" \\"

    letters = "l" * table.texts + "r" * (len(table.columns) - table.texts)
    caption = line([" ".join(part for part in (table.title + ".", table.note) if part)]).removesuffix(r" \\")
    return "\n".join(
        [
            r"\begin{table}",
            rf"\caption{{{caption}}}",
            rf"\begin{{tabular}}{{{letters}}}",
            r"\toprule",
            line(table.columns),
            r"\midrule",
            *map(line, table.rows),
            r"\bottomrule",
            r"\end{tabular}",
            r"\end{table}",
            "",
        ]
    )


def csv(table: Table) -> str:
    """The numbers behind the table, not rounded."""
    return str(table.data.to_csv(index=False, lineterminator="\n"))


def html(table: Table) -> str:
    """As an HTML figure that scrolls by itself where a screen is narrow."""
    head = "".join(f"<th>{escape(column)}</th>" for column in table.columns)
    lines = []
    for row in table.rows:
        kind = ' class="paper"' if of_paper(row) else ""
        cells = (f"<td{' class=text' if n < table.texts else ''}>{escape(cell)}</td>" for n, cell in enumerate(row))
        lines.append(f"<tr{kind}>{''.join(cells)}</tr>")
    body = f"<table><thead><tr>{head}</tr></thead><tbody>{''.join(lines)}</tbody></table>"
    note = f'<p class="note">{escape(table.note)}</p>' if table.note else ""
    return f'<h3>{escape(table.title)}</h3><div class="wide">{body}</div>{note}'


_WORD = 18  # letters


def for_terminal(table: Table) -> RichTable:
    """For a rich console."""
    shown = RichTable(
        title=escape_markup(table.title),
        caption=escape_markup(table.note),
        title_justify="left",
        caption_justify="left",
        box=box.SIMPLE_HEAD,
        padding=(0, 1, 0, 0),
    )
    for place, column in enumerate(table.columns):
        side: Literal["left", "right"] = "left" if place < table.texts else "right"
        words = [word for row in table.rows for word in row[place].split()]
        longest = max(map(len, words), default=0)  # so that no number and no name is ever broken or cut
        shown.add_column(escape_markup(column), justify=side, overflow="fold", min_width=min(longest, _WORD))
    for row in table.rows:
        shown.add_row(*map(escape_markup, row), style="dim" if of_paper(row) else "")
    return shown


_FORMATS: dict[str, Callable[[Table], str]] = {"md": markdown, "csv": csv, "tex": latex}


def write_tables(tables: Sequence[Table], folder: Path) -> None:
    """Write every table as NAME.md, NAME.csv and NAME.tex into an existing folder."""
    for table in tables:
        for suffix, written in _FORMATS.items():
            write_text(folder / f"{table.name}.{suffix}", written(table))
