"""What one procedure consists of."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from torch import Tensor

from femoreg_torch.geometry import CArm

Side = Literal["left", "right"]
Intensity = Literal["raw", "log"]  # raw: bone dark, as a detector counts; log: attenuation, bone bright

STRUCTURES = ("pelvis", "femur_left", "femur_right")
DEVICE_POINTS = ("tip", "base", "center")


@dataclass(frozen=True)
class Device:
    """A drilling or injection device: a closed mesh, a labelled volume, or (where `hu` is None) a volume in HU.

    Points (3,) are mm in the device's own space: the mesh's coordinates, or the volume's LPS.
    """

    model_path: Path
    hu: float | None  # of its material
    points: dict[str, Tensor]  # tip, base (guide axis: base → tip) and center (where errors are reported)
    camera1_from_device: Tensor  # (4, 4), nominal start pose
    labels: tuple[int, ...] | None = None  # of its voxels in a labelled volume


@dataclass(frozen=True)
class View:
    """The images of one C-arm pose."""

    anatomy: Path
    device: Path | None = None
    intensity: Intensity = "raw"


@dataclass(frozen=True)
class Truth:
    """Known poses of a simulated procedure; `pelvis` and `femur` are the CT's, LPS mm."""

    camera_from_pelvis: Tensor  # (V, 4, 4)
    camera1_from_femur: Tensor  # (4, 4)
    camera1_from_device: Tensor | None = None  # (4, 4)


@dataclass(frozen=True)
class Case:
    """One procedure. Points are LPS mm, all tensors float64."""

    folder: Path
    side: Side  # operated femur
    ct_path: Path
    labels_path: Path | None
    structures: dict[str, tuple[int, ...]]  # label ids of pelvis, femur_left, femur_right
    landmarks: dict[str, Tensor]  # (3,) each, in the order of HIP_LANDMARKS
    entry_point: Tensor  # (3,)
    target: Tensor  # (3,), where the planned path ends
    device: Device | None
    carm: CArm
    views: tuple[View, ...] = field(default=())
    truth: Truth | None = None

    @property
    def femur(self) -> str:
        """Name of the operated femur's structure."""
        return f"femur_{self.side}"

    @property
    def femoral_head(self) -> Tensor:
        """Centre (3,) of the operated femoral head, LPS mm."""
        return self.landmarks[f"FH-{self.side[0]}"]
