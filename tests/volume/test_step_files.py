"""STEP files: solids by name, units, and files that end the reader's process."""

from math import pi
from pathlib import Path

import numpy as np
import pytest

from femoreg_torch.errors import InputError
from femoreg_torch.intake import inspect_path
from femoreg_torch.volume import body_names, read_bodies, read_mesh
from femoreg_torch.volume.step_files import glb_of_step

# a sleeve of 80 mm along z, radii 1.5 and 3 mm, and a handle of 50 × 12 × 16 mm with a bore for it; by build123d 0.13
GUIDE = Path(__file__).parent / "files" / "guide.step"
SLEEVE_MM3 = pi * (3**2 - 1.5**2) * 80
HANDLE_MM3 = 50 * 12 * 16 - pi * 3**2 * 16


def test_solids_come_by_name_in_mm() -> None:
    bodies = read_bodies(GUIDE, ["sleeve", "handle"])
    assert list(bodies) == ["sleeve", "handle"]
    assert bodies["sleeve"].volume == pytest.approx(SLEEVE_MM3, rel=1e-3)
    assert bodies["handle"].volume == pytest.approx(HANDLE_MM3, rel=1e-3)
    assert np.allclose(bodies["sleeve"].bounds, [[-3, -3, -40], [3, 3, 40]], atol=0.01)
    assert np.allclose(bodies["handle"].bounds, [[-5, -6, -38], [45, 6, -22]], atol=0.01)
    radii = np.linalg.norm(bodies["sleeve"].vertices[:, :2], axis=1)
    assert np.minimum(abs(radii - 3), abs(radii - 1.5)).max() < 1e-3


def test_all_solids_together_are_one_surface() -> None:
    assert read_mesh(GUIDE).volume == pytest.approx(SLEEVE_MM3 + HANDLE_MM3, rel=1e-3)


def test_the_unit_that_the_file_names_is_heeded(tmp_path: Path) -> None:
    text = GUIDE.read_text(encoding="utf-8")
    in_metres = text.replace("SI_UNIT(.MILLI.,.METRE.)", "SI_UNIT(.CENTI.,.METRE.)")
    assert in_metres != text
    path = tmp_path / "guide.stp"
    path.write_text(in_metres, encoding="utf-8")
    assert np.allclose(read_mesh(path).extents, 10 * read_mesh(GUIDE).extents, rtol=1e-4)


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("#89 = VECTOR('',#90,1.);", "#89 = VECTOR('',#279,1.);"),  # OpenCASCADE ends the process on it
        ("ISO-10303-21;", "solid guide"),
        ("ADVANCED_FACE", "NO_FACE"),
    ],
    ids=["a direction that is none", "another format", "no face"],
)
def test_a_damaged_file_is_told_in_one_line(tmp_path: Path, old: str, new: str) -> None:
    path = tmp_path / "guide.step"
    text = GUIDE.read_text(encoding="utf-8")
    assert old in text
    path.write_text(text.replace(old, new), encoding="utf-8")
    with pytest.raises(
        InputError, match=r"guide\.step: (cannot be read as STEP|the mesh is open|the mesh holds no triangle)"
    ):
        read_mesh(path)


def test_a_file_that_is_cut_off_is_told(tmp_path: Path) -> None:
    path = tmp_path / "guide.step"
    path.write_bytes(GUIDE.read_bytes()[:9000])
    with pytest.raises(InputError, match=r"guide\.step: cannot be read as STEP: it is damaged, cut off"):
        read_mesh(path)


def test_without_the_package_the_extra_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("femoreg_torch.volume.step_files.find_spec", lambda name: None)
    with pytest.raises(
        InputError, match=r"guide\.step: .*cascadio: pip install 'femoreg-torch\[step\]'\. Or export it as"
    ):
        glb_of_step(GUIDE)


@pytest.mark.parametrize(
    ("names", "found"),
    [((r"H\X2\00FC\X0\lse", "grip 1 / a"), ("Hülse", "grip 1 / a")), (("Body", "Body"), ("Body", "Body_1"))],
    ids=["other letters", "one name twice"],
)
def test_solids_of_any_name_are_kept_apart(names: tuple[str, str], found: tuple[str, str], tmp_path: Path) -> None:
    text = GUIDE.read_text(encoding="utf-8").replace("'sleeve'", f"'{names[0]}'").replace("'handle'", f"'{names[1]}'")
    path = tmp_path / "guide.step"
    path.write_text(text, encoding="utf-8")
    assert body_names(path) == tuple(sorted(found))
    assert read_mesh(path).volume == pytest.approx(SLEEVE_MM3 + HANDLE_MM3, rel=1e-3)


def test_inspect_names_the_solids() -> None:
    assert any(fact.startswith("bodies: handle, sleeve.") for fact in inspect_path(GUIDE).facts)
