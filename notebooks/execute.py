"""Executes notebooks in place: `python notebooks/execute.py [FILE…]`, all of this folder if none is named.

What is written is the same on every machine but for what the cells themselves print: no times, no paths, no widgets.
"""

import sys
from collections.abc import Sequence
from pathlib import Path

import nbformat
from ipykernel.kernelspec import make_ipkernel_cmd
from jupyter_client.kernelspec import KernelSpec, KernelSpecManager
from jupyter_client.manager import AsyncKernelManager
from nbclient import NotebookClient
from nbformat import NotebookNode
from traitlets import default

FOLDER = Path(__file__).resolve().parent
_CELL_S = 7200  # that a cell may take


class ThisPython(KernelSpecManager):
    """Knows one kernel, the Python that runs this, so that none has to be installed by name."""

    def get_kernel_spec(self, kernel_name: str) -> KernelSpec:
        """The same for every name."""
        return KernelSpec(argv=make_ipkernel_cmd(), display_name="Python 3", language="python")


class Kernel(AsyncKernelManager):
    """Starts that one."""

    @default("kernel_spec_manager")
    def _this_python(self) -> KernelSpecManager:
        return ThisPython(parent=self)


def execute(notebook: NotebookNode, folder: Path) -> None:
    """Run all cells in a fresh kernel that works in `folder`. Raises `CellExecutionError` for the first that fails."""
    resources = {"metadata": {"path": str(folder)}}
    client = NotebookClient(
        notebook, kernel_manager_class=Kernel, timeout=_CELL_S, resources=resources, record_timing=False
    )
    client.execute()


def clean(notebook: NotebookNode) -> None:
    """Leave out what differs from run to run: which Python it was, metadata of the cells, where printing paused."""
    notebook.metadata = {
        "kernelspec": {"name": "python3", "display_name": "Python 3", "language": "python"},
        "language_info": {"name": "python"},
    }
    for cell in notebook.cells:
        cell.metadata = {}
        if cell.cell_type == "code":
            cell.outputs = _joined(cell.outputs)


def _joined(outputs: Sequence[NotebookNode]) -> list[NotebookNode]:
    """The outputs of a cell, with text that was printed in several pieces as one."""
    joined: list[NotebookNode] = []
    for output in outputs:
        last = joined[-1] if joined else None
        if last is not None and output.output_type == last.output_type == "stream" and output.name == last.name:
            last.text += output.text
        else:
            joined.append(output)
    return joined


def main(names: Sequence[str]) -> None:
    """Execute these notebooks, each written when all of its cells have run."""
    for path in map(Path, names or sorted(FOLDER.glob("*.ipynb"))):
        print(f"executing {path.name}", flush=True)
        notebook = nbformat.read(path, 4)
        execute(notebook, path.resolve().parent)
        clean(notebook)
        nbformat.write(notebook, path)


if __name__ == "__main__":
    main(sys.argv[1:])
