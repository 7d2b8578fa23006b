"""From heat maps to sub-pixel landmarks with a probability and an expected error."""

import torch
from torch import Tensor
from torch.nn import functional as F

_RADIUS = 4  # pixels of the heat map (12.4 mm on the detector)
_NEAR = 8.0  # pixels about a landmark that its expected error is read from
_GAIN, _FLOOR_PX = 0.40, 0.55  # fitted on procedural patients 101 and 102, of whom the first validated the training


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


def expected_error(heatmaps: Tensor, positions: Tensor, sigma_px: float) -> Tensor:
    """Standard deviation (L,) along each axis, in pixels of the heat map, to expect of `positions` (L, 2).

    From the variance of the distribution within 8 pixels, less that of the peak of `sigma_px` which the network was
    trained to show: σ² = gain · (variance − sigma_px²) + floor².
    """
    rows, columns = (torch.arange(n, dtype=torch.float64) for n in heatmaps.shape[1:])
    along, down = columns - positions[:, :1], rows - positions[:, 1:]
    near = (down.abs() <= _NEAR)[:, :, None] & (along.abs() <= _NEAR)[:, None, :]
    logits = heatmaps.to(torch.float64).masked_fill(~near, -torch.inf)
    share = logits.flatten(1).softmax(1).view(heatmaps.shape)
    variance = 0.5 * ((share.sum(1) * along**2).sum(1) + (share.sum(2) * down**2).sum(1))
    return (_GAIN * (variance - sigma_px**2).clamp_min(0) + _FLOOR_PX**2).sqrt()
