"""What a network and a loss are, so that others can be put in their place.

Both are frozen dataclasses of settings, chosen by `kind` in `configs/training/`. Those of this package stand in
`models.kinds`; another package adds one by an entry point in the group `femoreg_torch.networks` or
`femoreg_torch.losses`, whose name is the kind and whose object is the dataclass.
"""

from typing import NamedTuple, Protocol

from torch import Tensor, nn


class Prediction(NamedTuple):
    """Logits on a grid of half the input's resolution; its pixel i covers the input's pixels 2 i and 2 i + 1."""

    segmentation: Tensor  # (B, classes, H / 2, W / 2); class 0 is the background
    heatmaps: Tensor  # (B, landmarks, H / 2, W / 2)
    absence: Tensor  # (B, landmarks): "not in the image", in one softmax with the pixels of the landmark's heat map


class Network(Protocol):
    """Settings that fix a network's shape."""

    @property
    def classes(self) -> int:
        """Classes of the segmentation, the background included."""

    @property
    def landmarks(self) -> int:
        """Number of heat maps."""

    def build(self) -> nn.Module:
        """A new network with random weights, which maps images (B, 1, H, W) to a `Prediction`.

        Each image has mean 0 and standard deviation 1; H and W are 192 in training and in `femoreg detect`.
        """


class Loss(Protocol):
    """Settings of a loss."""

    @property
    def sigma_px(self) -> float:
        """Standard deviation of the peak that heat maps are trained to show, in their pixels."""

    def __call__(self, prediction: Prediction, labels: Tensor, pixels: Tensor, visible: Tensor) -> dict[str, Tensor]:
        """`loss`, the scalar to minimise, and its parts by name, for the learning curves.

        Truth on the prediction's grid: `labels` (B, h, w) integer, `pixels` (B, L, 2) column and row of the landmarks,
        `visible` (B, L) bool, false for a landmark that is not in the image.
        """
