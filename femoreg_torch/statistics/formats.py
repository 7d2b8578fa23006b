"""One table, and its ways to be written: Markdown, CSV, LaTeX, HTML, and for the terminal."""

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path
from typing import Literal

import pandas as pd
from rich import box
from rich.console import Group
from rich.markup import escape as escape_markup
from rich.table import Table as RichTable
from rich.text import Text

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
    return f"{value:{sign}z.{digits}f}".replace("-", "−") if math.isfinite(value) else "∞"


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
_BETWEEN, _EDGES = 2, 2  # letters that rich puts between two columns, and around all


def for_terminal(table: Table, width: int) -> Group:
    """For a rich console of so many letters, in parts below one another where its columns do not fit side by side.

    Rich would cut off what does not fit: half a number is a wrong one.
    """
    texts = tuple(range(table.texts))
    least = [_least_width(table, place) + _BETWEEN for place in range(len(table.columns))]
    parts: list[tuple[int, ...]] = [texts]
    for place in range(table.texts, len(table.columns)):
        if parts[-1] != texts and _EDGES + sum(least[n] for n in (*parts[-1], place)) > width:
            parts.append(texts)
        parts[-1] = (*parts[-1], place)
    shown = (_part(table, part, width, table.title if n == 0 else None) for n, part in enumerate(parts))
    return Group(*shown, *([Text(table.note, style="italic dim")] if table.note else []))


def _least_width(table: Table, place: int) -> int:
    """Letters that a column needs so that no number and no name in it is broken or cut; intervals stay on one line."""
    cells = [row[place] for row in table.rows]
    words = [word for text in (table.columns[place], *cells) for word in text.split()]
    whole = words if place < table.texts else [*words, *cells]
    return min(max(map(len, whole), default=0), _WORD)


def _part(table: Table, places: Sequence[int], width: int, title: str | None) -> RichTable:
    """Some columns of a table.

    Each column has what it needs, and as much more as it can use and there is. Rich would take from the widest alone.
    """
    shown = RichTable(
        title=None if title is None else escape_markup(title),
        title_justify="left",
        box=box.SIMPLE_HEAD,
        padding=(0, 1, 0, 0),
    )
    least = {place: _least_width(table, place) for place in places}
    left = max(0, width - _EDGES - sum(_BETWEEN + letters for letters in least.values()))
    for place in places:
        side: Literal["left", "right"] = "left" if place < table.texts else "right"
        whole = max(len(cell) for cell in (table.columns[place], *(row[place] for row in table.rows)))
        more = min(left, whole - least[place])
        left -= more
        shown.add_column(escape_markup(table.columns[place]), justify=side, overflow="fold", width=least[place] + more)
    for row in table.rows:
        shown.add_row(*(escape_markup(row[place]) for place in places), style="dim" if of_paper(row) else "")
    return shown


_FORMATS: dict[str, Callable[[Table], str]] = {"md": markdown, "csv": csv, "tex": latex}


def write_tables(tables: Sequence[Table], folder: Path) -> None:
    """Write every table as NAME.md, NAME.csv and NAME.tex into an existing folder."""
    for table in tables:
        for suffix, written in _FORMATS.items():
            write_text(folder / f"{table.name}.{suffix}", written(table))
