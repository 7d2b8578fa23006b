"""Records of settings: types, ranges, and no code from data."""

import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest

from femoreg_torch.errors import InputError
from femoreg_torch.settings import check_rising, check_within, read_record


@dataclass(frozen=True)
class Inner:
    share: float = 0.5
    pair: tuple[float, float] = (1.0, 2.0)

    def __post_init__(self) -> None:
        check_within(self, share=(0, 1), pair=(-10, 10))
        check_rising(self, "pair")


@dataclass(frozen=True)
class Outer:
    inner: Inner
    other: Inner | None = None
    several: list[Inner] = field(default_factory=list)
    either: float | tuple[float, float] = 1.0
    free: dict[str, Any] = field(default_factory=dict)
    most: float | None = None

    def __post_init__(self) -> None:
        check_within(self, either=(0, 5), most=(0, 5))


def test_what_fits_is_read() -> None:
    content = {
        "inner": {"share": 1},
        "several": [{"pair": [2, 3]}],
        "either": [1, 2],
        "free": {"a": None},
        "most": None,
    }
    expected = Outer(Inner(1.0), None, [Inner(pair=(2.0, 3.0))], (1.0, 2.0), {"a": None})
    assert read_record(Outer, content, "a.yaml") == expected


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ([], "a.yaml: a mapping"),
        ({"inner": {"share": 1.5}}, "share: 0 to 1 was expected, found 1.5"),
        ({"inner": {"share": float("inf")}}, "share: 0 to 1 was expected, found inf"),
        ({"inner": {"share": True}}, "inner.share"),
        ({"inner": {"share": None}}, "a.yaml, inner, share: a value was expected, found null"),
        ({"inner": {"pair": [3, 2]}}, "pair: low and high"),
        ({"inner": {"pair": [1]}}, "inner.pair"),
        ({"inner": {"sharp": 1}}, "a.yaml, inner: unknown key 'sharp'. Known keys: share, pair"),
        ({"inner": {}, "several": {"share": 1}}, "several"),
        ({"inner": {}, "several": [{"sharp": 1}]}, r"a.yaml, several\[0\]: unknown key 'sharp'"),
        ({"inner": {}, "either": [1, 9]}, "either: 0 to 5"),
        ({"inner": {}, "either": "x" * 100_000}, "either"),
        ({"inner": None}, "a.yaml, inner: a value was expected"),
        ({"x" * 100_000: 1}, "unknown key"),
    ],
)
def test_what_does_not_fit_is_one_line(content: Any, message: str) -> None:
    with pytest.raises(InputError, match=message) as raised:
        read_record(Outer, content, "a.yaml")
    assert "\n" not in str(raised.value)
    assert len(str(raised.value)) < 500


@pytest.mark.parametrize(
    "content",
    [
        {"inner": "evil_module.Inner"},
        {"inner": {"class_path": "evil_module.Inner"}},
        {"inner": {}, "other": "evil_module.Inner"},
        {"inner": {}, "several": ["evil_module.Inner"]},
        {"inner": {"__path__": "evil_module"}},
    ],
)
def test_no_module_is_imported_that_a_file_names(
    content: dict[str, Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "evil_module.py").write_text("class Inner:\n    pass\n", encoding="utf-8")
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(InputError, match=r"a mapping|unknown key"):
        read_record(Outer, content, "a.yaml")
    assert "evil_module" not in sys.modules


_ALIASES = "[" + ", ".join(f"&a{n} [{', '.join([f'*a{n - 1}' if n else 'x'] * 9)}]" for n in range(5)) + "]"


def test_aliases_within_a_text_are_not_followed() -> None:
    """jsonargparse reads a text as YAML where a number was expected, and quotes all that it stands for."""
    contents = ({"inner": {"share": _ALIASES}}, {"inner": {}, "free": {"a": ["b", _ALIASES]}})
    for content, place in zip(contents, (r"'inner', 'share'", r"'free', 'a'\[1\]"), strict=True):
        with pytest.raises(InputError, match=rf"preset, {place}: .* holds aliases \(\*\)"):
            read_record(Outer, content, "preset")
    assert read_record(Outer, {"inner": {}, "free": {"a": "b & *c"}}, "preset").free == {"a": "b & *c"}  # no list
