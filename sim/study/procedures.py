"""Which procedures a study consists of."""

from dataclasses import dataclass

from femoreg_torch.case.model import Side
from femoreg_torch.errors import InputError


@dataclass(frozen=True)
class Procedure:
    """One simulated procedure of a study."""

    number: int  # from 1
    patient: str  # name of a subject, or the seed of a procedural patient
    side: Side | None  # None: a recorded case of something else than a hip
    seed: int

    @property
    def procedural(self) -> bool:
        """Whether the patient is computed from a seed, rather than built around real bone shapes."""
        return self.patient.isdigit()

    @property
    def hip(self) -> Side:
        """The operated side. Raises `InputError` where there is none."""
        if self.side is None:
            raise InputError(f"procedure {self.number}: {self.patient} has no operated side, so it is not simulated.")
        return self.side

    @property
    def name(self) -> str:
        """Unique among the procedures of a study; serves as the name of its folder."""
        return f"{self.number:02d}_{self.patient}_{self.side}"


@dataclass(frozen=True)
class Cohort:
    """Procedures with following seeds, half of them on real bone shapes; see `configs/study/accuracy.yaml`."""

    subjects: list[str]
    per_subject: int
    first_patient: int
    patients: int
    first_seed: int

    def procedures(self) -> list[Procedure]:
        """All of them, so ordered that any first few hold both kinds of patient, all subjects and both sides.

        Procedural patients and subjects take turns while both last; the subjects follow one another in rounds, and
        change sides from round to round.
        """
        sides: tuple[Side, Side] = ("left", "right")
        count = len(self.subjects)
        procedural = [(str(self.first_patient + n), sides[n % 2]) for n in range(self.patients)]
        real = [
            (self.subjects[n % count], sides[(1 + n % count + n // count) % 2]) for n in range(count * self.per_subject)
        ]
        shared = min(len(procedural), len(real))
        turns = [patient for pair in zip(procedural, real, strict=False) for patient in pair]
        turns += procedural[shared:] + real[shared:]
        return [Procedure(n + 1, patient, side, self.first_seed + n) for n, (patient, side) in enumerate(turns)]
