"""The house keeps its order: no import runs upwards, and the library gets along with other people's `sim` and `models`.

The order of the packages is models < femoreg_torch < sim < training, and within the library that of `ROOMS`. A module
may import from its own room and from those before it.
"""

import ast
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from graphlib import TopologicalSorter
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
MAY_IMPORT = {
    "models": {"models"},
    "femoreg_torch": {"femoreg_torch", "models"},  # models in detect and segment only, see below
    "sim": {"femoreg_torch", "sim"},
    "training": {"models", "femoreg_torch", "sim", "training"},
}
# What everything stands on, then the order that the data takes, from file to report. `case` stands early: it knows
# anatomy, geometry and volumes only, and `registration` takes a `Case`. `evaluation` compares a result with the case's
# truth, so it comes late.
ROOMS = (
    "errors", "paths", "yaml_faults", "text", "arrays", "tensors", "derivatives", "hdf5_entries", "hdf5", "cores",
    "memory", "exchange", "pictures", "delimited", "files", "extras", "configs", "settings", "extensions",
    "anatomy", "geometry", "volume", "segment", "drr", "fluoro", "case",
    "detect", "pnp", "similarity", "optimize", "registration", "navigation", "neighbours", "planning",
    "evaluation", "review", "beads", "intake", "statistics", "commands", "__main__",
)  # fmt: skip


def modules(package: str) -> list[Path]:
    return sorted((ROOT / package).rglob("*.py"))


def imports(path: Path) -> Iterator[tuple[str, bool]]:
    """Dotted names that a module imports from this project, and whether within a function."""
    here = ".".join(path.relative_to(ROOT).with_suffix("").parts)

    def visit(node: ast.AST, in_function: bool) -> Iterator[tuple[str, bool]]:
        if isinstance(node, ast.Import):
            yield from ((alias.name, in_function) for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{here} imports by a relative path"
            names = [f"{node.module}.{alias.name}" for alias in node.names]
            yield from ((name, in_function) for name in names)
        for child in ast.iter_child_nodes(node):
            yield from visit(
                child, in_function or isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.Lambda)
            )

    for name, in_function in visit(ast.parse(path.read_text(encoding="utf-8")), False):
        if name.split(".")[0] in MAY_IMPORT:
            yield name, in_function


def room(dotted: str) -> str | None:
    """The room of the library that `dotted` belongs to; None for the library's own root or another package."""
    parts = dotted.split(".")
    return parts[1] if parts[0] == "femoreg_torch" and len(parts) > 1 and parts[1] in ROOMS else None


@pytest.mark.parametrize("package", MAY_IMPORT)
def test_no_package_imports_one_above_it(package: str) -> None:
    assert modules(package)
    for path in modules(package):
        for name, _ in imports(path):
            assert name.split(".")[0] in MAY_IMPORT[package], f"{path.relative_to(ROOT)} imports {name}"


def test_the_library_imports_the_networks_where_they_run_and_only_when_one_is_loaded() -> None:
    rooms = [ROOT / "femoreg_torch" / name for name in ("detect", "segment")]
    for path in modules("femoreg_torch"):
        for name, in_function in imports(path):
            if name.split(".")[0] == "models":
                assert in_function, f"{path.relative_to(ROOT)} imports {name} when it is imported"
                assert any(path.is_relative_to(own) for own in rooms), f"{path.relative_to(ROOT)} imports {name}"


def test_every_room_of_the_library_has_its_place() -> None:
    found = {path.stem if path.is_file() else path.name for path in (ROOT / "femoreg_torch").iterdir()}
    assert found - {"__init__", "__pycache__", "py"} <= set(ROOMS)


def test_no_room_of_the_library_imports_a_later_one() -> None:
    for path in modules("femoreg_torch"):
        own = room(".".join(path.relative_to(ROOT).with_suffix("").parts))
        for name, _ in imports(path):
            other = room(name)
            if own and other:
                assert ROOMS.index(other) <= ROOMS.index(own), f"{path.relative_to(ROOT)} imports {name}"


@pytest.mark.parametrize("package", ["models", "sim", "training"])
def test_the_rooms_of_the_other_packages_import_one_way_too(package: str) -> None:
    """Whatever their order is: no ring of imports between sub-packages."""
    rooms = {path.name for path in (ROOT / package).iterdir() if (path / "__init__.py").is_file()}
    needs: dict[str, set[str]] = {name: set() for name in rooms}
    for path in modules(package):
        own, *_ = path.relative_to(ROOT / package).parts
        others = {name.split(".")[1] for name, _ in imports(path) if name.startswith(f"{package}.")}
        if own in rooms:
            needs[own] |= (others & rooms) - {own}
    TopologicalSorter(needs).prepare()  # raises CycleError, which names the ring


def test_every_package_is_installed() -> None:
    listed = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["tool"]["setuptools"]["packages"]
    folders = {path.parent for package in MAY_IMPORT for path in modules(package) if path.name == "__init__.py"}
    found = {".".join(folder.relative_to(ROOT).parts) for folder in folders}
    assert set(listed) == found | {"femoreg_torch.configs"}  # which is the folder configs/


@pytest.fixture
def foreign_folder(tmp_path: Path) -> Path:
    """A folder in which `models`, `sim`, `training` and `configs` are somebody else's."""
    (tmp_path / "models.py").write_text("raise RuntimeError('the models of somebody else')\n", encoding="utf-8")
    for name in ("sim", "training", "configs"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "__init__.py").write_text(
            f"raise RuntimeError('the {name} of somebody else')\n", encoding="utf-8"
        )
    return tmp_path


@pytest.mark.parametrize(
    "command",
    [
        [
            sys.executable,
            "-c",
            "import femoreg_torch, femoreg_torch.case, femoreg_torch.registration, femoreg_torch.detect",
        ],
        [sys.executable, "-m", "femoreg_torch.commands.main", "register", "--help"],
        [str(Path(sys.executable).with_name("femoreg")), "register", "--help"],
        [sys.executable, "-m", "femoreg_torch.commands.main", "--help"],
    ],
    ids=["import", "python -m register", "femoreg register", "overview"],
)
def test_the_library_works_beside_packages_of_the_same_names(foreign_folder: Path, command: list[str]) -> None:
    done = subprocess.run(command, cwd=foreign_folder, capture_output=True, encoding="utf-8")
    assert done.returncode == 0, done.stderr
    assert done.stderr == ""
