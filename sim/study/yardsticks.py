"""The project's own measurements as studies: their cases are made once, and kept for other presets and other code."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

from femoreg_torch.errors import InputError
from femoreg_torch.files import read_json
from sim.study.cases import Stores
from sim.study.conditions import Imaged, body_of, is_made, made_once
from sim.study.procedures import Procedure
from sim.study.protocol import Protocol
from sim.study.record import Record, outcome
from sim.study.store import Run, Store
from sim.study.study import OVERLAYS, Study, cohort_of, runs_of
from sim.study.work import Setting, picture_of, registered


@dataclass(frozen=True)
class Kept:
    """Runs on simulated cases that are kept; where a case is there, whichever code has made it, it is taken."""

    settings: Mapping[str, Setting]
    stores: Stores
    imaged: Imaged
    overlays: Path

    def __call__(self, procedure: Procedure, scratch: Path) -> Callable[[Run], Record]:
        body = body_of(procedure, self.stores, self.imaged, scratch)

        def record(run: Run) -> Record:
            setting = self.settings[run.condition]
            folder = made_once(setting.variation, procedure, setting.simulation, body, self.imaged)
            return registered(setting, procedure, folder, overlay=picture_of(run, self.overlays))[0]

        return record


def plan_yardstick(
    name: str,
    protocol: Protocol,
    settings: Mapping[str, Setting],
    chosen: Sequence[Procedure],
    stores: Stores,
    imaged: Imaged,
    out: Path,
) -> Study:
    """The runs of chosen procedures of a protocol under `settings`, for the folder `out`.

    Cases stand under the name of a setting's variation; several settings may share one. Raises `InputError` for cases
    that were made with other settings.
    """
    runs = runs_of(name, settings, chosen, cohort_of(protocol, protocol.bones))
    lacking = {
        procedure.patient
        for setting in settings.values()
        for procedure in chosen
        if not is_made(setting.variation, procedure, setting.simulation, imaged)
    }
    subjects = [subject for subject in protocol.bones if subject in lacking]
    return Study(runs, Kept(settings, stores, imaged, out.resolve() / OVERLAYS), subjects, stores)


def only_these(settings: Mapping[str, Setting], names: Sequence[str], where: str) -> dict[str, Setting]:
    """The settings of these names, or all if there are no names. Raises `InputError` for a name that is not there."""
    for name in names:
        if name not in settings:
            raise InputError(f"{where}: there is no {name!r}; there are: {', '.join(settings)}.")
    return {name: setting for name, setting in settings.items() if not names or name in names}


def take_earlier(study: Study, out: Path, where: Callable[[Run], Path]) -> int:
    """Take over what versions before the engine have measured: a JSON file per procedure, which `where` tells.

    Only runs without a record get one, and only from a file of the same procedure and preset; it keeps its own code, so
    that only those who ask for runs of other code see it. Returns how many were taken over.
    """
    taken = 0
    for run in study.runs:
        path, known = where(run), asdict(run.procedure)
        if not path.is_file() or Store(out, "").record(run) is not None:
            continue
        old = read_json(path)
        if {key: old.get(key) for key in known} != known or old.get("preset") != run.preset:
            continue
        store = Store(out, old["code"])
        store.prepare()
        store.write(run, {"kind": run.kind, "host": None, "versions": {}} | old | outcome(old))
        taken += 1
    return taken
