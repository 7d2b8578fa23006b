"""The examples run, and find what they look for."""

import importlib
from pathlib import Path
from types import ModuleType

import pytest

EXAMPLES = Path(__file__).resolve().parents[1] / "examples"


def example(name: str, monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    monkeypatch.syspath_prepend(EXAMPLES)
    return importlib.import_module(name)


def test_a_pose_found_by_adam(monkeypatch: pytest.MonkeyPatch) -> None:
    assert example("own_optimisation", monkeypatch).main() < 0.5  # mm, of 5 at the start


@pytest.mark.parametrize("name", ["own_stages", "own_similarity"])
def test_stages_similarity_and_optimiser_of_ones_own(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    deg, mm = example(name, monkeypatch).main()
    assert deg < 0.5
    assert mm < 1.0


@pytest.mark.long  # `make docs-test`
def test_pelvis_and_both_femora_in_a_fixed_biplane(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    errors = example("biplane", monkeypatch).main(tmp_path)
    assert set(errors) == {"pelvis", "femur_left", "femur_right"}
    assert errors["pelvis"]["mm"] < 0.5
    for bone in errors.values():
        assert bone["mm"] < 1.0
        assert bone["deg"] < 1.0


def test_a_phantom_with_nothing_of_a_hip_in_it(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    errors = example("phantom", monkeypatch).main(tmp_path)
    assert set(errors) == {"block", "rod"}
    for solid in errors.values():
        assert solid["mm"] < 0.5
        assert solid["deg"] < 0.5
