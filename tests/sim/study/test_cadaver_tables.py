"""The simulated cadaver study: settings, and the tables that it writes."""

import csv
from pathlib import Path

import pytest
import yaml
from femoreg_torch.configs import load_preset

from femoreg_torch.errors import InputError
from sim.study.__main__ import main
from sim.study.cadaver import NAMES, load_cadaver, write_results

RECORD = {
    "trusted": True,
    "errors": {truth: dict.fromkeys(NAMES, 1.0) for truth in ("measured", "hand", "exact")},
    "deviations": {truth: dict.fromkeys(NAMES, 0.25) for truth in ("measured", "hand", "exact")},
    "truth_errors": {
        truth: {name: {"mm": 0.5, "deg": 0.1} for name in ("femur", "device")} | dict.fromkeys(NAMES, 0.5)
        for truth in ("measured", "hand")
    },
}


def test_the_shipped_study_is_that_of_the_paper() -> None:
    study = load_cadaver("cadaver")
    assert study.trials == 6
    assert study.femur_beads.near_head + study.femur_beads.near_entry_point == 7
    assert (study.femur_beads.diameter_mm, study.device_beads.count, study.device_beads.diameter_mm) == (1.0, 5, 1.5)


@pytest.mark.parametrize(("key", "value", "where"), [("trials", 0, "trials: 1 to 10"), ("side", "up", "side")])
def test_wrong_settings_are_told(tmp_path: Path, key: str, value: object, where: str) -> None:
    path = tmp_path / "study.yaml"
    path.write_text(yaml.safe_dump(load_preset("study", "cadaver") | {key: value}), encoding="utf-8")
    with pytest.raises(InputError, match=where):
        load_cadaver(path)


def test_it_is_a_command_beside_the_other_measurements(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["cadaver", "--settings", "no_such_study"]) == 2
    error = capsys.readouterr().err
    assert error.startswith("sim.study: ")
    assert error.count("\n") == 1


def test_tables_have_every_trial_every_truth_and_the_paper(tmp_path: Path) -> None:
    text = write_results({"I": RECORD, "II": RECORD}, tmp_path)
    assert "| entry point to tip, mm, truth: hand | 1.00 | 1.00 | 1.00 ± 0.00 | 0.25 |" in text
    assert "| entry point to tip, mm, truth: exact | 1.00 | 1.00 | 1.00 ± 0.00 | – |" in text
    assert "| entry point to tip, mm, paper |  |  | 2.64 ± 1.10 | – |" in text
    rows = list(csv.DictReader((tmp_path / "cadaver.csv").open(encoding="utf-8")))
    assert [(row["trial"], row["truth"]) for row in rows] == [
        (trial, truth) for trial in ("I", "II") for truth in ("measured", "hand", "exact")
    ]
