"""The page of a training run: its patients and what was measured."""

import json
from pathlib import Path

import pytest
from torch.utils.tensorboard import SummaryWriter

from femoreg_torch.errors import InputError
from training.card import data_table, write_card
from training.cohort import CohortSettings
from training.settings import read_settings

COHORT = CohortSettings([1, 2], [101], patient_variants=3, case_variants=5, views=10)


def test_patients_are_told_with_their_images_and_where_they_come_from(tmp_path: Path) -> None:
    known, unknown = tmp_path / "known", tmp_path / "unknown"
    for folder in (known, unknown):
        folder.mkdir()
    (known / "origin.json").write_text(json.dumps({"licence": "zlib", "source": "a | b"}), encoding="utf-8")
    table = data_table(COHORT, [known, unknown]).splitlines()
    assert table[2:] == [
        "| known | 5 | 50 | zlib | a / b |",
        "| unknown | 5 | 50 | not told | not told |",
        "| procedural, seeds 1, 2 | 3 each | 60 | this project | nothing |",
        "| procedural, seed 101, to validate on | 3 each | 30 | this project | nothing |",
    ]


def test_an_origin_that_is_no_object_is_refused(tmp_path: Path) -> None:
    (tmp_path / "origin.json").write_text("[1]", encoding="utf-8")
    with pytest.raises(InputError, match="an object with `licence` and `source`"):
        data_table(COHORT, [tmp_path])


def test_pauses_do_not_count_and_every_epoch_has_its_row(tmp_path: Path) -> None:
    events = SummaryWriter(tmp_path / "events")
    for step, seconds in ((0, 0), (1, 360), (2, 720), (3, 9000), (4, 9360)):
        events.add_scalar("train/loss", 1.0, step, walltime=seconds)
    for step, loss in ((1, 0.9), (3, 0.7)):
        events.add_scalar("validation/loss", loss, step)
        events.add_scalar("validation/visibility", 0.5, step)
    events.close()
    settings = read_settings("quick")
    write_card(tmp_path / "card.md", settings, [], tmp_path / "events", settings.run.optimisation.epochs)
    page = (tmp_path / "card.md").read_text(encoding="utf-8")
    assert "240 steps of 8 images (1920 images), 0.3 hours without pauses" in page
    assert "| 2 | 0.900 | 0.500 |\n| 4 | 0.700 | 0.500 |" in page
    write_card(tmp_path / "card.md", settings, [], tmp_path / "events", 2)  # stopped early
    page = (tmp_path / "card.md").read_text(encoding="utf-8")
    assert "80 steps of 8 images (640 images), of 240 steps that were planned, 0.3 hours" in page
