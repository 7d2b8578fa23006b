"""What all tests share: where the real anatomy is, if it is there at all, and what schemas say of files."""

import json
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numba
import pytest
from hypothesis import settings

# Several processes of tests share the machine's cores. Libraries read these when they are first imported.
if "PYTEST_XDIST_WORKER_COUNT" in os.environ:
    _threads = max(1, (os.cpu_count() or 1) // int(os.environ["PYTEST_XDIST_WORKER_COUNT"]))
    for _library in ("OMP", "OPENBLAS", "MKL", "NUMBA"):
        os.environ.setdefault(f"{_library}_NUM_THREADS", str(_threads))
    numba.config.reload_config()  # pytest has imported it already, to know its warnings

settings.register_profile("untimed", deadline=None)  # on a busy machine anything may take a second
settings.load_profile("untimed")


@pytest.fixture(scope="session")
def data_folder() -> Path:
    """The folder of real anatomy: $FEMOREG_DATA, or `shared/data` beside the checkout. Skips the test if neither is."""
    beside = Path(__file__).resolve().parents[2] / "shared" / "data"
    folder = Path(os.environ.get("FEMOREG_DATA", beside))
    if not folder.is_dir():
        pytest.skip("no real anatomy here: set FEMOREG_DATA to its folder")
    return folder


@pytest.fixture(scope="session")
def against_schema() -> Callable[[str, Any], list[str]]:
    """A function: what is wrong with the content of a file by `docs/reference/<name>.schema.json`, in words."""
    jsonschema = pytest.importorskip("jsonschema")
    folder = Path(__file__).resolve().parents[1] / "docs" / "reference"

    def problems(name: str, content: Any) -> list[str]:
        schema = json.loads((folder / f"{name}.schema.json").read_text(encoding="utf-8"))
        return [error.message for error in jsonschema.Draft202012Validator(schema).iter_errors(content)]

    return problems
