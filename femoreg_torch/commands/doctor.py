"""`femoreg doctor`: what this machine has, whether the projector is right on it, how fast, and what is amiss."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Finding:
    """One line of the report."""

    what: str
    found: str
    amiss: str | None = None  # what is wrong, and how to mend it


def doctor() -> int:
    """Look at this machine: versions, cores, memory, GPU; check the projector against a formula, and its speed.

    Takes some ten seconds, the first time on a GPU a minute. The projector runs on the CPU and on each GPU that torch
    sees; its images and derivatives are compared with the line integrals of a Gaussian ball, which have a formula. So
    is what a stage of a registration minimises, its gradient and its curvature, with plain formulas in double
    precision. Ends with status 2 if something is wrong that would make results wrong or impossible.
    """
    from rich.console import Console
    from rich.markup import escape
    from rich.table import Table

    from femoreg_torch.commands.status import BAD_INPUT, DONE

    console = Console()
    findings = [*software(), *machine(), *network()]
    with console.status("checking the projector"):
        for device in devices():
            findings += [*projector(device), *objective(device)]
    table = Table(show_header=False, box=None)
    for finding in findings:
        mark = "[green]✓[/]" if finding.amiss is None else "[bold red]✗[/]"
        table.add_row(mark, escape(finding.what), escape(finding.found))
    console.print(table)
    amiss = [finding for finding in findings if finding.amiss is not None]
    for finding in amiss:
        console.print(f"[bold red]{escape(finding.what)}:[/] {escape(finding.amiss or '')}")
    if not amiss:
        console.print("[green]Nothing is amiss.[/]")
    return BAD_INPUT if amiss else DONE


def software() -> list[Finding]:
    """Versions of what registration imports."""
    import platform
    from importlib.metadata import PackageNotFoundError, version

    import femoreg_torch

    rows = [Finding("FemoReg Torch", femoreg_torch.__version__), Finding("Python", platform.python_version())]
    for name in ("torch", "numpy", "numba", "SimpleITK", "opencv-python-headless", "cma", "nlopt"):
        try:
            rows.append(Finding(name, version(name)))
        except PackageNotFoundError:
            rows.append(Finding(name, "missing", f"is not installed: pip install {name}"))
    try:
        rows.append(Finding("Triton", version("triton")))
    except PackageNotFoundError:
        rows.append(Finding("Triton", "none (it is needed on a GPU alone)"))
    return rows


def machine() -> list[Finding]:
    """Cores, threads, memory, and the GPU's side of torch."""
    import os

    import numba
    import torch

    from femoreg_torch.drr.device import why_no_gpu

    cores = len(os.sched_getaffinity(0))
    threads = min(torch.get_num_threads(), numba.get_num_threads())
    few = (
        f"only {threads} of {cores} cores are used: unset OMP_NUM_THREADS and NUMBA_NUM_THREADS"
        if threads < cores
        else None
    )
    gigabytes = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_AVPHYS_PAGES") / 1e9
    small = "a registration needs some 3 GB of free memory" if gigabytes < 3 else None
    rows = [
        Finding("cores", f"{cores}, {threads} used", few),
        Finding("free memory", f"{gigabytes:.1f} GB", small),
    ]
    load = os.getloadavg()[0]
    shared = "; other programs share the cores, so the times below say little" if load > cores else ""
    rows.append(Finding("load", f"{load:.1f}{shared}"))
    if not torch.cuda.is_available():
        return [*rows, Finding("GPU", f"none: {why_no_gpu()}")]
    reason = why_no_gpu()
    if reason is not None:
        rows.append(Finding("GPU", "of no use", f"{reason}: take --device cpu"))
    for number in range(torch.cuda.device_count()):
        properties = torch.cuda.get_device_properties(number)
        rows.append(Finding(f"GPU {number}", f"{properties.name}, {properties.total_memory / 1e9:.0f} GB"))
    return rows


def network() -> list[Finding]:
    """Whether the shipped weights can be read."""
    from femoreg_torch.detect import load_network
    from femoreg_torch.errors import InputError

    try:
        found = load_network()
    except (InputError, OSError) as error:
        return [Finding("landmark network", "unreadable", f"{error} Install the package again.")]
    return [Finding("landmark network", f"{found.anatomy.name}, {len(found.anatomy.landmarks)} landmarks")]


def devices() -> list[str]:
    """The devices that torch can compute on, by name."""
    import torch

    return ["cpu", *(f"cuda:{number}" for number in range(torch.cuda.device_count()))]


def projector(name: str) -> list[Finding]:
    """Parity and speed of the projector on a device."""
    import torch

    from femoreg_torch.drr.parity import MOST_ERROR, MOST_SLOPE_ERROR, milliseconds, parity
    from femoreg_torch.errors import InputError

    device = torch.device(name)
    what = f"projector on {name}"
    try:
        found = parity(device)
        image, derivatives = milliseconds(device)
    except InputError as error:
        return [Finding(what, "does not run", f"{error}")]
    deviations = f"image {100 * found.image:.2f} %, derivatives {100 * found.derivative:.2f} %"
    wrong = (
        f"deviates from the formula by more than {100 * MOST_ERROR:.1f} % and {100 * MOST_SLOPE_ERROR:.1f} %: do not "
        "use this device, and please report it with this table"
    )
    speed = f"{image:.1f} ms an image of 384 × 384 pixels, {derivatives:.1f} ms with derivatives"
    return [
        Finding(what, f"off by {deviations} at most", None if found.holds else wrong),
        Finding(f"speed on {name}", speed),
    ]


def objective(name: str) -> list[Finding]:
    """Parity of a stage's objective on a device."""
    import torch

    from femoreg_torch.errors import InputError
    from femoreg_torch.registration.parity import (
        MOST_CURVATURE,
        MOST_GRADIENT,
        MOST_VALUE,
        objective_parity,
    )

    what = f"objective on {name}"
    try:
        found = objective_parity(torch.device(name))
    except InputError as error:
        return [Finding(what, "does not run", f"{error}")]
    off = f"off by {found.value:.0e}, gradient {found.gradient:.0e}, curvature {found.curvature:.0e} of its size"
    wrong = (
        f"deviates from plain formulas by more than {MOST_VALUE:.0e}, {MOST_GRADIENT:.0e} or {MOST_CURVATURE:.0e}: do "
        "not use this device, and please report it with this table"
    )
    return [Finding(what, off, None if found.holds else wrong)]
