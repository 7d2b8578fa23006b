"""Loads and gain on finer meshes: with 3 mm close to what finer ones say."""

import dataclasses

import numpy as np
import pytest

from femoreg_torch.planning.calibration import Calibration
from femoreg_torch.planning.convergence import MeshRow, on_mesh
from femoreg_torch.planning.curve import Press
from femoreg_torch.planning.femur import Femur
from femoreg_torch.planning.figures import mesh_figure
from femoreg_torch.planning.loading import make_loading
from femoreg_torch.planning.model import make_bone, make_model
from femoreg_torch.planning.plan import until_yield
from femoreg_torch.planning.prepare import Prepared
from femoreg_torch.planning.settings import Planning
from femoreg_torch.volume import Volume


def prepared_femur(ct: Volume, femur: Femur, planning: Planning, size_mm: float) -> Prepared:
    bone = make_bone(femur, Calibration("uncalibrated", 0.000887, 0.0633, {}), planning)
    model = make_model(bone, planning, size_mm)
    loading = make_loading(model, femur, planning.load)
    press = Press(model.mesh, loading, planning.bone.poisson)
    return until_yield(Prepared(ct, bone, model, press, planning))


def in_the_neck(prepared: Prepared) -> np.ndarray:
    """Cement in the marrow within 13 mm of the middle of the neck."""
    femur = prepared.bone.femur
    points = femur.points(np.argwhere(np.ones(femur.mask.shape, bool))).reshape(*femur.mask.shape, 3)
    near = np.linalg.norm(points - (femur.frame.head + 26 * femur.frame.neck), axis=-1) < 13
    return (near & prepared.bone.marrow).astype(float)


def test_a_row_is_the_model_on_such_elements(
    solids: tuple[Volume, Volume, np.ndarray], femur: Femur, planning: Planning
) -> None:
    quick = dataclasses.replace(planning, curve=dataclasses.replace(planning.curve, step_mm=0.5))
    prepared = prepared_femur(solids[0], femur, quick, 8.0)
    cement = in_the_neck(prepared)
    row = on_mesh(prepared_femur(solids[0], femur, quick, 9.0), cement, 8.0)
    assert row.size_mm == 8.0
    assert row.elements == len(prepared.model.mesh.elements)
    assert row.baseline_n == prepared.curve().yield_load_n
    assert row.gain == pytest.approx(prepared.curve(cement).yield_load_n / row.baseline_n - 1)
    assert row.gain > 0
    finer = MeshRow(6.0, 2 * row.elements, row.baseline_n, row.gain, 3 * row.seconds)
    figure = mesh_figure({"one": [row, finer], "other": [row]})
    assert [axis.get_xlabel() for axis in figure.axes] == ["elements, mm", "elements, mm", "elements"]
    assert [len(axis.lines) for axis in figure.axes] == [2, 2, 2]
    assert [text.get_text() for text in figure.legends[0].texts] == ["one", "other"]


@pytest.mark.long
def test_three_millimetres_agree_with_finer_meshes(
    solids: tuple[Volume, Volume, np.ndarray], femur: Femur, planning: Planning
) -> None:
    prepared = prepared_femur(solids[0], femur, planning, 3.0)
    cement = in_the_neck(prepared)
    rows = [on_mesh(prepared, cement, size) for size in (3.0, 2.0, 1.5)]
    for row in rows:
        assert row.baseline_n == pytest.approx(rows[-1].baseline_n, rel=0.05)
        assert row.gain == pytest.approx(rows[-1].gain, abs=0.03)
