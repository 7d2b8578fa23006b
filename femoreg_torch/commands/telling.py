"""What commands say in the terminal."""

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import torch
from rich.console import Console
from rich.markup import escape
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

from femoreg_torch.case import Result
from femoreg_torch.drr import DeviceName, chosen_device
from femoreg_torch.drr.device import told, why_no_gpu

_BETWEEN_LINES_S = 30.0  # of a log, which shows no bar


@contextmanager
def progress_report(console: Console, first: str) -> Iterator[Callable[[str, float], None]]:
    """A bar that is told what is done and the share of the work behind it, from 0 to 1.

    Where the output is no terminal but, say, a log, a line tells it instead, every half minute.
    """
    columns = (TextColumn("{task.description}"), BarColumn(), TimeElapsedColumn())
    unseen = not console.is_interactive  # an empty line would be left of it
    with Progress(*columns, console=console, transient=True, disable=unseen) as progress:
        task = progress.add_task(first, total=1.0)
        told = time.monotonic()

        def report(step: str, share: float) -> None:
            nonlocal told
            progress.update(task, completed=share, description=step)
            if unseen and time.monotonic() - told > _BETWEEN_LINES_S:
                told = time.monotonic()
                console.print(f"{100 * share:.0f} %: {step}", markup=False, highlight=False, soft_wrap=True)

        yield report


def tell_device(console: Console, name: DeviceName) -> torch.device:
    """The device of a name, see `chosen_device`; which one `auto` took is told."""
    device = chosen_device(name)
    if name == "auto":
        reason = why_no_gpu()
        console.print(f"Computing on {told(device)}" + (f": {reason}." if reason else "."), markup=False)
    return device


def in_place_of(out: Path) -> str:
    """What a command says after where it wrote, if something stood there before; to be asked before it writes."""
    stood = out.is_file() or (out.is_dir() and any(out.iterdir()))
    return ", in place of what stood there" if stood else ""


def tell(console: Console, what: str, words: str) -> None:
    """A warning or a note, as a sentence."""
    stop = "" if words.endswith((".", "?", "!")) else "."
    console.print(f"[yellow]{what}:[/] {escape(words)}{stop}", highlight=False, soft_wrap=not console.is_terminal)


def tell_verdict(console: Console, result: Result) -> None:
    """The verdict, and what was left out or found on the way."""
    verdict = result.verdict
    if verdict.trusted:
        console.print(f"[green]{escape(verdict.sentence)}[/]")
    else:
        console.print("[bold red]Do not trust this registration:[/]")
        for reason in verdict.reasons:
            console.print(f"  {escape(reason)}", soft_wrap=not console.is_terminal)  # a log is searched by lines
    for note in result.skipped:
        tell(console, "Note", note)
