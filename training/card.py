"""What a run was trained on and how it went, as a page for the card of its weights."""

from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path

import torch
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator, ScalarEvent

from femoreg_torch.errors import InputError
from femoreg_torch.files import write_text
from femoreg_torch.text import json_content
from sim.patient.writing import ORIGIN_NAME
from training.cohort import CohortSettings
from training.module import OptimisationSettings
from training.settings import TrainingSettings

_PAUSE_S = 600.0  # between two values logged: the run had been stopped
_MEASURES = {  # logged at the end of each epoch, and their columns
    "validation/loss": "loss",
    "validation/landmark_median_px": "landmark error, median in pixels of 3.1 mm",
    "validation/landmark_within_2px": "within 6.2 mm",
    "validation/visibility": "visibility right",
    "validation/pixel_accuracy": "labels right",
}


def write_card(path: Path, settings: TrainingSettings, cases: Sequence[Path], events: Path, epochs: int) -> None:
    """Write the page of a run of so many epochs: its length, its patients, and what was measured after each epoch.

    `events` is its folder of TensorBoard events. Raises `InputError` for an `origin.json` of a case that is no object.
    """
    log = EventAccumulator(str(events), size_guidance={"scalars": 0})
    log.Reload()
    run = settings.run
    parts = ["## The run", _length(log, run.optimisation, epochs), data_table(run.cohort, cases), _epochs(log)]
    write_text(path, "\n\n".join(parts) + "\n")


def data_table(cohort: CohortSettings, cases: Sequence[Path]) -> str:
    """The patients of a run in Markdown: how many images of each, and where they come from by their `origin.json`."""
    rows = [
        "| patient | variants | images | licence | made from |",
        "| --- | --- | --- | --- | --- |",
    ]
    for case in cases:
        licence, source = _origin(case / ORIGIN_NAME)
        images = cohort.case_variants * cohort.views
        rows.append(f"| {case.resolve().name} | {cohort.case_variants} | {images} | {licence} | {source} |")
    for what, seeds in {"": cohort.patient_seeds, ", to validate on": cohort.validation_seeds}.items():
        if seeds:
            name = f"procedural, seed{'s' * (len(seeds) > 1)} {', '.join(map(str, seeds))}{what}"
            images = len(seeds) * cohort.patient_variants * cohort.views
            rows.append(f"| {name} | {cohort.patient_variants} each | {images} | this project | nothing |")
    return "\n".join(rows)


def _origin(path: Path) -> tuple[str, str]:
    """Licence and source of a patient; "not told" for what its file does not say."""
    if not path.exists():
        return "not told", "not told"
    content = json_content(path.read_text(encoding="utf-8"), str(path))
    if not isinstance(content, dict):
        raise InputError(f"{path}: an object with `licence` and `source` was expected.")
    licence, source = (str(content.get(key, "not told")).replace("|", "/") for key in ("licence", "source"))
    return licence, source


def _length(log: EventAccumulator, optimisation: OptimisationSettings, epochs: int) -> str:
    logged = _scalars(log, "train/loss")
    steps, planned = (n * optimisation.batches_per_epoch for n in (epochs, optimisation.epochs))
    early = f", of {planned} steps that were planned" if steps < planned else ""
    pauses = [after.wall_time - before.wall_time for before, after in pairwise(logged)]
    hours = sum(seconds for seconds in pauses if seconds < _PAUSE_S) / 3600
    return (
        f"{steps} steps of {optimisation.batch_size} images ({steps * optimisation.batch_size} images){early}, "
        f"{hours:.1f} hours without pauses, torch {torch.__version__}."
    )


def _epochs(log: EventAccumulator) -> str:
    """A row for each epoch: the step, and what was measured on the patients to validate on."""
    tags = {tag: name for tag, name in _MEASURES.items() if _scalars(log, tag)}
    if not tags:
        return "No patient to validate on."
    values = {tag: {event.step + 1: event.value for event in _scalars(log, tag)} for tag in tags}
    rows = ["| step | " + " | ".join(tags.values()) + " |", "| --- " * (1 + len(tags)) + "|"]
    for step in sorted(values[next(iter(tags))]):
        rows.append(f"| {step} | " + " | ".join(f"{values[tag][step]:.3f}" for tag in tags) + " |")
    return "\n".join(rows)


def _scalars(log: EventAccumulator, tag: str) -> list[ScalarEvent]:
    return log.Scalars(tag) if tag in log.Tags()["scalars"] else []
