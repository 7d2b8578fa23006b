"""How a study is carried out in a terminal: a bar, what there is already, and what it has come to."""

from pathlib import Path

from rich.console import Console
from rich.markup import escape
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from femoreg_torch.commands.status import AMISS, DONE
from sim.study.engine import Executor
from sim.study.study import RECORDED, Study, run_study


def carry_out_told(plan: Study, out: Path, executor: Executor, reuse: bool) -> int:
    """Make the runs that are missing in `out`. Returns the exit status: `AMISS` if a run failed, else `DONE`."""
    console = Console()
    bar = (BarColumn(), MofNCompleteColumn(), TimeElapsedColumn(), TextColumn("left:"), TimeRemainingColumn())
    with Progress(TextColumn("runs"), *bar, console=console, speed_estimate_period=3600) as progress:
        task = progress.add_task("runs", total=len(plan.runs))

        def begin(todo: int, kept: int, others: int) -> None:
            progress.update(task, total=todo)
            if kept:
                console.print(f"{kept} of {kept + todo} runs are there already.")
            if others:
                console.print(
                    f"{others} records of other settings or procedures stay in {out / 'runs'}, out of the table."
                )

        told = run_study(plan, out, executor, reuse, begin, lambda done: progress.advance(task, done))
    counts = ", ".join(f"{count} {status}" for status, count in sorted(told.status.items()))
    what = "Runs on recorded cases" if all(run.kind == RECORDED for run in plan.runs) else "Simulated runs"
    console.print(f"{what}: {counts}; of those done, {told.flagged} are not trusted.")
    if told.first_failure is not None:
        console.print(f"[bold red]Failed[/], first of them: {escape(told.first_failure)}")
    console.print(f"Table written to {told.table}.", markup=False)
    return AMISS if told.first_failure is not None else DONE
