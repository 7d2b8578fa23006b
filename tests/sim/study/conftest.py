"""The patient that several tests of studies simulate, made once."""

from pathlib import Path

import pytest
from coarse import coarse_simulation, coarse_stores


@pytest.fixture(scope="session")
def coarse_root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with what `coarse` makes."""
    root = tmp_path_factory.mktemp("coarse")
    coarse_stores(root)
    coarse_simulation(root)
    return root
