"""`femoreg report STUDY`: what a study says, as one page."""

from pathlib import Path


def report(study: Path, *, seed: int = 0) -> None:
    """Write STUDY/report.html, one page with tables, figures, worst cases and every run that is not trusted.

    The page needs no network and no other file. Its tables are written to STUDY/tables too (see `femoreg tables`), its
    figures to STUDY/figures as PNG and SVG in the sizes of a journal; what these folders held before is replaced. Where
    there is a picture STUDY/overlays/NAME.jpg of one of the worst runs, the page shows it.

    Args:
        study: Folder with the runs of a study, runs.parquet.
        seed: Of the bootstrap.
    """
    from rich.console import Console

    from femoreg_torch.commands.telling import progress_report
    from femoreg_torch.statistics.report import REPORT_NAME, write_report

    console = Console()
    with progress_report(console, "reading") as progress:
        write_report(study, seed, progress)
    console.print(f"Report: {study / REPORT_NAME}", markup=False, highlight=False, soft_wrap=True)
