"""From heat maps to sub-pixel landmarks with a probability."""

import torch
from torch import Tensor
from torch.nn import functional as F

_RADIUS = 4  # pixels of the heat map; 2.7 standard deviations of the peak that the network is trained to show


def decode_heatmaps(heatmaps: Tensor, absence: Tensor) -> tuple[Tensor, Tensor]:
    """Positions (L, 2) (column, row) on the heat maps' grid, and confidences (L,) of landmarks.

    `heatmaps` (L, H, W) and `absence` (L,) are logits of one distribution per landmark, over all pixels and "not in the
    image". A landmark's position is the centroid of the probability in a 9 × 9 window about the highest pixel, and its
    confidence the probability within that window: low for a landmark that is not there, and for one that may be in
    several places.
    """
    logits = torch.cat([heatmaps.flatten(1), absence[:, None]], 1).to(torch.float64)
    probabilities = logits.softmax(1)[:, :-1].view(heatmaps.shape)
    width = heatmaps.shape[2]
    best = probabilities.flatten(1).argmax(1)
    row, column = best // width, best % width
    padded = F.pad(probabilities, (_RADIUS,) * 4)
    steps = torch.arange(2 * _RADIUS + 1)
    landmark = torch.arange(len(heatmaps))[:, None, None]
    window = padded[landmark, row[:, None, None] + steps[:, None], column[:, None, None] + steps]
    mass = window.sum((1, 2))
    along = (window.sum(1) * (steps - _RADIUS)).sum(1) / mass
    down = (window.sum(2) * (steps - _RADIUS)).sum(1) / mass
    return torch.stack([column + along, row + down], 1), mass
