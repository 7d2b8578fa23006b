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
    from rich.markup import escape

    from femoreg_torch.case import RESULT_NAME, read_case, read_result
    from femoreg_torch.commands.telling import tell_verdict
    from femoreg_torch.errors import InputError
    from femoreg_torch.evaluation import error_tables, write_report

    if (case / RESULT_NAME).is_file() and not (case / "case.yaml").is_file() and (run / "case.yaml").is_file():
        raise InputError(f"{case}: is a run, and {run} is a case. Is the order `femoreg evaluate CASE RUN`?")
    console, result = Console(), read_result(run)
    with console.status("reading the case and drawing the report"):
        errors = write_report(read_case(case), result, run)
    if errors is None:
        console.print(f"{escape(str(case))} holds no truth, so there are no errors to tell.")
    else:
        for table in error_tables(errors):
            console.print(table)
    tell_verdict(console, result)
    console.print(f"Report: {escape(str(run / 'report.html'))}")
