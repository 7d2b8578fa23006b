"""How stored pictures show the patient, and the way from them to what a camera at the source sees, and back.

A pinhole camera sees the patient from the source. Pictures are stored as a person looks at them, which is often another
thing: a C-arm whose source stands behind the patient shows the patient's left on the right as well, and so a mirror
image of what its source sees. Pixels are (column, row), centre of the first one at (0, 0).
"""

from dataclasses import dataclass, field
from typing import Literal, get_args

import torch
from torch import Tensor

from femoreg_torch.errors import InputError
from femoreg_torch.geometry import Camera

Source = Literal["anterior", "posterior", "left", "right"]
SOURCES: tuple[Source, ...] = get_args(Source)
TURNS = (0, 90, 180, 270)
_BEAMS = {
    "anterior": (0.0, 1.0, 0.0),
    "posterior": (0.0, -1.0, 0.0),
    "left": (-1.0, 0.0, 0.0),
    "right": (1.0, 0.0, 0.0),
}


def nearest_source(beam: Tensor) -> Source:
    """The side of the patient that the source of a `beam` (3,), from source to detector in LPS, stands on or near."""
    return max(SOURCES, key=lambda source: float(beam @ beam.new_tensor(_BEAMS[source])))


@dataclass(frozen=True)
class Display:
    """How pictures are stored.

    The usual picture stands head up, with the patient's left on its right, or, seen from a side, the patient's front on
    its left. By default the source stands in front of the patient: then that is also what the source sees.
    """

    source: Source = "anterior"  # the side of the patient that the source stands on
    mirrored: bool = False  # against the usual picture
    turned_deg: int = 0  # clockwise, against head up, after it was mirrored
    ignore_header: bool = field(default=False, compare=False)  # what a DICOM header says of all this means nothing

    def __post_init__(self) -> None:
        if self.source not in SOURCES or self.turned_deg not in TURNS:
            raise InputError(f"display: a source of {', '.join(SOURCES)} and a turn of {TURNS} were expected: {self}.")

    @property
    def flipped(self) -> bool:
        """Whether the picture, set upright, is a mirror image of what the source sees."""
        return self.mirrored != (self.source in ("posterior", "right"))

    @property
    def beam(self) -> tuple[float, float, float]:
        """The axis of LPS that the beam runs along, from source to detector, within some tens of degrees."""
        return _BEAMS[self.source]

    @property
    def left_on_left(self) -> bool:
        """Whether what the source sees is a mirror image of what the landmark network knows, patient left on right."""
        return self.source == "posterior"

    @property
    def camera_from_stored(self) -> Tensor:
        """(4, 4), float64: from the frame of the stored picture into the camera's; a reflection where `flipped`.

        Both have their origin at the source and z towards the detector; x runs along columns, y along rows.
        """
        turn = torch.eye(4, dtype=torch.float64)
        quarter = torch.tensor([[0.0, 1, 0, 0], [-1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]], dtype=torch.float64)
        for _ in range(self._quarters):
            turn = quarter @ turn
        if self.flipped:
            turn[0] = -turn[0]
        return turn

    @property
    def _quarters(self) -> int:
        return self.turned_deg // 90

    def to_camera(self, stored: Tensor) -> Tensor:
        """A stored picture (..., H, W) as the source sees it, head up."""
        upright = torch.rot90(stored, self._quarters, (-2, -1))
        return (upright.flip(-1) if self.flipped else upright).contiguous()

    def to_stored(self, image: Tensor) -> Tensor:
        """The inverse of `to_camera`: what the source sees (..., H, W) as a stored picture."""
        upright = image.flip(-1) if self.flipped else image
        return torch.rot90(upright, -self._quarters, (-2, -1)).contiguous()

    def camera(self, stored: Camera) -> Camera:
        """The camera of `to_camera`'s images, given that of the stored pictures."""
        upright = stored.turned(self._quarters)
        return upright.mirrored() if self.flipped else upright

    def stored_camera(self, camera: Camera) -> Camera:
        """The inverse of `camera`."""
        upright = camera.mirrored() if self.flipped else camera
        return upright.turned(-self._quarters)

    def pixels_to_camera(self, pixels: Tensor, camera: Camera) -> Tensor:
        """Places (..., 2) in a stored picture as places in the image of `camera`, which is that of `to_camera`."""
        columns = self.stored_camera(camera).shape[::-1]  # of the picture as it is turned, quarter by quarter
        column, row = pixels.unbind(-1)
        for _ in range(self._quarters):
            column, row = row, columns[0] - 1 - column
            columns = columns[::-1]
        return torch.stack([columns[0] - 1 - column if self.flipped else column, row], -1)

    def pixels_to_stored(self, pixels: Tensor, camera: Camera) -> Tensor:
        """The inverse of `pixels_to_camera`: places (..., 2) in a stored picture."""
        columns = camera.shape[::-1]
        column, row = pixels.unbind(-1)
        column = columns[0] - 1 - column if self.flipped else column
        for _ in range(-self._quarters % 4):
            column, row = row, columns[0] - 1 - column
            columns = columns[::-1]
        return torch.stack([column, row], -1)
