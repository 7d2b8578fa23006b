"""Files that start a registration by hand: landmarks in the first image, and start poses."""

from pathlib import Path

import torch
from torch import Tensor

from femoreg_torch.case.fields import Fields
from femoreg_torch.delimited import check_decimal_marks, decimal, read_csv
from femoreg_torch.errors import InputError, shortened
from femoreg_torch.files import read_json
from femoreg_torch.volume import read_landmarks

COLUMNS = ("landmark", "column_px", "row_px")
_POSE = "camera1_from_"
_VISIBLE = {  # as spreadsheets and pandas write them
    "1": True, "1.0": True, "true": True, "yes": True, "0": False, "0.0": False, "false": False, "no": False,
}  # fmt: skip
_FARTHEST_PX = 1e5  # of a landmark, which may lie outside of the image


def read_pixels(path: Path) -> dict[str, Tensor]:
    """Landmarks (2,), column and row in pixels of the image as stored, by name.

    A CSV file with the columns landmark, column_px and row_px; where it has a column `visible`, rows with 0 or false
    are left out, and where it has a column `image`, all rows must be of one image. Or 3D Slicer markups and `.fcsv`
    files of the image plane: x is the column, y the row, in the space LPS. Raises `InputError` that names file and row.
    """
    path = Path(path)
    if path.suffix.lower() != ".csv":
        return {name: point[:2] for name, point in read_landmarks(path, None).items()}
    rows = read_csv(path, COLUMNS)
    check_decimal_marks(rows, COLUMNS[1:], str(path))
    if len(images := {row.values.get("image") for row in rows}) > 1:
        raise InputError(f"{path}: holds landmarks of {len(images)} images. Keep the rows of the first view.")
    found: dict[str, Tensor] = {}
    for row in rows:
        number, name = row.line, row.values["landmark"]
        visible = _VISIBLE.get((row.values.get("visible") or "1").lower())
        if visible is None:
            raise InputError(
                f"{path}, line {number}: visible: 1 or 0 was expected, found {shortened(row.values['visible'])}."
            )
        if not visible:
            continue
        if not name or name in found:
            raise InputError(
                f"{path}, line {number}: the name of a landmark was expected, each once; found {shortened(name)}."
            )
        try:
            pixel = torch.tensor([decimal(row.values[key]) for key in COLUMNS[1:]], dtype=torch.float64)
        except ValueError:
            pixel = torch.full((2,), torch.nan)
        if not torch.isfinite(pixel).all() or pixel.abs().max() > _FARTHEST_PX:
            raise InputError(f"{path}, line {number}: two finite numbers, column_px and row_px, were expected.")
        found[name] = pixel
    if not found:
        raise InputError(f"{path}: no row is visible.")
    return found


def read_start_poses(path: Path) -> dict[str, Tensor]:
    """Poses (4, 4) in camera 1 of objects by name, from the entries `camera1_from_<object>` of a JSON file.

    In a result the first object stands as `camera_from_<object>`, a list of which the first matrix counts. Raises
    `InputError` if there is no such entry, or one is not rigid.
    """
    fields = Fields(read_json(Path(path)), str(path))
    poses = {
        key.removeprefix("camera_from_"): fields.transforms(key)[0]
        for key in fields.content
        if key.startswith("camera_from_") and key != "camera_from_camera1"
    }
    poses |= {key.removeprefix(_POSE): fields.transform(key) for key in fields.content if key.startswith(_POSE)}
    if not poses:
        raise InputError(f"{path}: holds no start pose. An entry `{_POSE}<object>`, 4×4 in mm, was expected.")
    return poses
