"""Poses in JSON, as `truth.json` and `result.json` hold them.

`camera_from_<first object>` is where the first object is in every view, which tells the C-arm's poses as well;
`camera1_from_<object>` is where every other one is in camera 1.
"""

from collections.abc import Sequence

from torch import Tensor

from femoreg_torch.case.fields import Fields
from femoreg_torch.geometry import Poses, poses_by_object


def poses_content(poses: Poses, anchor: str) -> dict[str, Tensor]:
    """The entries (V, 4, 4) and (4, 4) of poses; `anchor` is the first object."""
    others = {f"camera1_from_{name}": pose for name, pose in poses.camera1_from.items() if name != anchor}
    return {f"camera_from_{anchor}": poses.camera_from(anchor), **others}


def poses_from(fields: Fields, anchor: str, others: Sequence[str]) -> Poses:
    """Poses of the first object and of `others`. Raises `InputError` for an entry that is missing or not rigid."""
    camera_from_anchor = fields.transforms(f"camera_from_{anchor}")
    return poses_by_object(
        camera_from_anchor, anchor, {name: fields.transform(f"camera1_from_{name}") for name in others}
    )
