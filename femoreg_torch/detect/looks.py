"""One image read several times, a little moved and mirrored, and the readings brought together.

Each look is undone on the network's log-probabilities, which are then averaged: the geometric mean of the readings, in
which a place that only one of them believes in loses.
"""

import math
from dataclasses import dataclass

import torch
from torch import Tensor, nn
from torch.nn import functional as F

# Left and right change places in a mirror: landmarks stand in pairs, labels are 0 to 6 as in `sim.dataset`.
MIRRORED_LANDMARKS = torch.arange(14).view(7, 2).flip(1).flatten()
MIRRORED_LABELS = torch.tensor([0, 2, 1, 3, 4, 6, 5])


@dataclass(frozen=True)
class Look:
    """How an image is moved before the network sees it: mirrored, turned and zoomed about its middle, then shifted."""

    mirrored: bool = False
    turn_deg: float = 0.0
    zoom: float = 1.0
    shift: tuple[float, float] = (0.0, 0.0)  # along columns and rows, in shares of the image's width

    def image_from_look(self) -> Tensor:
        """Affine map (2, 3) from places in the moved image to places in the image; −1 … 1 from border to border."""
        c, s = math.cos(math.radians(self.turn_deg)) / self.zoom, math.sin(math.radians(self.turn_deg)) / self.zoom
        side = -1.0 if self.mirrored else 1.0
        return torch.tensor([[side * c, -side * s, 2 * self.shift[0]], [s, c, 2 * self.shift[1]]])

    def look_from_image(self) -> Tensor:
        """The way back (2, 3)."""
        there = self.image_from_look()
        linear = torch.linalg.inv(there[:, :2])
        return torch.cat([linear, -linear @ there[:, 2:]], 1)


PLAIN = (Look(),)
LOOKS = (
    Look(),
    Look(mirrored=True),
    Look(turn_deg=3, zoom=1.05, shift=(0.012, -0.008)),
    Look(mirrored=True, turn_deg=-3, zoom=0.95, shift=(-0.008, -0.012)),
    Look(turn_deg=-3, zoom=0.95, shift=(-0.012, 0.008)),
    Look(mirrored=True, turn_deg=3, zoom=1.05, shift=(0.008, 0.012)),
)


@dataclass(frozen=True)
class Reading:
    """Logarithms of probabilities on the grid of the network's output."""

    segmentation: Tensor  # (7, h, w)
    heatmaps: Tensor  # (14, h, w); with `absence` one distribution per landmark, up to a factor
    absence: Tensor  # (14,)


@torch.inference_mode()
def read_image(network: nn.Module, image: Tensor, looks: tuple[Look, ...]) -> Reading:
    """The mean reading of a normalised `image` (H, W) on the network's grid; the first of `looks` is the plain one."""
    there = torch.stack([look.image_from_look() for look in looks])
    back = torch.stack([look.look_from_image() for look in looks])
    grid = F.affine_grid(there, [len(looks), 1, *image.shape], align_corners=False)
    moved = F.grid_sample(image.expand(len(looks), 1, -1, -1), grid, padding_mode="border", align_corners=False)
    prediction = network(moved)
    segmentation = prediction.segmentation.float().log_softmax(1)
    heatmaps, absence = prediction.heatmaps.float(), prediction.absence.float()
    total = torch.logaddexp(heatmaps.flatten(2).logsumexp(-1), absence)
    # a pixel of a magnified image holds less than one of the image itself
    area = torch.linalg.det(back[:, :, :2]).abs().log()
    heatmaps = heatmaps - total[..., None, None] + area[:, None, None, None]
    absence = absence - total
    mirror = torch.tensor([look.mirrored for look in looks])
    heatmaps[mirror], absence[mirror] = (
        heatmaps[mirror][:, MIRRORED_LANDMARKS],
        absence[mirror][:, MIRRORED_LANDMARKS],
    )
    segmentation[mirror] = segmentation[mirror][:, MIRRORED_LABELS]
    maps = torch.cat([segmentation, heatmaps], 1)
    undone = F.affine_grid(back, list(maps.shape), align_corners=False)
    maps = F.grid_sample(maps, undone, padding_mode="border", align_corners=False)
    seen = ((undone.abs() <= 1).all(-1)).to(maps.dtype)[:, None]  # a look says nothing about what it cut off
    maps = (maps * seen).sum(0) / seen.sum(0)
    return Reading(maps[:7], maps[7:], absence.mean(0))
