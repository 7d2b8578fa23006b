"""`python -m sim.study limits`: bounds beside the errors of a study."""

from pathlib import Path

from femoreg_torch.commands.status import DONE
from femoreg_torch.statistics.limit_tables import read_bounds
from femoreg_torch.statistics.study import read_study
from sim.study.limits import limits as limits_of
from sim.study.limits_page import write_limits
from sim.study.protocol import load_protocol


def limits(
    study: Path,
    protocol: str = "paper",
    condition: str | None = None,
    first: int = 6,
    noise_alone: int = 0,
    pixel_mm: float = 0.78,
    docs: Path | None = None,
) -> int:
    """Tell how far a study's errors are from what its images allow: Cramér–Rao bounds, and what each image is worth.

    Procedures are made anew from their seeds, a minute or so each on one core, and images are not. The bounds go to
    STUDY/bounds.parquet; `femoreg tables` and `femoreg report` then tell them beside the errors. Those that are there
    stay.

    Args:
        study: folder of a study by `femoreg study`, of procedural patients.
        protocol: its protocol, a preset of configs/study or a YAML file.
        condition: its condition; the first one of the protocol, if not given.
        first: only the first so many finished runs.
        noise_alone: on so many of these, also register images with nothing but the noise of photons.
        pixel_mm: edge of the pixels that images are seen on.
        docs: folder of the page `limits.md` that is to be renewed, with all bounds of the condition that there are.
    """
    path = limits_of(protocol, study, first, pixel_mm, condition, noise_alone, lambda what: print(what, flush=True))
    print(f"Bounds: {path}. `femoreg tables {study}` tells them.")
    if docs is not None:
        rows, bounds = read_study(study), read_bounds(study)
        assert bounds is not None  # just written
        name = condition or load_protocol(protocol).vary[0].name
        command = f"python -m sim.study limits --protocol {Path(protocol).stem} --condition {name} --first {first}"
        print(write_limits(rows[rows["condition"].eq(name)], bounds, command, study, docs))
    return DONE
