"""The time of `femoreg register` by several versions of this project, run by turns: what each change was worth.

    git worktree add ../before COMMIT
    python benchmarks/versions.py CASE before=../before now=. [--runs 5] [--title TITLE]

Each tree runs with its own preset `fast`; packages are those of this environment.
"""

import argparse
import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from statistics import median

from measure import machine, table, write_section

_PARTS = ("reading", "detection", "registration", "quality")


def one_run(tree: Path, case: Path) -> dict[str, float]:
    """Seconds of the parts and of the whole command, run from the tree at `tree`."""
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "run"
        command = [sys.executable, "-m", "femoreg_torch.commands.main", "register", str(case), "--out", str(out)]
        command += ["--preset", str(tree / "configs/registration/fast.yaml")]
        before, began = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
        subprocess.run(
            command, cwd=tree, env=os.environ | {"PYTHONPATH": str(tree)}, stdout=subprocess.DEVNULL, check=True
        )
        whole, after = time.perf_counter() - began, resource.getrusage(resource.RUSAGE_CHILDREN)
        busy = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
        told = json.loads((out / "result.json").read_text(encoding="utf-8"))["timings_s"]
    return {part: told[part] for part in _PARTS} | {"rest": whole - told["total"], "whole": whole, "processor": busy}


def main() -> None:
    """Measure and write the section of RESULTS.md."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("case", type=Path, help="case folder")
    parser.add_argument("versions", nargs="+", metavar="LABEL=TREE")
    parser.add_argument("--runs", type=int, default=5)
    parser.add_argument("--title", default="The whole command, version by version")
    settings = parser.parse_args()
    trees = {label: Path(tree).resolve() for label, tree in (version.split("=", 1) for version in settings.versions)}
    case = settings.case.resolve()
    for tree in trees.values():
        one_run(tree, case)  # fills the caches of compiled code
    runs: dict[str, list[dict[str, float]]] = {label: [] for label in trees}
    for _ in range(settings.runs):  # by turns, so that a slow minute hits all
        for label, tree in trees.items():
            runs[label].append(one_run(tree, case))
    found = {label: {part: median(run[part] for run in of) for part in of[0]} for label, of in runs.items()}
    rows = [[label, *(f"{seconds:.1f}" for seconds in parts.values())] for label, parts in found.items()]
    header = ["version", *(f"{part}: s" for part in next(iter(found.values())))]
    text = (
        f"{machine('cpu', ())}\n\nPreset `fast`, one procedure with six images of 1,536 × 1,536 pixels; medians of "
        f"{settings.runs} runs, the versions by turns. Each row holds the changes of those above it; `rest` is the "
        "start of Python, imports, the case's files and writing; `processor` is the time of all threads together: it "
        f"says more where the machine is shared.\n\n{table(header, rows)}"
    )
    write_section(settings.title, text)


if __name__ == "__main__":
    main()
