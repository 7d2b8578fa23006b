"""Nothing half-written is left behind, and nothing else is touched."""

import json
from pathlib import Path

import numpy as np
import pytest
import torch

from femoreg_torch.errors import InputError
from femoreg_torch.files import new_folder, read_json, write_json, write_text


def names(folder: Path) -> list[str]:
    return sorted(p.name for p in folder.iterdir())


def test_a_new_folder_appears_only_when_complete(tmp_path: Path) -> None:
    with new_folder(tmp_path / "a" / "run") as built:
        (built / "result.json").write_text("{}")
        assert not (tmp_path / "a" / "run").exists()
    assert names(tmp_path / "a") == ["run"]
    assert names(tmp_path / "a" / "run") == ["result.json"]


def fail_while_building(folder: Path) -> None:
    with new_folder(folder) as built:
        (built / "result.json").write_text("half")
        raise RuntimeError


def test_a_failed_build_leaves_nothing(tmp_path: Path) -> None:
    with pytest.raises(RuntimeError):
        fail_while_building(tmp_path / "run")
    assert names(tmp_path) == []
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "result.json").write_text("old")
    with pytest.raises(RuntimeError):
        fail_while_building(tmp_path / "run")
    assert names(tmp_path) == ["run"]
    assert (tmp_path / "run" / "result.json").read_text() == "old"


def test_only_what_was_built_is_replaced(tmp_path: Path) -> None:
    run = tmp_path / "run"
    (run / "pictures").mkdir(parents=True)
    (run / "pictures" / "old.png").write_text("old")
    (run / "result.json").write_text("old")
    (run / "notes.txt").write_text("mine")
    with new_folder(run) as built:
        (built / "result.json").write_text("new")
        (built / "pictures").mkdir()
        (built / "pictures" / "new.png").write_text("new")
    assert names(run) == ["notes.txt", "pictures", "result.json"]
    assert (run / "notes.txt").read_text() == "mine"
    assert (run / "result.json").read_text() == "new"
    assert names(run / "pictures") == ["new.png"]
    assert names(tmp_path) == ["run"]


def test_a_file_in_the_place_of_a_folder(tmp_path: Path) -> None:
    (tmp_path / "run").write_text("a file")
    with pytest.raises(InputError, match="is a file, a folder was expected"), new_folder(tmp_path / "run"):
        pass


def test_a_file_in_a_folder_that_is_not_there(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="there is no folder"):
        write_text(tmp_path / "no" / "a.txt", "text")


def test_json_is_readable_and_exact_to_nine_decimals(tmp_path: Path) -> None:
    content = {
        "T": torch.eye(4, dtype=torch.float64) / 3,
        "names": ["FH-l", "a [b] c"],
        "path": Path("a/b"),
        "n": np.int64(3),
        "nothing": float("nan"),
        "minus": -1e-12,
        "deep": [{"p": [1, 2.5]}],
    }
    write_json(tmp_path / "a.json", content)
    text = (tmp_path / "a.json").read_text()
    assert "  [0.333333333, 0.0, 0.0, 0.0],\n" in text  # one row of a matrix, one line
    assert "-0.0" not in text
    again = read_json(tmp_path / "a.json")
    assert again == json.loads(text)
    assert again["names"] == ["FH-l", "a [b] c"]
    assert (again["path"], again["n"], again["nothing"], again["deep"]) == ("a/b", 3, None, [{"p": [1, 2.5]}])
    assert names(tmp_path) == ["a.json"]
