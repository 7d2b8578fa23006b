"""What commands say in the terminal."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager

from rich.console import Console
from rich.markup import escape
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

from femoreg_torch.case import Result


@contextmanager
def progress_report(console: Console, first: str) -> Iterator[Callable[[str, float], None]]:
    """A bar that is told what is done and the share of the work behind it, from 0 to 1."""
    columns = (TextColumn("{task.description}"), BarColumn(), TimeElapsedColumn())
    with Progress(*columns, console=console, transient=True) as progress:
        task = progress.add_task(first, total=1.0)

        def report(step: str, share: float) -> None:
            progress.update(task, completed=share, description=step)

        yield report


def tell_verdict(console: Console, result: Result) -> None:
    """The verdict, and what was left out."""
    verdict = result.verdict
    if verdict.trusted:
        console.print(f"[green]{escape(verdict.sentence)}[/]")
    else:
        console.print("[bold red]Do not trust this registration:[/]")
        for reason in verdict.reasons:
            console.print(f"  {escape(reason)}")
    for note in result.skipped:
        console.print(f"[yellow]Left out:[/] {escape(note)}.")
