"""The result of a registration, `RUN/result.json`."""

from pathlib import Path
from typing import Any

from femoreg_torch.case.fields import Fields
from femoreg_torch.files import read_json

RESULT_NAME = "result.json"


def read_result(run: Path) -> dict[str, Any]:
    """Content of `run/result.json`, with poses, points and directions as float64 tensors.

    `camera_from_pelvis` (V, 4, 4); `camera1_from_femur`, `camera1_from_device` and `femur_from_device` (4, 4), the last
    two only where a device was registered; `points_camera1` and `directions_camera1` map names to (3,). All else stays
    as JSON gives it. Raises `InputError` for a missing file or a transform that is not rigid.
    """
    path = Path(run) / RESULT_NAME
    fields = Fields(read_json(path), str(path))
    result = dict(fields.content)
    result["camera_from_pelvis"] = fields.transforms("camera_from_pelvis")
    for name in ("camera1_from_femur", "camera1_from_device", "femur_from_device"):
        if name == "camera1_from_femur" or name in fields:
            result[name] = fields.transform(name)
    for name in ("points_camera1", "directions_camera1"):
        points = fields.mapping(name)
        result[name] = {key: points.point(key) for key in points.content if key in points}
    return result
