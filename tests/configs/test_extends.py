"""Presets by name or file, and files that extend others."""

from pathlib import Path

import pytest
from femoreg_torch.configs import laid_over, load_preset

from femoreg_torch.errors import InputError

BASE = {"a": {"x": 1, "y": 2}, "steps": [{"name": "one", "n": 1}, {"name": "two", "n": 2}], "list": [1, 2]}


def test_mappings_are_laid_over_key_by_key_and_other_values_replaced() -> None:
    assert laid_over(BASE, {"a": {"y": 3}, "list": [9]}, "f") == BASE | {"a": {"x": 1, "y": 3}, "list": [9]}
    assert laid_over(BASE, {"a": {"x": None}, "list": None}, "f") == {"a": {"y": 2}, "steps": BASE["steps"]}


def test_named_entries_are_changed_added_moved_and_removed() -> None:
    changes = [
        {"name": "two", "n": 5},
        {"name": "half", "n": 0, "before": "one"},
        {"name": "more", "n": 7, "after": "one"},
        {"name": "last", "n": 8},
    ]
    steps = laid_over(BASE, {"steps": changes}, "f")["steps"]
    assert [(step["name"], step["n"]) for step in steps] == [
        ("half", 0),
        ("one", 1),
        ("more", 7),
        ("two", 5),
        ("last", 8),
    ]
    assert laid_over(BASE, {"steps": [{"name": "one", "remove": True}]}, "f")["steps"] == [{"name": "two", "n": 2}]
    assert BASE["steps"] == [{"name": "one", "n": 1}, {"name": "two", "n": 2}]


@pytest.mark.parametrize("change", [{"name": "x", "before": "none"}, {"name": "none", "remove": True}])
def test_a_name_that_is_not_there_is_told(change: dict[str, object]) -> None:
    with pytest.raises(InputError, match=r"f, steps: there is no entry named 'none'; there are: “one”, “two”"):
        laid_over(BASE, {"steps": [change]}, "f")


def test_two_changes_of_one_name_are_told() -> None:
    twice = {"steps": [{"name": "one", "n": 2}, {"name": "one", "m": 3}]}
    with pytest.raises(InputError, match="f, steps: 2 entries are named 'one'"):
        laid_over(BASE, twice, "f")


def test_a_file_extends_a_preset_or_a_file_beside_it(tmp_path: Path) -> None:
    (tmp_path / "mine.yaml").write_text("extends: cios_fusion\nsdd_mm: 990\n", encoding="utf-8")
    (tmp_path / "yours.yaml").write_text("extends: mine.yaml\nshape: [768, 768]\n", encoding="utf-8")
    found = load_preset("carm", tmp_path / "yours.yaml")
    assert found == load_preset("carm", "cios_fusion") | {"sdd_mm": 990, "shape": [768, 768]}


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("extends: mine.yaml", r"mine\.yaml: extends itself"),
        ("extends: none.yaml", r"none\.yaml: no such file"),
        ("extends: none", r"no carm preset 'none'; there are: .*cios_fusion"),
        ("extends: [a]", r"mine\.yaml, extends: the name of a preset"),
        ("- a", r"mine\.yaml: a mapping .* found list"),
        ("a: [", r"mine\.yaml, line 1: cannot be read as YAML"),
        ("a: !!bool abc", r"mine\.yaml, line 1: tag .*bool"),
    ],
)
def test_bad_files(tmp_path: Path, text: str, message: str) -> None:
    (tmp_path / "mine.yaml").write_text(text, encoding="utf-8")
    with pytest.raises(InputError, match=message) as raised:
        load_preset("carm", tmp_path / "mine.yaml")
    assert "\n" not in str(raised.value)


def test_a_misspelt_name_of_an_entry_with_a_kind_is_told() -> None:
    base = {"steps": [{"name": "orbit search, coarse", "kind": "orbit_search"}]}
    with pytest.raises(
        InputError, match=r"no entry named 'orbit serch' to change, and a new one needs `kind`; .*“orbit"
    ):
        laid_over(base, {"steps": [{"name": "orbit serch", "step_deg": 1}]}, "f")
    assert laid_over(
        {"vary": [{"name": "one"}]}, {"vary": [{"name": "one", "remove": True}, {"name": "two"}]}, "f"
    ) == {"vary": [{"name": "two"}]}  # of none that is left, no kind is asked
    added = laid_over(base, {"steps": [{"name": "new", "kind": "stage"}]}, "f")
    assert [step["name"] for step in added["steps"]] == ["orbit search, coarse", "new"]
