"""The door for YAML and JSON: what is plain comes in as it stands, what is not is refused at once and in one line."""

import time
from pathlib import Path

import pytest
import yaml
from femoreg_torch.configs import load_preset

from femoreg_torch.delimited import read_csv
from femoreg_torch.errors import InputError, in_mm, shortened
from femoreg_torch.files import read_json
from femoreg_torch.text import json_content, read_yaml, yaml_content, yaml_mapping

# 529 bytes that stand for 9¹¹ values
BOMB = "a: &a [x, x, x, x, x, x, x, x, x]\n" + "".join(
    f"{new}: &{new} [{', '.join([f'*{old}'] * 9)}]\n" for old, new in zip("abcdefghij", "bcdefghijk", strict=True)
)


def test_all_presets_come_in_as_pyyaml_reads_them() -> None:
    root = Path(__file__).parents[1] / "configs"
    paths = sorted(root.rglob("*.yaml"))
    assert len(paths) > 20
    for path in paths:
        assert read_yaml(path) == yaml.safe_load(path.read_text(encoding="utf-8")), path


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("1", 1), ("-17", -17), ("1.5", 1.5), ("1e-9", 1e-9), (".5", 0.5), ("true", True), ("FALSE", False),
        ("~", None), ("", None),
        ("'1'", "1"), (".inf", float("inf")), ("[1, a]", [1, "a"]), ("{a: {b: c}}", {"a": {"b": "c"}}),
        ("{a: &x [1], b: *x}", {"a": [1], "b": [1]}), ("1: one", {"1": "one"}), ("\ufeffa: 1", {"a": 1}),
        # what PyYAML makes something else of, or an exception
        ("2020-13-45", "2020-13-45"), ("2020-01-02", "2020-01-02"), ("12:30", "12:30"), ("010", "010"), ("no", "no"),
    ],
)  # fmt: skip
def test_plain_values(text: str, value: object) -> None:
    assert yaml_content(text, "a.yaml") == value


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (BOMB, "holds more than 200000 values"),
        ("[" * 100_000, "more than 50 deep"),
        ("{" * 100_000, "more than 50 deep"),
        ("- " * 1000 + "a", "more than 50 deep"),
        ("a: 1\nb: 2\na: 3", "line 3: key 'a' stands there twice"),
        ("a: !!bool abc", "line 1: tag 'tag:yaml.org,2002:bool'"),
        ("a: !!python/object/apply:os.system [ls]", "line 1: tag"),
        ("a: " + "9" * 5000, "a number of 5000 digits"),
        ("a: 1e999", "is too large"),
        ("a: .nan", "is no number"),
        ("a: &x [*x]", "stands for nothing, or for what it stands in"),
        ("a: *x", "stands for nothing"),
        ("? [a]\n: b", "keys of text"),
        ("a: 1\n---\nb: 2", "a second document"),
        ("a: [1", "cannot be read as YAML"),
        ("a: \x07", "cannot be read as YAML"),
        ("a: \ud800", "cannot be read as YAML"),
        (b"a: \xff", "cannot be read as YAML"),
        ("x" * 2**21, "larger than 1 MB"),
    ],
)
def test_what_is_not_plain_is_refused_at_once(text: str | bytes, message: str) -> None:
    began = time.perf_counter()
    with pytest.raises(InputError, match=message) as raised:
        yaml_content(text, "a.yaml")
    assert time.perf_counter() - began < 2
    assert str(raised.value).startswith("a.yaml")
    assert len(str(raised.value)) < 400
    assert "\n" not in str(raised.value)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("[" * 100_000, "more than 50 deep"),
        ('{"a": ' * 60 + "1" + "}" * 60, "more than 50 deep"),
        ("9" * 5000, "a number of 5000 digits"),
        ("[1e999]", "is too large"),
        ("[NaN]", "NaN is no number of JSON"),
        ("[-Infinity]", "-Infinity is no number of JSON"),
        ('{"a": 1, "a": 2}', "key 'a' stands there twice"),
        (b"\xff", "cannot be read as JSON"),
        ('{"a": 1,}', "cannot be read as JSON"),
        ("", "is empty"),
        (" \n", "is empty, JSON was expected"),
    ],
)
def test_json_alike(text: str | bytes, message: str, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=message):
        json_content(text, "a.json")
    (tmp_path / "a.json").write_bytes(text if isinstance(text, bytes) else text.encode())
    with pytest.raises(InputError, match=message) as raised:
        read_json(tmp_path / "a.json")
    assert "\n" not in str(raised.value)


def test_slicer_may_write_nan_where_a_point_was_not_placed(tmp_path: Path) -> None:
    (tmp_path / "a.json").write_text('{"a": NaN}', encoding="utf-8")
    assert str(read_json(tmp_path / "a.json", with_nan=True)) == "{'a': nan}"


def test_tables_are_text(tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(InputError, match="cannot be read as CSV"):
        read_csv(tmp_path / "a.csv", ("a",))
    (tmp_path / "b.csv").write_text("a,b\n" + "x" * 200_000, encoding="utf-8")
    with pytest.raises(InputError, match="cannot be read as CSV"):
        read_csv(tmp_path / "b.csv", ("a",))


def test_files_that_are_none(tmp_path: Path) -> None:
    (tmp_path / "loop.yaml").symlink_to(tmp_path / "loop.yaml")
    for path in (tmp_path / "no.yaml", tmp_path, tmp_path / "loop.yaml", Path("/dev/zero"), tmp_path / ("x" * 300)):
        with pytest.raises(InputError):
            read_yaml(path)
    with pytest.raises(InputError, match="no carm preset"):
        load_preset("carm", "x" * 100_000)


def test_no_value_is_printed_as_a_whole() -> None:
    assert shortened("a" * 10_000).startswith("'aaa")
    assert len(shortened("a" * 10_000)) == 60
    assert shortened([1, "two", None]) == "[1, 'two', None]"
    assert shortened([[1]]) == "a list of 1"
    assert shortened({"a": 1}) == "a dict of 1"
    assert len(shortened(["a" * 1000] * 4)) <= 60
    assert len(shortened(10**17)) < 60


def test_a_missing_file_is_named_once(tmp_path: Path) -> None:
    with pytest.raises(InputError) as told:
        read_yaml(tmp_path / "case.yaml")
    assert str(told.value) == f"{tmp_path / 'case.yaml'}: no such file."


@pytest.mark.parametrize(
    ("length", "told"), [(0.1234, "0.123 mm"), (99.96, "100 mm"), (60000.4, "60000 mm"), (3.2e30, "3.2e+30 mm")]
)
def test_lengths_are_told_as_people_write_them(length: float, told: str) -> None:
    assert in_mm(length) == told


@pytest.mark.parametrize("text", ["", "# nothing but a remark\n", "~\n"])
def test_an_empty_file_is_called_so(text: str) -> None:
    with pytest.raises(InputError, match=r"a\.yaml: is empty, a mapping of keys and values was expected"):
        yaml_mapping(text, "a.yaml")
