"""What a folder with the runs of a study is turned into: folders of tables and of figures."""

from collections.abc import Callable, Sequence
from pathlib import Path

import pandas as pd

from femoreg_torch.errors import InputError
from femoreg_torch.files import new_folder
from femoreg_torch.statistics.beside import beside_tables
from femoreg_torch.statistics.figures import Picture, all_figures, paper_figures, write_figures
from femoreg_torch.statistics.formats import Table, write_tables
from femoreg_torch.statistics.limit_tables import limit_tables, read_bounds
from femoreg_torch.statistics.rows import ROWS_NAME, TRIALS_NAME, folder_name, groups, read_rows
from femoreg_torch.statistics.tables import group_tables, overview_table
from femoreg_torch.statistics.trials import trial_table

TABLES, FIGURES = "tables", "figures"
Progress = Callable[[str, float], None]  # is told what is done, and the share of the work behind it


def read_study(folder: Path) -> pd.DataFrame:
    """The runs in a study's folder. Raises `InputError` if there are none to be read."""
    return read_rows(folder / ROWS_NAME)


def study_tables(rows: pd.DataFrame, seed: int, bounds: pd.DataFrame | None = None) -> dict[str, list[Table]]:
    """The tables of every group of runs by its name, the overview under none; `bounds` as `read_bounds` has them."""
    found = {"": [overview_table(rows)]}
    for name, part in groups(rows).items():
        found[name] = group_tables(part, seed) + ([] if bounds is None else limit_tables(part, bounds))
    return found


def trials(folder: Path) -> list[Table]:
    """The table of the trials in a study's folder, if there are any."""
    path = folder / TRIALS_NAME
    return [trial_table(read_rows(path))] if path.is_file() else []


def compared(folder: Path, beside: Path, seed: int) -> list[Table]:
    """Tables that put the study in `folder` beside another. Raises `InputError` if both are one."""
    if folder.resolve() == beside.resolve():
        raise InputError(f"--beside {beside}: is the study itself. Give the folder of another one.")
    here, there = folder.resolve().name, beside.resolve().name
    names = (here, there) if here != there else (folder.as_posix(), beside.as_posix())
    return beside_tables(read_study(folder), read_study(beside), names, seed)


def write_study_tables(folder: Path, tables: dict[str, Sequence[Table]]) -> None:
    """Write tables into FOLDER/tables, those of a group into a folder of its name; what was there goes."""
    with new_folder(folder / TABLES, without=_entries(folder / TABLES)) as out:
        for name, own in tables.items():
            write_tables(own, _subfolder(out, name))


def write_study_figures(rows: pd.DataFrame, folder: Path, report: Progress) -> dict[str, list[Picture]]:
    """Draw figures into FOLDER/figures/GROUP, all of the first group of runs, the paper's of the others.

    What was there goes. Returns them by group.
    """
    parts, bounds = groups(rows), read_bounds(folder)
    pictures: dict[str, list[Picture]] = {}
    with new_folder(folder / FIGURES, without=_entries(folder / FIGURES)) as out:
        for place, (name, part) in enumerate(parts.items()):
            report(f"figures of {name}", place / len(parts))
            plots = (paper_figures if pictures else all_figures)(part, bounds)
            pictures[name] = write_figures(plots, _subfolder(out, name))
    return pictures


def _subfolder(out: Path, name: str) -> Path:
    folder = out / folder_name(name) if name else out
    folder.mkdir(exist_ok=True)
    return folder


def _entries(folder: Path) -> list[str]:
    return [entry.name for entry in folder.iterdir()] if folder.is_dir() else []
