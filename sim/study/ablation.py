"""Ablation: variants of a plan on the same procedures, a row of mean errors for each."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from femoreg_torch.configs import load_preset

from femoreg_torch.errors import InputError
from femoreg_torch.registration import Plan
from femoreg_torch.registration.plan import plan_from
from femoreg_torch.settings import read_record
from sim.study.page import machine, number, table, write_section
from sim.study.quantities import QUANTITIES
from sim.study.summary import Record, confusion, relative_is_wrong, statistics

_ANY = "*"


@dataclass(frozen=True)
class Variant:
    """A plan made from a preset; see `configs/study/ablation.yaml`."""

    name: str
    preset: str
    without: list[str] = field(default_factory=list)  # names of steps
    change: dict[str, dict[str, Any]] = field(default_factory=dict)  # of a step: keys with new values; * for any step
    views: int | None = None  # the first so many; all if None


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


def row_of(variant: Variant, records: Sequence[Record]) -> list[str]:
    """One line of the table."""
    seconds = sorted(record["timings_s"]["registration"] for record in records if record["refused"] is None)
    evaluations = [sum(s["evaluations"] for s in record["stages"]) for record in records if record["refused"] is None]
    within = sum(not relative_is_wrong(record) for record in records)
    middle = seconds[len(seconds) // 2] if seconds else float("nan")
    mean = sum(evaluations) / len(evaluations) if evaluations else float("nan")
    means = [number(statistics(records, quantity).mean) for quantity in QUANTITIES]
    counts = confusion(records)
    costs = [f"{mean:.0f}", number(middle, 1)]
    return [variant.name, *means, f"{within} of {len(records)}", str(counts.wrong_trusted), *costs]


def ablation_table(rows: Sequence[Sequence[str]]) -> str:
    """The table of all variants."""
    names = [f"{quantity.name}, {quantity.unit}" for quantity in QUANTITIES]
    return table(("variant", *names, "relative ≤ 4 mm", "wrong, trusted", "evaluations", "s"), rows)


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
