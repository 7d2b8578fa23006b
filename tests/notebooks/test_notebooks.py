"""The notebooks run from the first cell to the last at reduced size, and are committed as they were executed."""

import base64
import re
from pathlib import Path

import nbformat
import pytest
from nbformat import NotebookNode

from notebooks.execute import FOLDER, execute

USUAL = ("one_case_step_by_step",)  # the others: `make docs-test`
APART = (
    "synthetic_fluoroscopy",
    "a_study",
    "projector_and_conventions",
    "own_data",
    "own_parts",
    "what_an_error_costs",
)
NOTEBOOKS = (*USUAL, *APART)
# Of a machine's file system: the beginning of a line, a blank, a bracket or a quotation mark stands before it.
ABSOLUTE_PATH = re.compile(
    r"(?:^|[\s('\"`=])(?:/(?:home|root|tmp|usr|opt|work|Users|private|var|mnt)/|[A-Z]:\\)", re.MULTILINE
)
FIGURE_BYTES, NOTEBOOK_BYTES = 150_000, 600_000


def read(name: str) -> NotebookNode:
    return nbformat.read(FOLDER / f"{name}.ipynb", 4)


def texts_of(notebook: NotebookNode) -> list[str]:
    """Everything that can be read in a notebook: sources, and outputs but for figures."""
    found = [cell.source for cell in notebook.cells]
    for output in outputs_of(notebook):
        found.append(output.get("text", ""))
        found += [content for kind, content in output.get("data", {}).items() if not kind.startswith("image/")]
    return found


def outputs_of(notebook: NotebookNode) -> list[NotebookNode]:
    return [output for cell in notebook.cells if cell.cell_type == "code" for output in cell.outputs]


def figures_of(notebook: NotebookNode) -> list[bytes]:
    contents = (output.get("data", {}).items() for output in outputs_of(notebook))
    return [base64.b64decode(text) for data in contents for kind, text in data if kind.startswith("image/")]


def test_every_notebook_is_tested() -> None:
    assert {path.stem for path in FOLDER.glob("*.ipynb")} == set(NOTEBOOKS)


@pytest.mark.parametrize("name", [*USUAL, *(pytest.param(name, marks=pytest.mark.long) for name in APART)])
def test_a_notebook_runs_at_reduced_size(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("FEMOREG_SMALL", "1")
    monkeypatch.setenv("PYTHONPATH", str(FOLDER.parent))  # this copy of the code, wherever the kernel works
    notebook = read(name)
    for cell in notebook.cells:
        if cell.cell_type == "code":
            cell.outputs = []
    execute(notebook, tmp_path)  # raises for a cell that fails
    assert figures_of(notebook)
    assert (tmp_path / "out").is_dir()


@pytest.mark.parametrize("name", NOTEBOOKS)
def test_a_committed_notebook_was_executed_in_order(name: str) -> None:
    notebook = read(name)
    nbformat.validate(notebook)
    counts = [cell.execution_count for cell in notebook.cells if cell.cell_type == "code"]
    assert counts == list(range(1, len(counts) + 1))
    assert not [output.ename for output in outputs_of(notebook) if output.output_type == "error"]
    assert not [output.text for output in outputs_of(notebook) if output.get("name") == "stderr"]


@pytest.mark.parametrize("name", NOTEBOOKS)
def test_a_committed_notebook_is_small_and_tells_nothing_of_its_machine(name: str) -> None:
    notebook = read(name)
    assert (FOLDER / f"{name}.ipynb").stat().st_size <= NOTEBOOK_BYTES
    figures = figures_of(notebook)
    assert figures
    assert max(map(len, figures)) <= FIGURE_BYTES
    assert not [text for text in texts_of(notebook) if ABSOLUTE_PATH.search(text)]
    assert set(notebook.metadata) == {"kernelspec", "language_info"}
    assert not [cell.metadata for cell in notebook.cells if cell.metadata]


def test_an_absolute_path_is_found() -> None:
    for text in ("File /home/somebody/a.py", "written to '/tmp/x'", "/root/a", "C:\\Users"):
        assert ABSOLUTE_PATH.search(text)
    for text in ("[docs](../docs/study.md)", "out/a_study", "mm/deg", "1/mm"):
        assert not ABSOLUTE_PATH.search(text)
