"""The finite-element core against closed forms, scikit-fem and finite differences."""

import numpy as np
import pytest
from scipy.sparse.linalg import spsolve

from femoreg_torch.drr import CPU
from femoreg_torch.planning.element import CORNERS, elastic_stiffness, template
from femoreg_torch.planning.laws import Material
from femoreg_torch.planning.mesh import Mesh, mesh_of
from femoreg_torch.planning.plasticity import Plasticity
from femoreg_torch.planning.system import Assembler, Solver, rigid_modes

POISSON = 0.3


def bar(counts: tuple[int, int, int], size: float = 1.0) -> Mesh:
    return mesh_of(size, np.ones(counts, bool), np.eye(3), np.zeros(3))


def test_rigid_motions_cost_nothing_and_the_stiffness_is_symmetric() -> None:
    stiffness = elastic_stiffness(np.ones((1, 8)), POISSON)[0]
    np.testing.assert_allclose(stiffness, stiffness.T, atol=1e-15)
    np.testing.assert_allclose(stiffness @ rigid_modes(CORNERS.astype(float)), 0, atol=1e-15)
    values = np.linalg.eigvalsh(stiffness)
    assert (values > 1e-3).sum() == 18


def test_patch_with_a_linear_field_on_its_boundary_takes_it_on_inside() -> None:
    mesh = bar((3, 3, 3), 2.0)
    field = np.random.default_rng(0).normal(size=(3, 3)) * 1e-3
    wanted = mesh.nodes @ field.T
    stiffness = elastic_stiffness(np.full((27, 8), 700.0), POISSON)
    matrix = Assembler(mesh).matrix(2.0 * stiffness, np.zeros((64, 3, 3))).tocsr()
    inside = ((mesh.nodes > 0) & (mesh.nodes < 6)).all(1).repeat(3)
    flat = wanted.ravel()
    found = spsolve(matrix[inside][:, inside].tocsc(), -matrix[inside][:, ~inside] @ flat[~inside])
    np.testing.assert_allclose(found, flat[inside], atol=1e-16)


def test_the_matrix_is_that_of_scikit_fem() -> None:
    """Mean dilatation in scikit-fem's terms: the usual deviatoric form, and the volume's mean over each cube."""
    skfem = pytest.importorskip("skfem")
    from skfem.helpers import ddot, div, sym_grad, trace

    mesh = bar((3, 2, 2))
    modulus = np.random.default_rng(2).uniform(10, 1000, len(mesh.elements))
    order = np.lexsort(mesh.nodes.T)
    line = [np.arange(n + 1.0) for n in (3, 2, 2)]
    other = skfem.MeshHex.init_tensor(*line)
    element = skfem.ElementVector(skfem.ElementHex1())
    basis = skfem.Basis(other, element, intorder=3)
    centres = other.p[:, other.t].mean(1).T
    number = {tuple(cell): n for n, cell in enumerate(mesh.cells.tolist())}
    e = modulus[[number[tuple(np.floor(c).astype(int).tolist())] for c in centres]]
    bulk, shear = e / (3 * (1 - 2 * POISSON)), e / (2 * (1 + POISSON))

    @skfem.BilinearForm
    def deviatoric(u, v, w):  # type: ignore[no-untyped-def]
        strain = sym_grad(u)
        return 2 * w["g"] * (ddot(strain, sym_grad(v)) - trace(strain) * trace(sym_grad(v)) / 3)

    matrix = deviatoric.assemble(basis, g=np.broadcast_to(shear[:, None], basis.dx.shape)).toarray()
    for n in range(len(centres)):  # K / V (∫ div u) (∫ div v) of each cube
        single = skfem.Basis(other, element, intorder=3, elements=np.array([n]))
        volume = skfem.LinearForm(lambda v, w: div(v)).assemble(single)
        matrix += bulk[n] * np.outer(volume, volume)
    stiffness = elastic_stiffness(modulus[:, None].repeat(8, 1), POISSON)
    ours = Assembler(mesh).matrix(stiffness, np.zeros((len(mesh.nodes), 3, 3))).toarray()
    theirs = np.empty(3 * len(mesh.nodes), int)
    order_theirs = np.lexsort(other.p)
    theirs[(3 * order[:, None] + np.arange(3)).ravel()] = basis.nodal_dofs.T[order_theirs].ravel()
    np.testing.assert_allclose(ours, matrix[np.ix_(theirs, theirs)], atol=1e-12 * matrix.max())


def test_cantilever_bends_as_timoshenko_says() -> None:
    """100 × 10 × 10 mm, clamped at one end, 100 N at the other; Cowper's shear coefficient 10 (1 + ν) / (12 + 11 ν)."""
    size, modulus, force = 1.25, 1000.0, 100.0
    mesh = bar((80, 8, 8), size)
    assembler = Assembler(mesh)
    springs = np.zeros((len(mesh.nodes), 3, 3))
    springs[mesh.nodes[:, 0] == 0] = 1e9 * np.eye(3)
    stiffness = elastic_stiffness(np.full((len(mesh.elements), 8), modulus), POISSON)
    matrix = assembler.matrix(size * stiffness, springs)
    end = mesh.nodes[:, 0] == 100
    load = np.zeros((len(mesh.nodes), 3))
    share = np.where((mesh.nodes[end, 1:] % 10 == 0), 0.5, 1.0).prod(1)
    load[end, 2] = force * share / share.sum()
    u = Solver(matrix, mesh.nodes, CPU).solve(matrix, load.ravel(), 1e-9).reshape(-1, 3)
    inertia, shear_modulus = 10**4 / 12, modulus / (2 * (1 + POISSON))
    coefficient = 10 * (1 + POISSON) / (12 + 11 * POISSON)
    expected = force * 100**3 / (3 * modulus * inertia) + force * 100 / (coefficient * shear_modulus * 100)
    assert u[end, 2].mean() == pytest.approx(expected, rel=0.02)
    np.testing.assert_allclose(matrix @ u.ravel(), load.ravel(), atol=1e-6 * force)


@pytest.mark.parametrize(("mean_only", "error"), [(False, 0.06), (True, 0.3)])
def test_a_half_filled_element_bends_as_thick_as_it_is_filled(mean_only: bool, error: float) -> None:
    """A beam 5 mm high of elements of 2 mm, the uppermost filled to the half.

    With a modulus at each Gauss point it bends as it should. With the element's mean it is a quarter too stiff: half
    the modulus in the whole element lies further out.
    """
    size, modulus, force, length, width, height = 2.0, 1000.0, 1.0, 80.0, 4.0, 5.0
    mesh = bar((40, 2, 3), size)
    filled = np.ones((len(mesh.elements), 8))
    filled[(mesh.cells[:, 2] == 2)[:, None] & (CORNERS[:, 2] == 1)] = 0.0
    moduli = modulus * np.maximum(filled.mean(1, keepdims=True) if mean_only else filled, 0.005)
    moduli = np.broadcast_to(moduli, filled.shape)
    assembler = Assembler(mesh)
    springs = np.zeros((len(mesh.nodes), 3, 3))
    springs[mesh.nodes[:, 0] == 0] = 1e7 * np.eye(3)
    matrix = assembler.matrix(size * elastic_stiffness(moduli, POISSON), springs)
    end = (mesh.nodes[:, 0] == length) & (mesh.nodes[:, 2] < 5)
    load = np.where(end, force / end.sum(), 0.0)[:, None] * [0.0, 0.0, 1.0]
    u = spsolve(matrix.tocsc(), load.ravel()).reshape(-1, 3)
    inertia, shear_modulus = width * height**3 / 12, modulus / (2 * (1 + POISSON))
    expected = force * length**3 / (3 * modulus * inertia) + force * length / (5 / 6 * shear_modulus * width * height)
    found = expected / u[end, 2].mean() - 1  # how much too stiff
    assert (found > 0.15) == mean_only
    assert abs(found) < error


def cube(tension: float, compression: float) -> Plasticity:
    one = np.ones((1, 8))
    return Plasticity(Material(1000 * one, tension * one, compression * one), POISSON)


def uniaxial(law: Plasticity, strain: float) -> float:
    """Stress along x of a cube stretched by `strain` in x and free in y and z."""
    across = -POISSON * strain
    state = law.fresh()
    for share in np.linspace(0.1, 1, 10):  # the cross strain that leaves no stress across, by bisection
        low, high = -strain * share - np.sign(strain), strain * share + np.sign(strain)
        for _ in range(80):
            across = (low + high) / 2
            u = CORNERS * [strain * share, across, across]
            response = law.respond(u.reshape(1, 24), 1.0, state)
            side = response.force[0].reshape(8, 3)[CORNERS[:, 1] == 1, 1].sum()
            low, high = (low, across) if side * np.sign(high - low) > 0 else (across, high)
        state = response.state
    return float(response.force[0].reshape(8, 3)[CORNERS[:, 0] == 1, 0].sum())


@pytest.mark.parametrize(("tension", "compression"), [(10.0, 10.0), (6.1, 8.5)])
def test_a_cube_yields_at_its_strengths(tension: float, compression: float) -> None:
    law = cube(tension, compression)
    assert uniaxial(law, 0.003) == pytest.approx(3.0, rel=1e-9)  # elastic: E times strain
    assert uniaxial(law, 0.04) == pytest.approx(tension, rel=1e-3)
    assert uniaxial(law, -0.04) == pytest.approx(-compression, rel=1e-3)


def test_the_tangent_is_the_derivative_of_the_forces() -> None:
    rng = np.random.default_rng(3)
    strength = rng.uniform(6, 10, (4, 8))
    law = Plasticity(Material(rng.uniform(500, 1500, (4, 8)), strength, strength), POISSON)
    u = rng.normal(size=(4, 24)) * 0.01
    state = law.respond(u * 0.7, 1.0, law.fresh()).state
    response = law.respond(u, 1.0, state)
    assert 0 < (response.share < 1).mean() <= 1
    tangent = law.tangent(response)
    step = 1e-7
    for n in range(24):
        change = np.zeros(24)
        change[n] = step
        difference = (law.respond(u + change, 1.0, state).force - law.respond(u - change, 1.0, state).force) / (
            2 * step
        )
        np.testing.assert_allclose(tangent[:, :, n], difference, atol=2e-6 * np.abs(tangent).max())


def test_plastic_flow_keeps_the_volume_and_unloading_is_elastic() -> None:
    law = cube(5.0, 5.0)
    u = (CORNERS * [0.05, 0.0, 0.0]).reshape(1, 24)
    response = law.respond(u, 1.0, law.fresh())
    np.testing.assert_allclose(response.state.strain[..., :3].sum(-1), 0, atol=1e-15)
    np.testing.assert_allclose(response.mises, 5.0)
    back = law.respond(u * 0.999, 1.0, response.state)
    assert (back.share == 1).all()
    assert template().dilatation @ u[0] == pytest.approx(0.05)
