"""Timing, memory and report of the benchmarks: medians after a warm-up, one process per row, peers in the same run."""

import multiprocessing
import os
import platform
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import torch

RESULTS = Path(__file__).with_name("RESULTS.md")


@dataclass(frozen=True)
class Timing:
    """Wall-clock seconds of one call, and the memory in MiB that it needed above what was there before."""

    median: float
    p10: float
    p90: float
    peak_mib: float

    def per(self, items: int) -> str:
        """Milliseconds per item: median (p10–p90)."""
        a, b, c = (1e3 * t / items for t in (self.median, self.p10, self.p90))
        return f"{a:.3g} ({b:.3g}–{c:.3g})"


def measure(call: Callable[[], object], device: str, seconds: float, before_mib: float = 0.0) -> Timing:
    """Time `call` for about `seconds`, three times at least. Its first run, not timed, gives the peak memory."""
    call()
    peak = max(0.0, _peak_mib(device) - before_mib)
    times: list[float] = []
    while len(times) < 3 or (sum(times) < seconds and len(times) < 200):
        start = time.perf_counter()
        call()
        if device == "cuda":
            torch.cuda.synchronize()
        times.append(time.perf_counter() - start)
    p10, median, p90 = np.percentile(times, (10, 50, 90))
    return Timing(float(median), float(p10), float(p90), peak)


def resident_mib(device: str) -> float:
    """Memory in MiB held now, which `measure` subtracts; the peak is counted anew from here."""
    if device == "cuda":
        torch.cuda.synchronize()
        torch.cuda.reset_peak_memory_stats()
        return torch.cuda.memory_allocated() / 2**20
    Path("/proc/self/clear_refs").write_text(
        "5", encoding="utf-8"
    )  # Linux: sets VmHWM back to VmRSS (proc_pid_clear_refs(5))
    return _status_mib("VmRSS")


def _peak_mib(device: str) -> float:
    if device == "cuda":
        torch.cuda.synchronize()
        return torch.cuda.max_memory_allocated() / 2**20
    return _status_mib("VmHWM")


def _status_mib(field: str) -> float:
    lines = Path("/proc/self/status").read_text(encoding="utf-8").splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith(field)) / 1024


def in_own_process(function: Callable[..., Any], *arguments: object) -> Any:
    """`function(*arguments)` in a fresh process, so that its peak memory is its own."""
    with ProcessPoolExecutor(1, mp_context=multiprocessing.get_context("spawn")) as pool:
        return pool.submit(function, *arguments).result()


def missing(package: str) -> str | None:
    """Why a peer cannot be measured, or None."""
    try:
        __import__(package)
    except ImportError as error:
        return f"{package} is left out: {error}. Install the extra `bench`."
    return None


def machine(device: str, packages: Sequence[str]) -> str:
    """One line: processor, cores, load, versions."""
    names = [
        line for line in Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines() if line.startswith("model name")
    ]
    model = names[0].split(":")[1].strip() if names else platform.processor()
    graphics = f", {torch.cuda.get_device_name()}" if device == "cuda" else ""
    found = ", ".join(f"{p} {version(p)}" for p in ("torch", "numba", *packages))
    return (
        f"{model}, {os.cpu_count()} cores, {torch.get_num_threads()} threads{graphics}; "
        f"load average {os.getloadavg()[0]:.1f}; Python {platform.python_version()}, {found}."
    )


def table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A Markdown table."""
    lines = [header, ["---"] * len(header), *rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def write_section(title: str, text: str) -> None:
    """Print a section and put it into RESULTS.md, in place of an older one of the same title."""
    print(f"\n## {title}\n\n{text}\n")
    head, *sections = RESULTS.read_text(encoding="utf-8").rstrip().split("\n## ") if RESULTS.exists() else ["# Results"]
    kept = {section.split("\n", 1)[0]: section for section in sections}
    kept[title] = f"{title}\n\n{text}\n"
    pages = [head.rstrip(), *(section.rstrip() for section in kept.values())]
    partial = RESULTS.with_suffix(".partial")
    partial.write_text("\n\n## ".join(pages) + "\n", encoding="utf-8")
    partial.replace(RESULTS)
