"""The multigrid cycle of a GPU: the same displacements as a direct solution, and curves as on the processor."""

import dataclasses

import numpy as np
import pytest
import torch
from pretended_gpu import DEVICE, pretended_gpu
from scipy import sparse
from scipy.sparse.linalg import spsolve

from femoreg_torch.drr import CPU
from femoreg_torch.drr.device import why_no_gpu
from femoreg_torch.planning.calibration import Calibration
from femoreg_torch.planning.curve import Press
from femoreg_torch.planning.element import elastic_stiffness
from femoreg_torch.planning.femur import Femur
from femoreg_torch.planning.loading import make_loading
from femoreg_torch.planning.model import Model, make_bone, make_model
from femoreg_torch.planning.multigrid import conjugate_gradients, on_device
from femoreg_torch.planning.settings import Planning
from femoreg_torch.planning.system import Assembler, Solver

Equations = tuple[sparse.bsr_array, np.ndarray]


@pytest.fixture(scope="module")
def model(femur: Femur, planning: Planning) -> Model:
    return make_model(make_bone(femur, Calibration("uncalibrated", 0.000887, 0.0633, {}), planning), planning, 6.0)


def press_on(device: torch.device, model: Model, femur: Femur, planning: Planning) -> Press:
    return Press(model.mesh, make_loading(model, femur, planning.load), planning.bone.poisson, device)


@pytest.fixture(scope="module")
def equations(model: Model, femur: Femur, planning: Planning) -> Equations:
    """The elastic matrix of a femur between its pads, and the forces of a push by 1 mm."""
    press = press_on(CPU, model, femur, planning)
    hard = press.hardened(model.material)
    stiffness = elastic_stiffness(hard.modulus, planning.bone.poisson) * model.mesh.size_mm
    return Assembler(model.mesh).matrix(stiffness, press.loading.springs), press.loading.push(1.0).ravel()


def test_sparse_matrices_multiply_as_they_did() -> None:
    rng = np.random.default_rng(1)
    dense = rng.normal(size=(12, 9)) * (rng.random((12, 9)) < 0.3)
    dense[4] = 0.0
    for made in (sparse.csr_array(dense), sparse.bsr_array(dense, blocksize=(3, 3)), sparse.csc_array(dense)):
        x = rng.normal(size=9)
        np.testing.assert_allclose(on_device(made, CPU) @ torch.from_numpy(x), dense @ x, atol=1e-14)


def test_displacements_are_those_of_a_direct_solution(
    monkeypatch: pytest.MonkeyPatch, model: Model, equations: Equations
) -> None:
    matrix, force = equations
    direct = spsolve(matrix.tocsc(), force)
    with pretended_gpu(monkeypatch) as gpu:
        found = Solver(matrix, model.mesh.nodes, DEVICE).solve(matrix, force, 1e-10)
        assert gpu.waits["download"] == 1  # the displacements
    np.testing.assert_allclose(found, direct, atol=1e-6 * np.abs(direct).max())
    on_processor = Solver(matrix, model.mesh.nodes, CPU).solve(matrix, force, 1e-10)
    np.testing.assert_allclose(on_processor, direct, atol=1e-6 * np.abs(direct).max())


def test_its_cycle_saves_as_many_iterations_as_the_processors(
    monkeypatch: pytest.MonkeyPatch, model: Model, equations: Equations
) -> None:
    matrix, force = equations
    _, unaided = conjugate_gradients(matrix, force, lambda residual: residual, 1e-8, 100)
    assert unaided > 1e-3
    counts = {}
    for device in (CPU, DEVICE):
        with pretended_gpu(monkeypatch):
            solver = Solver(matrix, model.mesh.nodes, device)
            cycle, calls = solver._cycle, []
            monkeypatch.setattr(solver, "_cycle", lambda x, cycle=cycle, calls=calls: calls.append(1) or cycle(x))
            solver.solve(matrix, force, 1e-8)
        counts[device.type] = len(calls)
    assert counts["cuda"] <= 1.3 * counts["cpu"] < 60


@pytest.mark.parametrize(
    "real", [False, pytest.param(True, marks=pytest.mark.skipif(why_no_gpu() is not None, reason="no GPU"))]
)
def test_a_curve_is_the_same_on_a_gpu(
    monkeypatch: pytest.MonkeyPatch, model: Model, femur: Femur, planning: Planning, real: bool
) -> None:
    quick = dataclasses.replace(planning.curve, step_mm=0.5, stop_stiffness=1.0)
    expected = press_on(CPU, model, femur, planning).curve(model.material, quick)
    if real:
        found = press_on(DEVICE, model, femur, planning).curve(model.material, quick)
    else:
        with pretended_gpu(monkeypatch):
            found = press_on(DEVICE, model, femur, planning).curve(model.material, quick)
    assert found.stiffness_n_mm == pytest.approx(expected.stiffness_n_mm, rel=1e-6)
    assert found.yield_load_n == pytest.approx(expected.yield_load_n, rel=1e-3)
