"""YAML that a person wrote a little wrongly: the line is told, and what to write there."""

from collections.abc import Callable
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from femoreg_torch.case.fields import Fields
from femoreg_torch.case.reading import read_fields
from femoreg_torch.commands.main import main
from femoreg_torch.errors import InputError
from femoreg_torch.text import read_yaml_and_lines, yaml_content, yaml_mapping

TAB = "a tab stands where YAML wants spaces. Indent with spaces."
ESCAPE = "in double quotes \\ begins an escape. Write / in its place, or put the value in single quotes."
FAULTS = {
    "tab": ("ct:\n\timage: a\n", 2, TAB),
    "tab below spaces": ("ct:\n  image: a\n\tlabels: b\n", 3, TAB),
    "tab behind a dash": ("views:\n-\tanatomy: a\n", 2, TAB),
    "drive": ('ct:\n  image: "C:\\data\\ct.nii"\n', 2, ESCAPE),
    "drive of users": ('ct:\n  image: "C:\\Users\\ct.nii"\n', 2, ESCAPE),
    "drive, escapes that there are": ('ct:\n  image: "C:\\new\\test.nii"\n', 2, ESCAPE),
    "folder, escapes that there are": ('ct: {image: "images\\test.nii"}\n', 1, ESCAPE),
    "colon": ("version: 2\nside:left\nct:\n  image: a\n", 2, "a space is missing after the colon. Write `side: left`."),
    "colon, first line": ("version:2\nside: left\n", 1, "Write `version: 2`."),
    "colon, last line": ("version: 2\nside:left\n", 2, "Write `side: left`."),
    "colon, below": ("ct:\n  image:a.nii\n  labels: b\n", 2, "Write `image: a.nii`."),
    "colon, every line": ("version:2\nside:left\n", 1, "Write `version: 2`."),
    "colon, in brackets": ("version: 2\ncarm: {sdd_mm:1020}\n", 2, "Write `sdd_mm: 1020`."),
    "dash": ("views:\n  -anatomy: a\n", 2, "a space is missing after the dash."),
    "second dash": ("views:\n  - anatomy: a\n  -anatomy: b\n", 3, "Write `- anatomy: b`."),
    "twice": ("a: 1\nb: 2\na: 3\n", 3, "key 'a' stands there twice, first in line 1. Keep one."),
    "twice, below": ("a: 1\nct:\n  a: 2\n  a: 3\n", 4, "key 'a' stands there twice, first in line 3. Keep one."),
    "quotation mark": ('b: 1\na: "b\nc: d\n', 2, "a quotation mark is opened and not closed. Close it."),
    "apostrophe": ("b: 1\na: 'it's'\n", 2, "Put the value in the other kind of quotation marks."),
    "bracket": ("b: 1\na: [1, 2\nc: 3\n", 2, "a bracket is opened and not closed"),
    "indentation": ("ct:\n  image: a\n   labels: b\n", 3, "its indentation"),
    "less indentation": ("ct:\n   image: a\n  labels: b\n", 3, "its indentation"),
    "colon in a value": ("b: 1\na: see: there\n", 2, "a colon in the value `see: there`. Put the value in quotes."),
    "star": ("b: 1\na: *.tif\n", 2, "`*.tif`: * means something to YAML. Put the value in quotes."),
    "at": ("b: 1\na: @home\n", 2, "@ means something to YAML."),
    "space of a word processor": ("ct:\n\u00a0 image: 1\n", 2, "U+00A0 is no space to YAML."),
}


@pytest.mark.parametrize("kind", FAULTS)
def test_the_line_and_the_way_to_mend_it_are_told(kind: str) -> None:
    text, line, mend = FAULTS[kind]
    for written in (text, text.replace("\n", "\r\n"), "\ufeff" + text):
        with pytest.raises(InputError) as raised:
            yaml_mapping(written.encode(), "case.yaml")
        assert str(raised.value).startswith(f"case.yaml, line {line}: ")
        assert mend in str(raised.value)
        assert "\n" not in str(raised.value)


@pytest.mark.parametrize(
    ("content", "told"),
    [
        (b"a: 1\nb: H\xfcfte\n", "a.yaml, line 2: cannot be read as YAML: the byte 0xFC is none of UTF-8. Save it as"),
        ("a: 1\n".encode("utf-16"), "a.yaml: cannot be read as YAML: it is UTF-16, or no text. Save it as UTF-8."),
    ],
)
def test_other_encodings_are_told(content: bytes, told: str) -> None:
    with pytest.raises(InputError) as raised:
        yaml_mapping(content, "a.yaml")
    assert str(raised.value).startswith(told)


@pytest.mark.parametrize(
    "text",
    [
        'a: "one\\ttwo"', 'a: "one\\n"', "a: C:\\data\\ct.nii", "a: 'C:\\new\\ct.nii'", "a: http://x.org", "-1: a",
        "a: 12:30", '"a:b":', "a: b:c", "- a:b", "a:\n- 1", "{a: 1, b: [c, d]}",
    ],
)  # fmt: skip
def test_what_is_rightly_written_is_read(text: str) -> None:
    assert yaml_content(text, "a.yaml") is not None


WORDS = st.text("abcdefgh", min_size=2, max_size=6)
NUMBERS = st.integers(0, 999).map(str)
BREAKS: dict[str, Callable[[str], str]] = {  # what people do to a line `word: value`
    "tab": lambda line: "\t" + line.lstrip(),
    "colon": lambda line: line.replace(": ", ":"),
    "escape": lambda line: line.partition(":")[0] + ': "D:\\data"',
    "at": lambda line: line.partition(":")[0] + ": @a",
}


@given(st.dictionaries(WORDS, WORDS | NUMBERS, min_size=2, max_size=8), st.sampled_from(sorted(BREAKS)), st.data())
def test_a_broken_line_among_others_is_found(content: dict[str, str], kind: str, data: st.DataObject) -> None:
    lines = ["top:", *(f"  {key}: {value}" for key, value in content.items()), "bottom: 1"]
    at = data.draw(st.integers(1, len(lines) - 2))
    yaml_mapping("\n".join(lines), "a.yaml")
    lines[at] = BREAKS[kind](lines[at])
    with pytest.raises(InputError, match=rf"a\.yaml, line {at + 1}: "):
        yaml_mapping("\n".join(lines), "a.yaml")


@given(st.text(max_size=60) | st.text("a:- \t\n'\"[{*&@\\", max_size=30))
def test_any_text_is_read_or_told_in_one_line(text: str) -> None:
    line = ""
    try:
        yaml_mapping(text.encode(errors="replace"), "a.yaml")
    except InputError as error:
        line = str(error)
    assert "\n" not in line
    assert len(line) < 500


# Lines of keys, in messages on their values.


def test_keys_know_their_lines(tmp_path: Path) -> None:
    (tmp_path / "a.yaml").write_text("a: 1\nb:\n  c: {d: 2}\nviews:\n- e: 1\n\n- {e: 2,\n   f: 3}\n", encoding="utf-8")
    content, lines = read_yaml_and_lines(tmp_path / "a.yaml")
    assert content == {"a": 1, "b": {"c": {"d": 2}}, "views": [{"e": 1}, {"e": 2, "f": 3}]}
    assert lines == {
        "a": 1, "b": 2, "b.c": 3, "b.c.d": 3, "views": 4, "views[0]": 5, "views[0].e": 5, "views[1]": 7,
        "views[1].e": 7, "views[1].f": 8,
    }  # fmt: skip


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("version: 2\nside: [left]\n", "line 2, side: left or right was expected, found ['left']. Write the value"),
        ("version: 2\nct:\n  image:\n  - a.nii\n", "line 3, ct.image: the path of a file was expected, found ['a"),
        ("version: 2\nct: image:a.nii\n", "line 2, ct: a mapping of keys and values was expected, found 'image:a."),
        ("version: 2\nviews:\n  anatomy: a.tif\n", "line 2, views: a list of mappings was expected, found a dict of 1"),
        ("version: 2\nct: {image: none.nii}\n", "line 2, ct.image: 'none.nii': no such file or folder. Paths are rel"),
    ],
)  # fmt: skip
def test_a_value_of_another_kind_is_told_with_its_line(text: str, told: str, tmp_path: Path) -> None:
    (tmp_path / "case.yaml").write_text(text, encoding="utf-8")
    with pytest.raises(InputError) as raised:
        _read(read_fields(tmp_path), tmp_path)
    assert f"case.yaml, {told}" in str(raised.value)


def _read(top: Fields, folder: Path) -> None:
    if "views" in top:
        top.mappings("views")
    elif "side" in top:
        top.choice("side", ("left", "right"))
    else:
        top.mapping("ct").file_path("image", folder, may_be_folder=True)


def test_the_command_tells_it_and_writes_nothing(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "case.yaml").write_text("version: 2\ntemplate: femoroplasty\nside:left\n", encoding="utf-8")
    assert main(["register", str(tmp_path), "--out", str(tmp_path / "run")]) == 2
    told = capsys.readouterr().err
    assert told.endswith(
        "case.yaml, line 3: cannot be read as YAML: a space is missing after the colon. Write `side: left`.\n"
    )
    assert told.count("\n") == 1
    assert not (tmp_path / "run").exists()
