"""Ablation: variants of a plan on the same procedures, a row of mean errors for each."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pandas as pd
from femoreg_torch.configs import load_preset

from femoreg_torch.errors import InputError
from femoreg_torch.registration import Plan
from femoreg_torch.registration.plan import plan_from
from femoreg_torch.settings import read_record
from femoreg_torch.statistics.costs import stage_costs
from femoreg_torch.statistics.formats import number, pipe_table
from femoreg_torch.statistics.outcome import WRONG_MM
from femoreg_torch.statistics.quantities import QUANTITIES, RELATIVE
from femoreg_torch.statistics.rows import SECONDS, folder_name
from femoreg_torch.statistics.summary import confusion, statistics, within
from sim.study.page import machine, write_section

_ANY = "*"


@dataclass(frozen=True)
class Variant:
    """A plan made from a preset; see `configs/study/ablation.yaml`."""

    name: str
    preset: str
    without: list[str] = field(default_factory=list)  # names of steps
    change: dict[str, dict[str, Any]] = field(default_factory=dict)  # of a step: keys with new values; * for any step
    views: int | None = None  # the first so many; all if None

    @property
    def condition(self) -> str:
        """Its name as a study's condition, which is part of file names."""
        return folder_name(self.name)


@dataclass(frozen=True)
class _Variants:
    """What `configs/study/ablation.yaml` holds."""

    variants: list[dict[str, Any]]
    preset: str | None = None  # of the variants that name none


def read_variants(name: str | Path) -> list[Variant]:
    """The variants of a preset in `configs/study/` or of a YAML file. Raises `InputError` that names the key."""
    where = f"variants {name}"
    content = read_record(_Variants, load_preset("study", name), where)
    shared = {} if content.preset is None else {"preset": content.preset}
    return [
        read_record(Variant, shared | entry, f"{where}, variants[{number}]")
        for number, entry in enumerate(content.variants, 1)
    ]


def plan_of(variant: Variant) -> Plan:
    """The plan of a variant. A value of null takes a key away. Raises `InputError` for a step that is not there."""
    content = load_preset("registration", variant.preset)
    known = {step["name"] for step in content["steps"]}
    for name in (*variant.without, *variant.change):
        if name not in known | {_ANY}:
            there_are = ", ".join(sorted(known))
            raise InputError(
                f"variant {variant.name}: preset {variant.preset} has no step “{name}”; there are: {there_are}."
            )
    kept = [step for step in content["steps"] if step["name"] not in variant.without]
    steps = [_changed(step, variant.change) for step in kept]
    return plan_from(variant.preset, content | {"steps": steps})


def _changed(step: dict[str, Any], change: dict[str, dict[str, Any]]) -> dict[str, Any]:
    """For any step, only keys that it has already are changed; for one that is named, any."""
    new = {key: value for key, value in change.get(_ANY, {}).items() if key in step} | change.get(step["name"], {})
    return {key: value for key, value in (step | new).items() if value is not None}


def row_of(variant: Variant, rows: pd.DataFrame) -> list[str]:
    """One line of the table."""
    means = [number(statistics(rows, quantity.column).mean, 2) for quantity in QUANTITIES]
    near, counts = within(rows, RELATIVE.column, WRONG_MM), confusion(rows)
    assert counts is not None  # of whole runs there always is one
    seconds = rows[f"{SECONDS}registration"].median() if f"{SECONDS}registration" in rows else float("nan")
    evaluations = [cost.evaluations for cost in stage_costs(rows)]
    costs = [number(sum(evaluations) if evaluations else float("nan"), 0), number(seconds, 1)]
    return [variant.name, *means, f"{near.met} of {len(rows)}", str(counts.wrong_trusted), *costs]


def ablation_table(rows: Sequence[Sequence[str]]) -> str:
    """The table of all variants."""
    labels = [quantity.label for quantity in QUANTITIES]
    header = ("variant", *labels, f"relative ≤ {WRONG_MM:g} mm", "wrong, trusted", "evaluations", "s")
    return pipe_table(header, rows)


def write_ablation(rows: Sequence[Sequence[str]], procedures: int, source: str, docs: Path | None) -> str:
    """The section of the ablation, put into `docs` if given."""
    text = "\n\n".join(
        [
            f"`make ablation`: the variants `{source}` on the first {procedures} simulated procedures; "
            "mean errors of the runs that gave poses, evaluations (mean) and seconds of registration (median, taken "
            "along the way).",
            ablation_table(rows),
            f"Measured on: {machine()}",
        ]
    )
    if docs:
        write_section(docs, "Ablation", text)
    return text
