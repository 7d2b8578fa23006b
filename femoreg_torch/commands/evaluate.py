"""`femoreg evaluate CASE RUN`: errors of a registration, overlays and a report."""

from pathlib import Path


def evaluate(case: Path, run: Path) -> None:
    """Measure a registration against the truth of its case and write errors.json, overlay.png and report.html.

    Without a truth the report holds overlays and qualities only.

    Args:
        case: Case folder.
        run: Folder that `femoreg register` wrote; the files are added to it.
    """
    from rich.console import Console

    from femoreg_torch.case import read_case, read_result
    from femoreg_torch.evaluation import error_tables, evaluate_run

    console = Console()
    errors = evaluate_run(read_case(case), read_result(run), run)
    if errors is None:
        console.print(f"{case} holds no truth, so there are no errors to tell.")
    else:
        for table in error_tables(errors):
            console.print(table)
    console.print(f"Report: {run / 'report.html'}")
