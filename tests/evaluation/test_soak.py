"""Many registrations in one process: equal results, and neither memory nor files nor threads that add up.

Run by `make soak`; FEMOREG_SOAK_COUNT says how many (200). The case is a simulated procedure with a coarse CT and
coarse images. All steps of `fast` are taken, with larger pixels and fewer candidates: some nine seconds of processor
time.
"""

import json
import os
import threading
from pathlib import Path
from typing import Any

import pytest
import yaml
from femoreg_torch.configs import load_preset

from femoreg_torch.commands.main import main
from sim.theatre.case_folders import write_phantom, write_simulation

COUNT = int(os.environ.get("FEMOREG_SOAK_COUNT", 200))
MOST_GROWTH_MB = 30.0  # from the first two fifths of the runs to the last, at most; it goes up and down by 40 MB
_CARM = {"sdd_mm": 1020, "pixel_mm": [4.65, 4.65], "shape": [64, 64], "isocentre_mm": [0, 0, 690]}
_OFF_MM = (4.0, -3.0, 15.0)  # where the search starts, beside the truth


def memory_mb() -> float:
    """Resident memory of this process."""
    pages = int(Path("/proc/self/statm").read_text(encoding="utf-8").split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 2**20


def open_files_and_threads() -> tuple[int, int]:
    """Of this process, once threads that are about to end have ended, such as that of a bar of progress."""
    for thread in threading.enumerate():
        if thread is not threading.main_thread() and not thread.name.startswith("core"):  # which stay
            thread.join(5)
    return len(list(Path("/proc/self/fd").iterdir())), threading.active_count()


@pytest.fixture
def command(tmp_path: Path) -> list[str]:
    """The command line, but for `--out`, of a registration."""
    write_phantom(tmp_path / "patient", 31, "left", 2.0)
    (tmp_path / "carm.yaml").write_text(yaml.safe_dump(_CARM | {"orbit_axis": [0, 1, 0]}), encoding="utf-8")
    (tmp_path / "sim.yaml").write_text(
        yaml.safe_dump({"extends": "paper", "carm": str(tmp_path / "carm.yaml")}), encoding="utf-8"
    )
    write_simulation(tmp_path / "patient", tmp_path / "case", 5, "left", str(tmp_path / "sim.yaml"), lambda _: None)
    truth = json.loads((tmp_path / "case" / "truth.json").read_text(encoding="utf-8"))
    poses = {"camera1_from_pelvis": truth["camera_from_pelvis"][0], "camera1_from_femur": truth["camera1_from_femur"]}
    for pose in poses.values():
        for row, mm in enumerate(_OFF_MM):
            pose[row][3] += mm
    (tmp_path / "start.json").write_text(json.dumps(poses), encoding="utf-8")
    preset = load_preset("registration", "fast")
    for step in preset["steps"]:
        step |= {"level": {"pixel_mm": 6.2, "step_mm": 2}} if "level" in step else {}
        if "candidates" in step.get("optimiser", {}):
            step["optimiser"] |= {"candidates": 40, "starts": 2}
    (tmp_path / "coarse.yaml").write_text(yaml.safe_dump(preset), encoding="utf-8")
    files = {"--start": "start.json", "--preset": "coarse.yaml"}
    return ["register", str(tmp_path / "case"), *(w for k, name in files.items() for w in (k, str(tmp_path / name)))]


def registered(arguments: list[str], out: Path) -> dict[str, Any]:
    """What a registration writes, but for how long it took."""
    assert main([*arguments, "--out", str(out)]) == 0
    content: dict[str, Any] = json.loads((out / "result.json").read_text(encoding="utf-8"))
    del content["timings_s"]
    for stage in content["stages"]:
        del stage["seconds"]
    return content


@pytest.mark.soak
@pytest.mark.filterwarnings("ignore")
def test_registrations_in_one_process(command: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    first = registered(command, tmp_path / "out")
    memory, others = [memory_mb()], {open_files_and_threads()}
    for number in range(2, COUNT + 1):
        assert registered(command, tmp_path / "out") == first, f"run {number} differs from the first"
        capsys.readouterr()
        memory.append(memory_mb())
        others.add(open_files_and_threads())
        if number == COUNT or number % max(COUNT // 10, 1) == 0:
            with capsys.disabled():
                told = f"{memory[0]:.0f} MB after the first, {memory[-1]:.0f} MB now, {max(memory):.0f} MB at most"
                print(f"\n{number} registrations, equal: {told}", flush=True)
    parts = [memory[n * COUNT // 5 : (n + 1) * COUNT // 5] for n in range(5)]
    assert max(parts[-1]) < max(max(parts[0]), max(parts[1])) + MOST_GROWTH_MB
    assert len(others) == 1, f"open files and threads: {others}"
