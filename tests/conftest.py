"""What all tests share: where the real anatomy is, if it is there at all."""

import os
from pathlib import Path

import pytest


@pytest.fixture(scope="session")
def data_folder() -> Path:
    """The folder of real anatomy: $FEMOREG_DATA, or `shared/data` beside the checkout. Skips the test if neither is."""
    beside = Path(__file__).resolve().parents[2] / "shared" / "data"
    folder = Path(os.environ.get("FEMOREG_DATA", beside))
    if not folder.is_dir():
        pytest.skip("no real anatomy here: set FEMOREG_DATA to its folder")
    return folder
