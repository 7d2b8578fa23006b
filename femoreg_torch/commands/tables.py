"""`femoreg tables STUDY`: what a study says, as tables."""

from pathlib import Path


def tables(study: Path, *, beside: Path | None = None, seed: int = 0) -> None:
    """Print the tables of a study and write them to STUDY/tables as Markdown, CSV and LaTeX.

    The paper's Tables I and II beside its values, errors with intervals, success, trust, coverage of the stated
    deviations, what errors depend on and where they come from: for all runs, and for each condition in a folder of its
    own. Where STUDY holds trials.parquet, the paper's Table III of its trials; where it holds bounds.parquet, how far
    errors are from what images allow. What STUDY/tables held is replaced.

    Args:
        study: Folder with the runs of a study, runs.parquet.
        beside: Folder of another study, to be put side by side; by procedures if both hold the same.
        seed: Of the bootstrap.
    """
    from rich.console import Console

    from femoreg_torch.statistics.formats import for_terminal
    from femoreg_torch.statistics.limit_tables import read_bounds
    from femoreg_torch.statistics.rows import ROWS_NAME
    from femoreg_torch.statistics.study import (
        TABLES,
        compared,
        read_study,
        study_tables,
        trials,
        write_study_tables,
    )

    of_trials = trials(study)
    found = {}
    if (study / ROWS_NAME).is_file() or not of_trials:
        found = study_tables(read_study(study), seed, read_bounds(study))
    common = [*found.get("", ()), *of_trials, *([] if beside is None else compared(study, beside, seed))]
    write_study_tables(study, found | {"": common})
    console = Console()
    shown = next((own for name, own in found.items() if name), [])
    for table in (*common, *shown):
        console.print(for_terminal(table, console.width))
    conditions = len(found) - 2
    if conditions > 1:
        console.print(f"These are of all runs; the tables of {conditions} conditions are in the files.", style="dim")
    console.print(f"Tables: {study / TABLES}", markup=False, highlight=False, soft_wrap=True)
