"""Navigation on disk: `navigation.json`, and every transform as an ITK `.tfm` and as 4×4 text."""

from pathlib import Path
from typing import Any

from torch import Tensor

from femoreg_torch.files import write_json, write_text
from femoreg_torch.geometry import invert_rigid
from femoreg_torch.navigation.report import NAVIGATION_NAME, NOTICE

FOLDER_NAME = "navigation"
NAVIGATION_NAMES = (NAVIGATION_NAME, FOLDER_NAME)


def meanings(name: str, tool: str) -> dict[str, str]:
    """What each transform does, of a planned path in the object `name` and of its `tool`."""
    return {
        f"{name}_from_{tool}": f"takes points of the {tool} (CAD, mm) to the {name} (CT, LPS mm)",
        f"correction_in_{tool}": f"moves the {tool}, in its frame as registered, onto the planned path, tip at "
        "entry point",
        "correction_in_base": f"the same motion in the robot's base: base_from_corrected_{tool} = "
        f"this @ base_from_{tool}",
        f"base_from_{name}": f"takes points of the {name} (CT, LPS mm) to the robot's base",
        f"base_from_corrected_{tool}": f"takes points of the {tool} to the robot's base when it stands as planned",
        "base_from_corrected_flange": f"pose of the flange in the robot's base when the {tool} stands as planned",
    }


def write_navigation(folder: Path, content: dict[str, Any]) -> None:
    """Write what `navigation_content` gives into a folder that exists: navigation.json, and navigation/ with the rest.

    To take the place of an older navigation as a whole, write into the folder of `femoreg_torch.files.new_folder`.
    """
    write_json(folder / NAVIGATION_NAME, content)
    (folder / FOLDER_NAME).mkdir(exist_ok=True)
    for name, meaning in meanings(content["object"], content["tool"]).items():
        if name in content:
            notes = [f"{name}: {meaning}", *(f"NOT TRUSTED: {reason}" for reason in content["reasons"]), NOTICE]
            notes = [" ".join(note.split()) for note in notes]
            write_text(folder / FOLDER_NAME / f"{name}.txt", _text(content[name], notes))
            write_text(folder / FOLDER_NAME / f"{name}.tfm", transform_text(content[name], notes))


def _text(b_from_a: Tensor, notes: list[str]) -> str:
    rows = [" ".join(f"{value + 0.0:16.9f}" for value in row) for row in b_from_a.tolist()]
    return "\n".join([*(f"# {note}" for note in notes), *rows]) + "\n"


def transform_text(b_from_a: Tensor, notes: list[str]) -> str:
    """An ITK transform file in ITK's direction, which resampling needs: it takes points of b to a.

    3D Slicer reads a `.tfm` so, and turns it about: a model in frame a that is put under it appears in frame b.
    Slicer, developer guide, Transforms: "ITK stores the transform in resampling convention".
    """
    a_from_b = invert_rigid(b_from_a)
    parameters = [*a_from_b[:3, :3].flatten().tolist(), *a_from_b[:3, 3].tolist()]
    lines = [
        "#Insight Transform File V1.0",
        *(f"# {note}" for note in [*notes, "In ITK's direction: TransformPoint is the inverse of this name."]),
        "#Transform 0",
        "Transform: AffineTransform_double_3_3",
        "Parameters: " + " ".join(repr(value + 0.0) for value in parameters),
        "FixedParameters: 0 0 0",
    ]
    return "\n".join(lines) + "\n"
