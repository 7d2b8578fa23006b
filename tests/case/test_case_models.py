"""Models of a case: a material by HU or by name, bodies of one file, parts in files of their own."""

from pathlib import Path
from typing import Any

import pytest
import yaml

from femoreg_torch.case import Model, Part, read_case, write_case
from femoreg_torch.errors import InputError
from femoreg_torch.volume.materials import material_hu

EYE = [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 600], [0, 0, 0, 1]]
FILES = ("device.stl", "handle.stl", "device.3mf", "labels.nii.gz", "view.tif")


def write(folder: Path, model: dict[str, Any]) -> Path:
    for name in FILES:
        (folder / name).write_bytes(b"some")
    content = {
        "version": 2,
        "objects": {"tool": model | {"start": {"camera1_from": EYE}}},
        "carm": "cios_fusion",
        "views": [{"image": "view.tif"}],
    }
    (folder / "case.yaml").write_text(yaml.safe_dump(content, sort_keys=False), encoding="utf-8")
    return folder


FORMS: list[tuple[dict[str, Any], bool]] = [  # what stands in the file, and whether its materials are known
    ({"model": "device.stl", "hu": 5000.0}, False),
    ({"model": "device.stl", "material": "steel"}, True),
    ({"volume": "labels.nii.gz", "labels": [2], "hu": 5000.0}, False),
    ({"volume": "labels.nii.gz", "labels": [2, 3], "material": "titanium"}, True),
    ({"volume": "labels.nii.gz"}, False),
    ({"model": "device.3mf", "parts": {"sleeve": {"material": "cobalt chromium"}, "handle": {"hu": 900.0}}}, True),
    ({"parts": [{"model": "device.stl", "hu": 900.0}]}, True),
    (
        {
            "parts": [
                {"model": "handle.stl", "hu": 900.0, "name": "handle"},
                {"volume": "labels.nii.gz", "labels": [2], "material": "peek"},
                {"model": "device.stl", "material": "steel"},
            ]
        },
        True,
    ),
]


@pytest.mark.parametrize(("form", "known"), FORMS)
def test_every_form_comes_back(tmp_path: Path, form: dict[str, Any], known: bool) -> None:
    case = read_case(write(tmp_path, form))
    model = case.objects["tool"].model
    assert model is not None
    assert model.materials_known == known
    write_case(tmp_path, case)
    written = yaml.safe_load((tmp_path / "case.yaml").read_text(encoding="utf-8"))["objects"]["tool"]
    del written["start"]
    assert written == form
    assert read_case(tmp_path).objects["tool"].model == model


def test_solids_tell_files_and_hu(tmp_path: Path) -> None:
    model = read_case(write(tmp_path, FORMS[-1][0])).objects["tool"].model
    assert model is not None
    assert [part.path.name for part in model.solids] == ["handle.stl", "labels.nii.gz", "device.stl"]
    assert [part.solid_hu for part in model.solids] == [900, material_hu("peek"), material_hu("steel")]
    assert [part.labels for part in model.solids] == [None, (2,), None]
    assert model.solids[0].name == "handle"
    single = Model(tmp_path / "device.stl", None, material="steel")
    assert single.solids == (Part(tmp_path / "device.stl", material="steel"),)


STEEL = {"material": "steel"}


@pytest.mark.parametrize(
    ("model", "message"),
    [
        ({"model": "device.stl"}, r"tool\.hu: is missing, a number, or `material` in its place"),
        ({"model": "device.stl", "hu": 1, "material": "steel"}, r"tool\.material: `hu` is given too"),
        ({"model": "device.stl", "material": "gold"}, r"tool\.material: steel or cobalt .* pmma .* found 'gold'"),
        ({"model": "device.stl", "material": 3}, r"tool\.material: steel or .* found 3"),
        ({"volume": "labels.nii.gz", "material": "steel"}, r"tool\.material: a `volume` without `labels` holds HU"),
        ({"model": "device.stl", "parts": {"a": STEEL}}, r"tool\.model: device\.stl has no bodies with names"),
        ({"parts": {"a": STEEL}}, r"tool\.model: is missing"),
        ({"model": "device.3mf", "parts": {}}, r"tool\.parts: is empty"),
        ({"model": "device.3mf", "parts": {"a": {}}}, r"tool\.parts\.a\.hu: is missing"),
        ({"model": "device.3mf", "parts": {"a": "steel"}}, r"tool\.parts\.a: a mapping .* found 'steel'"),
        ({"model": "device.3mf", "parts": {"a": STEEL | {"hue": 1}}}, r"parts\.a\.hue: unknown key"),
        ({"model": "device.3mf", "hu": 1, "parts": {"a": STEEL}}, r"tool\.hu: `parts` are given too"),
        ({"model": "device.stl", "parts": [STEEL]}, r"tool\.model: `parts` are given too"),
        ({"material": "peek", "parts": [STEEL]}, r"tool\.material: `parts` are given too"),
        ({"parts": []}, r"tool\.parts: is empty"),
        ({"parts": "all"}, r"tool\.parts: a list of mappings was expected"),
        ({"parts": [STEEL]}, r"tool\.parts\[0\]\.model: is missing"),
        ({"parts": [{"model": "no.stl"}]}, r"tool\.parts\[0\]\.model: .*no such file"),
        ({"parts": [{"model": "device.stl", "points": {}}]}, r"tool\.parts\[0\]\.points: unknown key"),
        ({"parts": [{"volume": "labels.nii.gz", "hu": 1}]}, r"tool\.parts\[0\]\.labels: missing"),
        ({"bones": "femur", "parts": [STEEL]}, r"objects\.tool: either `bones` of .* `volume` or `parts`"),
    ],
)  # fmt: skip
def test_bad_models(tmp_path: Path, model: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError, match=message) as raised:
        read_case(write(tmp_path, model))
    assert "\n" not in str(raised.value)


def test_a_model_is_told_once(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"model a\.stl: has two of `hu`, `material` and `parts`"):
        Model(tmp_path / "a.stl", 5000, material="steel")
    with pytest.raises(InputError, match=r"part a\.stl: either `hu` or `material`"):
        Part(tmp_path / "a.stl")
