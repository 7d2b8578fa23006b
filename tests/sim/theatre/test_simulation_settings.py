"""Settings of the simulation: every key is read or refused."""

from pathlib import Path

import pytest
import yaml
from femoreg_torch.configs import load_preset

from femoreg_torch.errors import InputError
from sim.theatre.settings import load_simulation


def _written(folder: Path, **content: object) -> Path:
    (folder / "mine.yaml").write_text(yaml.safe_dump(content), encoding="utf-8")
    return folder / "mine.yaml"


def test_a_key_that_is_missing_or_unknown_is_named(tmp_path: Path) -> None:
    paper = load_preset("simulation", "paper")
    without = {key: value for key, value in paper["xray"].items() if key != "kvp"}
    for content, name in (
        (paper | {"xray": without}, "kvp"),
        (paper | {"xray": paper["xray"] | {"kilovolt": 75}}, "kilovolt"),
        (paper | {"bed": "high"}, "bed"),
        ({"xray": paper["xray"]}, "acquisition"),
    ):
        with pytest.raises(InputError, match=name):
            load_simulation(_written(tmp_path, **content))


def test_settings_may_extend_a_preset_and_name_a_carm(tmp_path: Path) -> None:
    found = load_simulation(_written(tmp_path, extends="paper", carm="cios_fusion", xray={"kvp": 60}))
    paper = load_simulation("paper")
    assert (found.carm, found.xray.kvp) == ("cios_fusion", 60)
    assert found.acquisition == paper.acquisition
    assert found.xray.dose_ugy == paper.xray.dose_ugy
    assert paper.carm is None
