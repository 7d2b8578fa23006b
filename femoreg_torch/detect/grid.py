"""The grid that networks are given: 192 × 192 pixels of 1.552 mm, the paper's detector averaged over 8 × 8 blocks.

It lies centred on the image, whatever size and pixels that has. A smaller image is padded; on a larger one the pixels
grow until all of it is on the grid.
"""

import torch
from torch import Tensor
from torch.nn import functional as F

from femoreg_torch.geometry import Camera

NETWORK_SIZE = 192
NETWORK_PIXEL_MM = 1.552
_TOO_LARGE_MM = 1.0  # by which an image may stick out of the grid


def _pixel_mm(camera: Camera) -> float:
    """Of the grid for images of `camera`."""
    longest = max(size * pixel for size, pixel in zip(camera.shape, camera.pixel_mm, strict=True))
    fits = longest < NETWORK_SIZE * NETWORK_PIXEL_MM + _TOO_LARGE_MM
    return NETWORK_PIXEL_MM if fits else longest / NETWORK_SIZE


def _zoom(camera: Camera) -> Tensor:
    """Image pixels per network pixel along (columns, rows)."""
    return _pixel_mm(camera) / torch.tensor([camera.pixel_mm[1], camera.pixel_mm[0]], dtype=torch.float64)


def _middle(shape: tuple[int, int]) -> Tensor:
    """(column, row) of an image's middle, pixel centres at integers."""
    return torch.tensor([(shape[1] - 1) / 2, (shape[0] - 1) / 2], dtype=torch.float64)


def network_camera(camera: Camera) -> Camera:
    """The camera of the network's grid for images of `camera`."""
    shape = (NETWORK_SIZE, NETWORK_SIZE)
    principal = torch.tensor(camera.principal_point_px, dtype=torch.float64)
    column, row = ((principal - _middle(camera.shape)) / _zoom(camera) + _middle(shape)).tolist()
    pixel = _pixel_mm(camera)
    return Camera(camera.sdd_mm, (pixel, pixel), shape, (column, row))


def image_from_network(pixels: Tensor, camera: Camera) -> Tensor:
    """(column, row) (..., 2) in the image of `camera` of positions on the network's grid."""
    return (pixels - _middle((NETWORK_SIZE, NETWORK_SIZE))) * _zoom(camera) + _middle(camera.shape)


def to_network_grid(image: Tensor, camera: Camera) -> Tensor:
    """`image` (H, W) of `camera` on the network's grid (192, 192), averaged over what each of its pixels covers.

    Beyond the image's border its outermost pixels are repeated.
    """
    zoom = _zoom(camera)
    columns, rows = (max(1, round(v)) for v in zoom.tolist())
    width = [(columns - 1) // 2, columns // 2, (rows - 1) // 2, rows // 2]
    blurred = F.avg_pool2d(F.pad(image[None, None], width, mode="replicate"), (rows, columns), stride=1)
    # entry i of an average over n pixels, padded as above, is centred half a pixel late where n is even
    late = torch.tensor([0.5 * (columns % 2 == 0), 0.5 * (rows % 2 == 0)], dtype=torch.float64)
    axis = torch.arange(NETWORK_SIZE, dtype=torch.float64)
    row, column = torch.meshgrid(axis, axis, indexing="ij")
    index = image_from_network(torch.stack([column, row], -1), camera) - late
    size = torch.tensor(camera.shape[::-1], dtype=torch.float64)
    unit = ((2 * index + 1) / size - 1).to(image)  # pixel centres at integers to grid_sample's −1 … 1
    return F.grid_sample(blurred, unit[None], padding_mode="border", align_corners=False)[0, 0]
