"""Where the time of `femoreg register` goes: imports, reading, detection, each stage, quality, writing.

Beside the seconds stand the evaluations of each stage and the samples that the projector takes along its rays.

    python benchmarks/procedure.py CASE [--runs 5] [--cores 2 1]

Every run is the command in a process of its own. The table holds the median of each row.
"""

import argparse
import json
import operator
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from statistics import median

from measure import in_own_process, machine, table, write_section
from samples import samples_of_a_registration

_COMMAND = "from femoreg_torch.commands.main import console_script; console_script()"
_IMPORTS = "import femoreg_torch.commands.register, femoreg_torch.registration.run, femoreg_torch.evaluation"
_THREADS = ("OMP_NUM_THREADS", "NUMBA_NUM_THREADS")  # NumPy's are a matter of the command

Seconds = dict[str, float]


def environment(cores: int) -> dict[str, str]:
    """That of this process, with so many threads; Python keeps compiled modules, as it does for users."""
    kept = {key: value for key, value in os.environ.items() if key != "PYTHONDONTWRITEBYTECODE"}
    return kept | dict.fromkeys(_THREADS, str(cores))


def timed(arguments: list[str], cores: int) -> tuple[float, float, float]:
    """Seconds of a process on the first `cores` cores, those of the processor, and the most memory it held, MiB."""
    available = sorted(os.sched_getaffinity(0))[:cores]
    began = time.perf_counter()
    process = subprocess.Popen(
        arguments,
        env=environment(cores),
        stdout=subprocess.DEVNULL,
        preexec_fn=lambda: os.sched_setaffinity(0, available),
    )
    _, status, used = os.wait4(process.pid, 0)
    if status:
        raise SystemExit(f"{' '.join(arguments[-4:])}: ended with status {os.waitstatus_to_exitcode(status)}.")
    return time.perf_counter() - began, used.ru_utime + used.ru_stime, used.ru_maxrss / 1024


def one_run(case: Path, cores: int) -> tuple[Seconds, dict[str, int], float]:
    """Seconds by part of one run of the command, evaluations by stage, and the most memory, MiB."""
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "run"
        whole, busy, peak = timed([sys.executable, "-c", _COMMAND, "register", str(case), "--out", str(out)], cores)
        result = json.loads((out / "result.json").read_text(encoding="utf-8"))
    imports, _, _ = timed([sys.executable, "-c", _IMPORTS], cores)
    told = result["timings_s"]
    parts = {"start of Python and imports": imports, "reading": told["reading"], "detection": told["detection"]}
    evaluations: dict[str, int] = {}
    for stage in result["stages"]:
        name = f"stage: {stage['name']}"
        at_once = cores > 1 and stage["view"] is not None  # views that do not wait for one another
        parts[name] = (max if at_once else operator.add)(parts.get(name, 0.0), stage["seconds"])
        evaluations[name] = evaluations.get(name, 0) + stage["evaluations"]
    parts["between stages"] = told["registration"] - sum(parts[name] for name in evaluations)
    parts["quality"] = told["quality"]
    parts["the case's files, writing, end"] = whole - imports - told["total"]
    return parts | {"**whole command**": whole, "time of the processor, all threads": busy}, evaluations, peak


def main() -> None:
    """Measure and write the section of RESULTS.md."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("case", type=Path, help="case folder")
    parser.add_argument("--runs", type=int, default=5)
    parser.add_argument("--cores", type=int, nargs="+", default=[2, 1])
    settings = parser.parse_args()
    columns: list[Seconds] = []
    evaluations: dict[str, int] = {}
    peaks = []
    for cores in settings.cores:
        one_run(settings.case, cores)  # fills the caches of compiled code and of the file system
        runs = [one_run(settings.case, cores) for _ in range(settings.runs)]
        columns.append({part: median(run[0][part] for run in runs) for part in runs[0][0]})
        evaluations = evaluations or runs[0][1]
        peaks.append(max(run[2] for run in runs))
    taken = in_own_process(samples_of_a_registration, settings.case)
    marched = {name if name == "quality" else f"stage: {name}": number for name, number in taken.items()}
    marched["detection"] = marched.pop("stage: finding landmarks", 0)
    marched["**whole command**"] = sum(taken.values())
    rows = [
        [
            part,
            str(evaluations.get(part, "")),
            f"{marched[part] / 1e6:,.0f}" if part in marched else "",
            *(f"{column[part]:.2f}" for column in columns),
        ]
        for part in columns[0]
    ]
    rows.append(["most memory, MiB", "", "", *(f"{peak:.0f}" for peak in peaks)])
    header = [
        "part",
        "evaluations",
        "samples: millions",
        *(f"{cores} core{'s' * (cores > 1)}: s" for cores in settings.cores),
    ]
    text = (
        f"{machine('cpu', ())}\n\nPreset `fast`, six images of 1,536 × 1,536 pixels; median of {settings.runs} runs "
        f"of the command, each in a process of its own.\n\n{table(header, rows)}"
    )
    write_section("The whole command on cpu", text)


if __name__ == "__main__":
    main()
