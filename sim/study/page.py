"""The page `docs/accuracy.md`, and others: sections of Markdown, each replaced as a whole when it is measured anew."""

import os
import platform
from importlib.metadata import version
from pathlib import Path

from femoreg_torch.files import write_text

PAGE = "accuracy.md"
_HEAD = """# Accuracy

Every figure on this page was written by the command named above it, and comes from **simulated** fluoroscopy:
procedural patients (computed shapes), and CTs with invented grey values around real bone shapes (*real*). It says
nothing about patients. The paper's figures beside them are means over 1,000 simulations of another anatomy in another
simulator (Gao et al., IEEE Trans Med Robot Bionics 2 (2020) 437, Tables I and II)."""


def write_section(docs: Path, title: str, text: str, page: str = PAGE) -> None:
    """Put a section into a page in the folder `docs`, in place of an older one of the same title."""
    path = docs / page
    before = path.read_text(encoding="utf-8").rstrip() if path.is_file() else _HEAD
    head, *sections = before.split("\n## ")
    kept = {section.split("\n", 1)[0]: section.rstrip() for section in sections}
    kept[title] = f"{title}\n\n{text}".rstrip()
    docs.mkdir(parents=True, exist_ok=True)
    write_text(path, "\n\n## ".join([head.rstrip(), *kept.values()]) + "\n")


def machine() -> str:
    """One line: processor, cores, load, versions."""
    cpus = Path("/proc/cpuinfo")
    names = cpus.read_text(encoding="utf-8").splitlines() if cpus.is_file() else []
    model = next((line.split(":")[1].strip() for line in names if line.startswith("model name")), platform.processor())
    found = ", ".join(f"{package} {version(package)}" for package in ("torch", "numba"))
    load = f"load average {os.getloadavg()[0]:.1f}" if hasattr(os, "getloadavg") else ""
    return f"{model}, {os.cpu_count()} cores, {load}; Python {platform.python_version()}, {found}."
