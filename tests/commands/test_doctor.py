"""`femoreg doctor` finds a machine in order, and tells what is not."""

import pytest
import torch

from femoreg_torch.commands import doctor
from femoreg_torch.commands.main import main
from femoreg_torch.drr import cuda
from femoreg_torch.drr import parity as drr_parity
from femoreg_torch.drr.parity import Parity, parity
from femoreg_torch.registration.parity import ObjectiveParity, objective_parity
from femoreg_torch.similarity.grad_ncc import FixedGradNcc


def test_a_machine_in_order(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr(doctor, "machine", lambda: [doctor.Finding("cores", "2")])  # tests may share the cores
    assert main(["doctor"]) == 0
    told = capsys.readouterr().out
    assert "projector on cpu" in told
    assert "objective on cpu" in told
    assert "Triton" in told
    assert "Nothing is amiss." in told


def test_what_is_amiss_is_told_and_ends_in_status_2(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(drr_parity, "parity", lambda device: Parity(0.5, float("nan")))
    monkeypatch.setattr(drr_parity, "milliseconds", lambda device: (1.0, 2.0))
    assert main(["doctor"]) == 2
    assert "do not use this device" in " ".join(capsys.readouterr().out.split())


def test_the_projector_agrees_with_the_formula_and_a_wrong_one_does_not(monkeypatch: pytest.MonkeyPatch) -> None:
    found = parity(torch.device("cpu"))
    assert found.holds
    assert found.image > 0
    project = drr_parity.project
    monkeypatch.setattr(drr_parity, "project", lambda *arguments: 1.01 * project(*arguments))
    assert not parity(torch.device("cpu")).holds
    assert not Parity(float("nan"), 0.0).holds


def test_the_objective_agrees_with_plain_formulas_and_a_wrong_one_does_not(monkeypatch: pytest.MonkeyPatch) -> None:
    assert objective_parity(torch.device("cpu")).holds
    quadratic = FixedGradNcc.curvature
    monkeypatch.setattr(
        FixedGradNcc,
        "curvature",
        lambda self, image, changes, stride: (
            (1.01 if image.dtype == torch.float32 else 1.0) * quadratic(self, image, changes, stride)
        ),
    )
    wrong = objective_parity(torch.device("cpu"))
    assert wrong.curvature == pytest.approx(0.01, abs=1e-3)
    assert not wrong.holds
    assert not ObjectiveParity(0.0, float("nan"), 0.0).holds


def test_a_gpu_without_kernels_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(cuda, "why_no_kernels", lambda device: "Triton is not installed")
    found = next(row for row in doctor.machine() if row.what == "GPU")
    assert found.amiss is not None
    assert "Triton is not installed" in found.amiss


def test_too_few_threads_are_told(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("os.sched_getaffinity", lambda _: range(64))
    cores = next(row for row in doctor.machine() if row.what == "cores")
    assert cores.amiss is not None
    assert "OMP_NUM_THREADS" in cores.amiss
