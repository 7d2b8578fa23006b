"""The patient that several tests of studies simulate, made once."""

from collections.abc import Iterator
from pathlib import Path

import pytest
from coarse import coarse_simulation, coarse_stores

from femoreg_torch.registration import run


@pytest.fixture(scope="session")
def coarse_root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with what `coarse` makes."""
    root = tmp_path_factory.mktemp("coarse")
    coarse_stores(root)
    coarse_simulation(root)
    return root


@pytest.fixture(scope="module")
def nothing_in_doubt() -> Iterator[None]:
    """Short plans leave views where they fit nowhere, and to find out why takes long; other tests ask that."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(run, "doubts", lambda *_: ())
        yield
