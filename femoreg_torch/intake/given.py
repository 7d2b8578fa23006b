"""What a new case is made of, and how its files come into it."""

import re
import shutil
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from femoreg_torch.case.model import Intensity, Side
from femoreg_torch.fluoro import Source
from femoreg_torch.volume.itk import DETACHED, read_itk
from femoreg_torch.volume.reading import write_image


@dataclass(frozen=True)
class NewCase:
    """What a case is made of; what is None or empty was not given. See the command's help."""

    ct: Path | None = None
    series: str | None = None
    labels: Path | None = None
    bones: str | None = None
    landmarks: Path | None = None
    plan: Path | None = None
    side: Side | None = None
    device: Path | None = None
    device_points: Path | None = None
    material: str | None = None
    hu: float | None = None
    guide: str | None = None
    before_entry_mm: float | None = None
    turned_deg: float | None = None
    in_front_mm: float | None = None
    device_transform: Path | None = None
    images: tuple[Path, ...] = ()
    device_images: tuple[Path, ...] = ()
    carm: str | None = None
    intensity: Intensity | None = None
    frames: int | Literal["mean"] | None = None
    source: Source | None = None
    mirrored: bool = False
    turned: int = 0
    ignore_header: bool = False
    segment: bool = False  # labels and landmarks that are not given are found in the CT


def copied(path: Path, folder: Path, stem: str) -> str:
    """Copy a file under a name that says what it is, and return that name.

    A header whose values stand in a file of their own is written together with them.
    """
    if path.name.lower().endswith(DETACHED):
        write_image(folder / f"{stem}.mha", read_itk(path))
        return f"{stem}.mha"
    suffix = next((s for s in (".seg.nrrd", ".nii.gz") if path.name.lower().endswith(s)), path.suffix.lower())
    name = stem + (".dcm" if re.fullmatch(r"\.?\d*", suffix) else suffix)  # scanners end names with numbers
    shutil.copyfile(path, folder / name)
    return name


def short_name(path: Path) -> str:
    """The file with its folder, as images of several folders often bear the same names."""
    return str(Path(path.resolve().parent.name) / path.name)
