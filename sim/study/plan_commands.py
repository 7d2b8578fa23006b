"""`python -m sim.study plans`: what `docs/planning.md` tells."""

from pathlib import Path

from femoreg_torch.commands.status import DONE
from sim.study import plans as planning
from sim.study.chosen import DATA
from sim.study.plans_page import write_plans

_PAPER_RUNS = Path(__file__).resolve().parents[2] / "docs" / "results" / "paper_60"


def plans(
    first: int | None = None,
    meshes: bool = True,
    out: Path = Path("out/plans"),
    data: Path = DATA,
    docs: Path | None = None,
) -> int:
    """Plan cement for three femora, move the plans, compare meshes; goes on where it was stopped.

    What is in OUT counts as done, by whichever version: after a change of the model, name an empty folder.

    Args:
        first: only the first so many femora.
        meshes: compare meshes, which takes as long as all the rest.
        out: folder of cases and plans, and of what was measured so far.
        data: folder with the real CTs in ct/; the environment's FEMOREG_DATA, if set.
        docs: folder of the page that is to be renewed, with all that was measured so far.
    """
    for number, subject in enumerate(planning.SUBJECTS[:first]):
        print(subject.title, flush=True)
        planning.measure(subject, out, data)
        planning.compare_laws(subject, out)
        if number == 0:
            planning.draw_errors(subject, out, _PAPER_RUNS)
        if meshes:
            planning.compare_meshes(subject, out)
    if docs is not None:
        found = [known for subject in planning.SUBJECTS if (known := planning.measured(subject, out)) is not None]
        print(write_plans(found, "make plans", docs))
    return DONE
