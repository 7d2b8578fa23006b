"""`make accuracy`: the procedures of a study registered by a preset, and the section that tells their errors."""

import csv
import hashlib
from collections.abc import Iterable, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch
from joblib import Parallel, delayed, parallel_config

from femoreg_torch.files import read_json, temporary_file, write_json
from femoreg_torch.registration import Plan
from sim.study import figures
from sim.study.cases import Stores, make_case_alone
from sim.study.code import library
from sim.study.page import machine, number, table, write_section
from sim.study.procedures import Procedure, Study
from sim.study.summary import (
    OBJECTS,
    WRONG_DEG,
    WRONG_MM,
    Confusion,
    Record,
    all_quantities,
    confusion,
    relative_is_wrong,
    rows_of_csv,
    run_is_wrong,
    stage_costs,
    statistics,
)
from sim.study.timing import Timing
from sim.study.trial import run_trial


def make_cases(chosen: Sequence[Procedure], study: Study, stores: Stores, jobs: int) -> None:
    """Make the cases that are not there yet, `jobs` at a time and each on one core."""
    with parallel_config(backend="loky", inner_max_num_threads=1):
        Parallel(n_jobs=jobs, verbose=5)(delayed(make_case_alone)(procedure, study, stores) for procedure in chosen)


def register_all(
    chosen: Sequence[Procedure],
    study: Study,
    stores: Stores,
    plan: Plan,
    runs: Path,
    jobs: int,
    reuse: bool = False,
    views: int | None = None,
) -> list[Record]:
    """Records of all procedures, each kept in the folder `runs`, and taken from there if it was made by the same code.

    With `reuse` it is taken whatever code made it. With one job a registration may use all cores, with more each has
    one. `views` uses only so many views of each case.
    """
    runs.mkdir(parents=True, exist_ok=True)
    code = fingerprint(plan, views)
    missing = [p for p in chosen if not _is_kept(runs, p, None if reuse else code)]
    if jobs == 1:
        for procedure in missing:
            _register(procedure, study, stores, plan, runs, code, views)
    else:
        with parallel_config(backend="loky", inner_max_num_threads=1):
            tasks = (delayed(_register)(p, study, stores, plan, runs, code, views, 1) for p in missing)
            Parallel(n_jobs=jobs)(tasks)
    return [read_json(runs / f"{procedure.name}.json") for procedure in chosen]


def _register(
    procedure: Procedure,
    study: Study,
    stores: Stores,
    plan: Plan,
    runs: Path,
    code: str,
    views: int | None,
    threads: int | None = None,
) -> None:
    if threads:
        torch.set_num_threads(threads)
    record = run_trial(stores.case(procedure), procedure, study, plan, views)
    write_json(runs / f"{procedure.name}.json", record | {"code": code})
    print(line_of(record), flush=True)


def _is_kept(runs: Path, procedure: Procedure, code: str | None) -> bool:
    """Whether a record is there, made by this code (None: by any)."""
    path = runs / f"{procedure.name}.json"
    return path.is_file() and code in (None, read_json(path)["code"])


def fingerprint(plan: Plan, views: int | None) -> str:
    """Of the library's code, the network's weights, plan and views: what a record depends on beside its case."""
    return hashlib.sha256(repr((library(), plan, views)).encode()).hexdigest()[:16]


def line_of(record: Record) -> str:
    """One run in one line, for the terminal."""
    name = f"{record['number']:3d} {record['patient']:>6s} {record['side']:5s}"
    if record["refused"] is not None:
        return f"{name} refused: {record['refused']}"
    found = record["errors"]
    parts = [f"{key} {found[key]['mm']:.2f} mm {found[key]['deg']:.2f}°" for key in OBJECTS if key in found]
    verdict = "trusted" if record["trusted"] else "flagged"
    wrong = ", WRONG" if run_is_wrong(record) else ""
    if "relative_mm" in found:
        parts.append(f"relative {found['relative_mm']:.2f} mm")
    return f"{name} {', '.join(parts)}, {record['timings_s']['total']:.0f} s, {verdict}{wrong}"


def write_results(
    records: Sequence[Record], total: int, preset: str, out: Path, docs: Path | None, timing: Timing | None
) -> str:
    """Write `summary.json`, `runs.csv` and the figure into `out`, and a section with the figure into `docs`, if given.

    Returns the section. `total` is the number of procedures that the study has.
    """
    out.mkdir(parents=True, exist_ok=True)
    text = section(records, total, preset, timing)
    figure = figures.error_figure(records, f"Errors of the preset “{preset}” on {len(records)} simulated procedures")
    for folder in (out, *([docs] if docs else [])):
        figures.save(figure, folder / f"accuracy_{preset}.png")
    write_csv(out / "runs.csv", rows_of_csv(records))
    write_json(out / "summary.json", _summary(records, preset))
    if docs:
        write_section(docs, f"Simulated procedures: `{preset}`", text)
    return text


def _summary(records: Sequence[Record], preset: str) -> dict[str, Any]:
    return {
        "preset": preset,
        "runs": len(records),
        "refused": sum(record["refused"] is not None for record in records),
        "statistics": {"/".join(quantity.path): asdict(found) for quantity, found in all_quantities(records)},
        "confusion": {name or "run": asdict(confusion(records, name)) for name in (None, *OBJECTS)},
    }


def write_csv(path: Path, rows: Sequence[dict[str, Any]]) -> None:
    """Rows of one table whose columns are those of all rows together."""
    columns = list(dict.fromkeys(key for row in rows for key in row))
    with temporary_file(path) as part, part.open("w", encoding="utf-8", newline="") as file:
        writer = csv.DictWriter(file, columns)
        writer.writeheader()
        writer.writerows(rows)


def section(records: Sequence[Record], total: int, preset: str, timing: Timing | None) -> str:
    """The Markdown of one preset."""
    refused = [record for record in records if record["refused"] is not None]
    kinds = {kind: [r for r in records if r["kind"] == kind] for kind in ("procedural", "real")}
    parts = [
        f"`make accuracy PRESET={preset}`: {len(records)} of the {total} procedures "
        f"({len(kinds['procedural'])} on procedural patients, {len(kinds['real'])} on real bone shapes), failures "
        "included.",
        _refusals(len(refused), len(records)),
        _versions(records),
        _errors(records, kinds, preset),
        f"![Errors of every run](accuracy_{preset}.png)",
        "### Trust",
        _trust(records),
        *_doubtful(records),
        "### Cost",
        _cost(records, timing),
    ]
    return "\n\n".join(part for part in parts if part)


def _refusals(refused: int, runs: int) -> str:
    if refused == 0:
        return f"All {runs} runs gave poses, so means and deviations are over all of them."
    return (
        f"**{refused} of {runs} runs gave no pose** (the start was refused). They have no error that a mean could "
        f"hold: mean and deviation are over the other {runs - refused}, while median, maximum and all counts "
        "below take them as failures."
    )


def _versions(records: Sequence[Record]) -> str:
    codes = {record["code"] for record in records}
    return f"**The runs come from {len(codes)} versions of the code.**" if len(codes) > 1 else ""


def _errors(records: Sequence[Record], kinds: dict[str, list[Record]], preset: str) -> str:
    own = preset == "fast"
    header = ("mean error", "paper", "mean ± sd", "median", "max", "procedural", "real", "wanted", "")
    rows = []
    for quantity, found in all_quantities(records):
        limit = quantity.wanted if own else quantity.paper
        apart = [number(statistics(part, quantity).mean) for part in kinds.values()]
        met = "met" if found.mean <= limit else "not met"
        rows.append(
            [
                f"{quantity.name}, {quantity.unit}",
                number(quantity.paper),
                f"**{number(found.mean)}** ± {number(found.deviation)}",
                number(found.median),
                number(found.maximum),
                *apart,
                f"{'≤' if own else '<'} {number(limit)}",
                met,
            ]
        )
    return table(header, rows)


def _trust(records: Sequence[Record]) -> str:
    header = ("", "right, trusted", "right, flagged", "**wrong, trusted**", "wrong, flagged")
    rows = [["whole run", *_cells(confusion(records))]]
    rows += [[name, *_cells(confusion(records, name))] for name in OBJECTS]
    whole = confusion(records)
    far = [record for record in records if relative_is_wrong(record)]
    unflagged = sum(record["trusted"] for record in far)
    right = whole.right_trusted + whole.right_flagged
    share = 100 * whole.right_flagged / right if right else float("nan")
    lines = [
        f"- relative error within {WRONG_MM:g} mm: **{len(records) - len(far)} of {len(records)}** (wanted: all but "
        f"one in 60); of the {len(far)} others {unflagged} say that they can be trusted (wanted: 0)",
        f"- wrong and trusted: **{whole.wrong_trusted}** (wanted: 0)",
        f"- right runs flagged: **{whole.right_flagged} of {right}**, {number(share, 1)} % (wanted: at most 5 %)",
    ]
    told = (
        f"Wrong is a pose off by more than {WRONG_MM:g} mm or {WRONG_DEG:g}°; a run is wrong if any object is, or "
        f"entry point to tip by more than {WRONG_MM:g} mm."
    )
    return f"{told}\n\n{table(header, rows)}\n\n" + "\n".join(lines)


def _cells(counts: Confusion) -> list[str]:
    return [str(n) for n in (counts.right_trusted, counts.right_flagged, counts.wrong_trusted, counts.wrong_flagged)]


def _doubtful(records: Sequence[Record]) -> Iterable[str]:
    """The runs that are wrong or flagged, one line each."""
    chosen = [record for record in records if run_is_wrong(record) or not record["trusted"]]
    if not chosen:
        return []
    header = ("run", "pelvis", "femur", "device", "relative", "says", "why")
    rows = []
    for record in chosen:
        name = f"{record['number']}: {record['patient']}, {record['side']}"
        if record["refused"] is not None:
            rows.append([name, "–", "–", "–", "–", "refused", record["refused"].split("/")[-1]])
            continue
        found = record["errors"]
        poses = [f"{found[key]['mm']:.2f} mm, {found[key]['deg']:.2f}°" if key in found else "–" for key in OBJECTS]
        why = "; ".join(record["reasons"])
        says = "trusted" if record["trusted"] else "flagged"
        rows.append([name, *poses, f"{number(found.get('relative_mm', float('nan')))} mm", says, why or "–"])
    return ["Every run that is wrong or flagged:", table(header, rows)]


def _cost(records: Sequence[Record], timing: Timing | None) -> str:
    rows = [[cost.name, f"{cost.evaluations:.0f}", number(cost.seconds)] for cost in stage_costs(records)]
    seconds = [record["timings_s"]["total"] for record in records if record["refused"] is None]
    threads = sorted({record["threads"] for record in records if record["refused"] is None})
    text = [
        "Evaluations (mean; of all images of the stage together) and seconds (median) per run. The seconds were taken "
        f"along the way, with {' or '.join(map(str, threads))} threads per registration, and depend on what else the "
        "machine did.",
        table(("stage", "evaluations", "s"), rows),
    ]
    if seconds:
        middle = sorted(seconds)[len(seconds) // 2]
        text.append(f"Reading, detection, registration and quality together: median {middle:.1f} s.")
    if timing:
        text.append(timing.told())
    return "\n\n".join([*text, f"Measured on: {machine()}"])
