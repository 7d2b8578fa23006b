"""What each part of a plan is worth: variants of it on the same procedures, a row of means for each."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import yaml
from femoreg_torch.configs import load_preset

from femoreg_torch.errors import InputError
from femoreg_torch.registration import Plan
from femoreg_torch.registration.plan import plan_from
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


def read_variants(path: Path) -> list[Variant]:
    """The variants that stand in a YAML file, in order. Raises `InputError` for a file that is not of that kind."""
    if not path.is_file():
        raise InputError(f"{path}: no such file. Give a YAML file such as configs/study/ablation.yaml.")
    content = yaml.safe_load(path.read_text(encoding="utf-8"))
    if not isinstance(content, dict) or not isinstance(content.get("variants"), list):
        raise InputError(f"{path}: a list under `variants` was expected.")
    try:
        return [Variant(**({"preset": content.get("preset")} | entry)) for entry in content["variants"]]
    except TypeError as error:
        raise InputError(f"{path}: {error}. Keys of a variant: name, preset, without, change, views.") from error


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


def write_ablation(rows: Sequence[Sequence[str]], procedures: int, source: Path, docs: Path | None) -> str:
    """The section of the ablation, put into `docs` if given."""
    text = "\n\n".join(
        [
            f"`make ablation`: the variants of `{source.as_posix()}` on the first {procedures} simulated procedures; "
            "mean errors of the runs that gave poses, evaluations (mean) and seconds of registration (median, taken "
            "along the way).",
            ablation_table(rows),
            f"Measured on: {machine()}",
        ]
    )
    if docs:
        write_section(docs, "Ablation", text)
    return text
