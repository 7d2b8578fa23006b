"""Timing, memory and report of the benchmarks: medians after a warm-up, one process per row, peers in the same run."""

import multiprocessing
import os
import platform
import resource
import time
from collections.abc import Callable, Sequence
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


def measure(call: Callable[[], object], device: str, seconds: float) -> Timing:
    """Time `call` for about `seconds`, three times at least. Its first run, not timed, gives the peak memory."""
    before = _resident_mib(device)
    call()
    peak = max(0.0, _peak_mib(device) - before)
    times: list[float] = []
    while len(times) < 3 or (sum(times) < seconds and len(times) < 200):
        start = time.perf_counter()
        call()
        if device == "cuda":
            torch.cuda.synchronize()
        times.append(time.perf_counter() - start)
    p10, median, p90 = np.percentile(times, (10, 50, 90))
    return Timing(float(median), float(p10), float(p90), peak)


def _resident_mib(device: str) -> float:
    if device == "cuda":
        torch.cuda.synchronize()
        torch.cuda.reset_peak_memory_stats()
        return torch.cuda.memory_allocated() / 2**20
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 2**20


def _peak_mib(device: str) -> float:
    if device == "cuda":
        torch.cuda.synchronize()
        return torch.cuda.max_memory_allocated() / 2**20
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def in_own_process(function: Callable[..., Any], *arguments: object) -> Any:
    """`function(*arguments)` in a fresh process, so that its peak memory is its own."""
    with multiprocessing.get_context("spawn").Pool(1) as pool:
        return pool.apply(function, arguments)


def missing(package: str) -> str | None:
    """Why a peer cannot be measured, or None."""
    try:
        __import__(package)
    except ImportError as error:
        return f"{package} is left out: {error}. Install the extra `bench`."
    return None


def machine(device: str, packages: Sequence[str]) -> str:
    """One line: processor, cores, load, versions."""
    names = [line for line in Path("/proc/cpuinfo").read_text().splitlines() if line.startswith("model name")]
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
