"""Where the time of one simulated procedure goes: patient, tissue, line integrals, X-rays, files.

    python benchmarks/simulation.py [--runs 3] [--cores 2 1] [--against FOLDER]

It is the first procedure of the accuracy study: a procedural patient with CTs of 1.0 and 0.75 mm, six images. Every run
is a process of its own under Python's profiler, whose clock counts the processor's time of all threads, so that other
work on the machine hardly alters it. The table holds the median of each row. `--against` is another checkout of this
project, measured in turns with this one on the last number of cores.
"""

import argparse
import cProfile
import json
import os
import pstats
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from statistics import median

from measure import machine, table, write_section

_THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS")
_WAITING = {"GOMP_SPINCOUNT": "1000"}  # as `femoreg_torch` sets it where it is imported before torch
# Rows, and the functions whose time, with all that they call, is theirs: file and name.
_STAGES = {
    "patient: bones": [("procedural/bones.py", "build_skeleton")],
    "patient: landmarks": [("landmarks.py", "find_landmarks")],
    "patient: soft tissue, both CTs": [("patient/scan.py", "scan_skeleton")],
    "patient: files": [("patient/writing.py", "write_patient")],
    "plan, device, reading": [("preoperative_case.py", "read_preoperative")],
    "tissue: field of view": [("field_of_view.py", "field_of_view")],
    "tissue: taken apart": [("tissue_densities.py", "separate")],
    "tissue: femur turned": [("femur_motion.py", "rotate_femur")],
    "line integrals: patient": [("posed_tissue.py", "areal_posed_tissue")],
    "line integrals: device": [("line_integrals.py", "areal_solids")],
    "X-rays: transmission": [("fluoroscopy.py", "transmission")],
    "X-rays: scatter": [("fluoroscopy.py", "scattered")],
    "X-rays: detector and noise": [("fluoroscopy.py", "detect")],
    "images and preview: files": [("fluoro/reading.py", "write_image"), ("preview.py", "write_preview")],
}

Seconds = dict[str, float]


def procedure(spacings_mm: tuple[float, float]) -> None:
    """Simulate it under the profiler, and print the seconds of each row as JSON; voxels as in the simulation."""
    import torch

    from sim.theatre.case_folders import write_procedural_simulation

    torch.set_num_threads(int(os.environ[_THREADS[0]]))
    profile = cProfile.Profile(time.process_time)
    with tempfile.TemporaryDirectory() as folder:
        began, used = time.perf_counter(), time.process_time()
        profile.enable()
        write_procedural_simulation(Path(folder) / "case", 301, 1001, "left", "paper", lambda _: None, spacings_mm)
        profile.disable()
        whole = {"whole": time.process_time() - used, "wall": time.perf_counter() - began}
    found: Seconds = {}
    for (path, _, name), (_, _, _, seconds, _) in pstats.Stats(profile).stats.items():  # type: ignore[attr-defined]
        for row, functions in _STAGES.items():
            if any(path.endswith(file) and name == function for file, function in functions):
                found[row] = found.get(row, 0.0) + seconds
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    print(json.dumps(found | whole | {"peak": peak}))


def one_run(cores: int, checkout: Path, spacings_mm: tuple[float, float] = (1.0, 0.75)) -> Seconds:
    """Seconds by row of one run of the code in a checkout, the wall clock, and the most memory, MiB."""
    available = sorted(os.sched_getaffinity(0))[:cores]
    environment = os.environ | dict.fromkeys(_THREADS, str(cores)) | {"PYTHONPATH": str(checkout), **_WAITING}
    arguments = [sys.executable, str(Path(__file__).resolve()), "--procedure", *map(str, spacings_mm)]
    done = subprocess.run(
        arguments,
        env=environment,
        check=True,
        stdout=subprocess.PIPE,
        preexec_fn=lambda: os.sched_setaffinity(0, available),
    )
    told: Seconds = json.loads(done.stdout)
    rows = {row: told[row] for row in _STAGES}
    rest = {"what is left": told["whole"] - sum(rows.values()), "**whole procedure**": told["whole"]}
    return rows | rest | {"whole procedure, wall clock": told["wall"], "most memory, MiB": told["peak"]}


def main() -> None:
    """Measure and write the section of RESULTS.md."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=int, default=3)
    parser.add_argument("--cores", type=int, nargs="+", default=[2, 1])
    parser.add_argument("--against", type=Path, help="another checkout of this project")
    parser.add_argument("--procedure", type=float, nargs=2, help=argparse.SUPPRESS)
    settings = parser.parse_args()
    if settings.procedure:
        procedure(tuple(settings.procedure))
        return
    here = Path(__file__).resolve().parents[1]
    measured = [(f"{cores} core{'s' * (cores > 1)}", cores, here) for cores in settings.cores]
    if settings.against:
        measured.append((f"before, {measured[-1][0]}", settings.cores[-1], settings.against.resolve()))
    for _, cores, checkout in measured:
        one_run(cores, checkout, (2.0, 2.0))  # fills the caches of compiled code and of the file system
    runs = [[one_run(cores, checkout) for _, cores, checkout in measured] for _ in range(settings.runs)]
    columns = [{row: median(run[n][row] for run in runs) for row in runs[0][n]} for n in range(len(measured))]
    rows = [
        [row, *(f"{column[row]:.0f}" if "MiB" in row else f"{column[row]:.2f}" for column in columns)]
        for row in columns[0]
    ]
    header = ["part", *(f"{name}: s" for name, _, _ in measured)]
    text = (
        f"{machine('cpu', ())}\n\nPatient 301, seed 1001, CTs of 1.0 and 0.75 mm, six images of 1,536 × 1,536 pixels; "
        f"median of {settings.runs} run{'s' * (settings.runs > 1)}, each in a process of its own. Seconds are those of "
        f"the processor, all threads together, but for the wall clock.\n\n{table(header, rows)}"
    )
    write_section("One simulated procedure on cpu", text)


if __name__ == "__main__":
    main()
