"""The public names are typed: mypy accepts a user's script, in strict mode, and refuses what is wrong in it."""

import os
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

from femoreg_torch import _PUBLIC

ROOT = Path(__file__).resolve().parents[2]
SCRIPT = Path(__file__).resolve().parent / "users_script.py"
WRONG = """
result: int = femoreg.read_result(Path("run"))
femoreg.register("a folder", preset=3)
femoreg.Level(pixel="3")
"""


def checked(script: Path, folder: Path) -> list[str]:
    """What mypy says of a script in a folder that holds nothing else."""
    settings = ["--strict", "--follow-imports=silent", "--no-error-summary", "--cache-dir", str(folder / "cache")]
    command = [sys.executable, "-m", "mypy", *settings, str(script)]
    where = os.environ | {"MYPYPATH": str(ROOT)}  # as an editable install is not seen by mypy
    ran = subprocess.run(command, cwd=folder, env=where, capture_output=True, encoding="utf-8")
    assert not ran.stderr, ran.stderr
    return ran.stdout.splitlines()


def test_an_installed_package_says_that_it_is_typed() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    assert project["tool"]["setuptools"]["package-data"]["femoreg_torch"] == ["py.typed"]
    assert (ROOT / "femoreg_torch" / "py.typed").is_file()


def test_names_are_told_to_type_checkers_as_well() -> None:
    told = (Path(sys.modules["femoreg_torch"].__file__ or "").parent / "__init__.py").read_text(encoding="utf-8")
    for room, names in _PUBLIC.items():
        for name in names:
            assert f"    from femoreg_torch.{room} import {name} as {name}\n" in told


@pytest.mark.long
def test_mypy_knows_the_public_names(tmp_path: Path) -> None:
    script = tmp_path / "script.py"
    script.write_text(SCRIPT.read_text(encoding="utf-8"), encoding="utf-8")
    assert checked(script, tmp_path) == []
    lines = len(script.read_text(encoding="utf-8").splitlines())
    script.write_text(script.read_text(encoding="utf-8") + WRONG, encoding="utf-8")
    places = {int(line.split(":")[1]) for line in checked(script, tmp_path) if ": error:" in line}
    assert places == {lines + 2, lines + 3, lines + 4}
