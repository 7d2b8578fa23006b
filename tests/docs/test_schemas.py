"""The schemas of files fit what is read and written, and nothing besides."""

import dataclasses
import json
from collections.abc import Callable
from typing import Any, get_type_hints

import pytest
import torch
from page_blocks import ROOT, blocks_of

from femoreg_torch.case import Result
from femoreg_torch.case.femoroplasty_form import DEVICE_STARTS, KEYS
from femoreg_torch.case.models import MODEL_KEYS
from femoreg_torch.case.parts import VIEW_KEYS
from femoreg_torch.case.quality import ObjectQuality
from femoreg_torch.case.reading import _KEYS
from femoreg_torch.case.result_file import result_content
from femoreg_torch.files import plain
from femoreg_torch.geometry import Poses
from femoreg_torch.planning.path import Clearances
from femoreg_torch.planning.settings import Planning
from femoreg_torch.text import yaml_content

jsonschema = pytest.importorskip("jsonschema")
Problems = Callable[[str, Any], list[str]]
MATRIX = [[1.0, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]


def schema(name: str) -> dict[str, Any]:
    found: dict[str, Any] = json.loads((ROOT / f"docs/reference/{name}.schema.json").read_text(encoding="utf-8"))
    return found


def shown_cases() -> list[dict[str, Any]]:
    """The whole cases of the page of conventions, with numbers in place of letters and dots."""
    blocks = [block.code for block in blocks_of("docs/conventions.md") if block.code.startswith("version: 2")]
    texts = [code.replace("[[…], […], […], […]]", str(MATRIX)).replace("[x, y, z]", "[1, 2, 3]") for code in blocks]
    found: list[dict[str, Any]] = [yaml_content(text, "page") for text in texts]
    return found


@pytest.mark.parametrize("name", ["case", "truth", "result", "navigation", "plan", "beads", "truth_uncertainty"])
def test_a_schema_is_one(name: str) -> None:
    jsonschema.Draft202012Validator.check_schema(schema(name))


def test_the_cases_on_the_page_fit(against_schema: Problems) -> None:
    cases = shown_cases()
    assert len(cases) == 2
    for case in cases:
        assert not against_schema("case", case)
        assert against_schema("case", case | {"unknown": 1})
        assert against_schema("case", case | {"version": 3})


def test_a_case_of_version_1_fits(against_schema: Problems) -> None:
    case = shown_cases()[0]
    del case["template"]
    ct = {"image": "ct.nii.gz", "labels": "l.nii.gz", "structures": {"pelvis": [1, 2], "femur_left": [5]}}
    assert not against_schema("case", case | {"version": 1, "ct": ct})
    assert against_schema("case", case | {"version": 1, "ct": ct | {"bones": "femoreg"}})


def test_the_keys_of_a_case_are_those_that_are_read() -> None:
    short, long, first = schema("case")["oneOf"]
    parts = schema("case")["$defs"]
    assert set(short["properties"]) == {"template", *KEYS}
    assert set(first["properties"]) == set(KEYS)
    assert set(long["properties"]) == set(_KEYS)
    assert set(parts["device"]["properties"]) == {*MODEL_KEYS, "points", *DEVICE_STARTS}
    assert set(short["properties"]["views"]["items"]["properties"]) == {"anatomy", "device", *VIEW_KEYS}
    assert set(long["properties"]["views"]["items"]["properties"]) == {"image", "images", *VIEW_KEYS}
    assert set(long["properties"]["objects"]["additionalProperties"]["properties"]) == {
        "bones", *MODEL_KEYS, "reference", "points", "images", "start",
    }  # fmt: skip


def test_a_result_fits(against_schema: Problems) -> None:
    eye = torch.eye(4, dtype=torch.float64)
    quality = ObjectQuality(
        views=(),
        in_plane_uncertainty_mm=0.1,
        common_pull=(0.0, 0.0),
        rotation_deviation_deg=(0.1,) * 3,
        translation_deviation_mm=(0.1,) * 3,
        displacement=None,
        trusted=True,
        reason="all views agree",
    )
    result = Result(Poses(eye[None], {"pelvis": eye, "femur": eye}), {"pelvis": quality, "femur": quality})
    content = json.loads(json.dumps(plain(result_content(result))))
    assert not against_schema("result", content)
    assert against_schema("result", content | {"trusted": "yes"})
    assert against_schema("result", content | {"camera1_from_femur": [[1.0]]})


def test_a_truth_fits(against_schema: Problems) -> None:
    truth = {"camera_from_pelvis": [MATRIX], "camera1_from_femur": MATRIX}
    assert not against_schema("truth", truth)
    assert against_schema("truth", truth | {"camera1_from_femur": MATRIX[:3]})


def test_the_keys_of_a_plan_are_those_of_its_records() -> None:
    """Written plans are held against the schema in the planner's own tests."""
    found = schema("plan")
    assert set(found["properties"]["clearances"]["properties"]) == {f.name for f in dataclasses.fields(Clearances)}
    settings = found["$defs"]["settings"]["properties"]
    for section, record in get_type_hints(Planning).items():
        assert set(settings.pop(section)["properties"]) == {field.name for field in dataclasses.fields(record)}
    assert not settings


def test_the_beads_on_the_page_fit(against_schema: Problems) -> None:
    (shown,) = (block.code for block in blocks_of("docs/beads.md") if block.code.startswith("objects:"))
    content = yaml_content(shown, "page")
    assert not against_schema("beads", content)
    assert against_schema("beads", content | {"unknown": 1})
    device = content["objects"]["device"]
    for wrong in ({"count": 5}, {"points": "ct"}, {"diameter_mm": 0}, {"noise_mm": -1}):
        assert against_schema("beads", content | {"objects": {"device": device | wrong}})
