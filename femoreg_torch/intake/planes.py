"""Three planes of a CT or a label map as one picture, as radiologists look at them: the patient's left on the right.

And X-ray images side by side, as they are stored.
"""

from collections.abc import Mapping, Sequence

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from femoreg_torch.geometry import transform_points
from femoreg_torch.pictures import put_words
from femoreg_torch.volume import Volume, crop, resample_isotropic

Picture = NDArray[np.uint8]  # (H, W, 3), blue, green, red
_WINDOW_HU = (-250.0, 1000.0)
_HEIGHT_PX = 420
_JOINT_MM = 55.0  # to all sides of a femoral head's centre: the whole socket
_CELL_PX, _COLUMNS = 300, 3  # of images side by side
_ENDS_PERCENT = (0.5, 99.5)  # of the pixels, that set the window of an image
_TINT = 0.35
_LEGEND_PX, _LINE_PX, _MOST_NAMES = 150, 18, 20
_NEAR_MM = 12.0  # of a point before or behind a plane
_WHITE, _YELLOW, _DIM = (255, 255, 255), (60, 230, 255), (40, 110, 120)


def three_planes(
    grey: Volume | None,
    labels: Volume | None,
    colours: Mapping[int, tuple[int, int, int]],
    marks: Mapping[str, Tensor],
    centre: Tensor | None = None,
    caption: str = "",
    names: Mapping[int, str] | None = None,
) -> Picture:
    """Axial, coronal and sagittal plane through `centre` (3,), LPS mm (by default the middle of what is labelled).

    `grey` is a CT in HU (anything else is shown from its least to its greatest value), `labels` a map on the same grid
    with RGB `colours` of its ids, `marks` points (3,) by name, LPS mm: those near a plane are named, others dim there.
    One of `grey` and `labels` must be there. `caption` stands before the name of each plane. Beside the planes the
    `names` of ids stand in their colours, the first twenty.
    """
    volume = grey if grey is not None else labels
    assert volume is not None
    spacing = max(float(n * s) for n, s in zip(volume.data.shape[::-1], volume.spacing_mm, strict=True)) / _HEIGHT_PX
    index_from_lps = torch.linalg.inv(volume.lps_from_index)
    point = _middle(labels, volume) if centre is None else centre
    index = transform_points(index_from_lps, point[None])[0]
    at = [int(min(max(float(v), 0), n - 1)) for v, n in zip(index.round(), volume.data.shape[::-1], strict=True)]
    panels = []
    for axis, name in ((2, "axial"), (1, "coronal"), (0, "sagittal")):
        across, down = ((0, 1), (0, 2), (1, 2))[2 - axis]
        panel = _plane(grey, labels, colours, axis, at[axis])
        size = [max(1, round(volume.data.shape[::-1][k] * volume.spacing_mm[k] / spacing)) for k in (across, down)]
        panel = np.asarray(cv2.resize(panel, (size[0], size[1]), interpolation=cv2.INTER_NEAREST), np.uint8)
        if down == 2:
            panel = np.ascontiguousarray(panel[::-1])  # the head is up
        for mark, place in marks.items():
            where = transform_points(index_from_lps, place[None])[0].tolist()
            column = (where[across] + 0.5) * volume.spacing_mm[across] / spacing
            row = (where[down] + 0.5) * volume.spacing_mm[down] / spacing
            row = size[1] - row if down == 2 else row
            near = abs(where[axis] - at[axis]) * volume.spacing_mm[axis] <= _NEAR_MM
            colour = _YELLOW if near else _DIM
            cv2.drawMarker(panel, (round(column), round(row)), colour, cv2.MARKER_CROSS, 8, 1, cv2.LINE_AA)
            if near:
                put_words(panel, mark, (round(column) + 5, round(row) - 4), 0.35, colour)
        left, right = ("front", "back") if axis == 0 else ("R", "L")
        panels.append(_captioned(panel, f"{caption}{name}", left, right))
    if names:
        panels.append(_legend([(name, colours[n]) for n, name in names.items() if n in colours][:_MOST_NAMES]))
    height = max(panel.shape[0] for panel in panels)
    return np.hstack([cv2.copyMakeBorder(p, 0, height - p.shape[0], 0, 6, cv2.BORDER_CONSTANT) for p in panels])


def planes_through_joints(
    grey: Volume,
    labels: Volume,
    colours: Mapping[int, tuple[int, int, int]],
    heads: Mapping[str, Tensor],
    names: Mapping[int, str] | None = None,
) -> Picture:
    """Three planes of all through the middle of the femoral heads, and below them, for each head, of its joint alone.

    `heads` are centres (3,), LPS mm, by side; the rest is as for `three_planes`.
    """
    middle = torch.stack(list(heads.values())).mean(0) if heads else None
    picture = three_planes(grey, labels, colours, {}, middle, names=names)
    for side, centre in heads.items():
        around = [_around(volume, centre) for volume in (grey, labels)]
        below = three_planes(around[0], around[1], colours, {}, centre, f"{side} hip, ")
        picture = np.vstack(_equally_wide(picture, below))
    return picture


def _around(volume: Volume, centre: Tensor) -> Volume:
    """What lies near a joint."""
    index = transform_points(torch.linalg.inv(volume.lps_from_index), centre[None])[0]
    reach = _JOINT_MM / torch.tensor(volume.spacing_mm, dtype=torch.float64)
    low, high = (index - reach).round().int().tolist(), (index + reach).round().int().tolist()
    return crop(volume, (low[0], low[1], low[2]), (high[0] + 1, high[1] + 1, high[2] + 1))


def side_by_side(images: Mapping[str, Tensor]) -> Picture | None:
    """Images (H, W) by name as they are stored, three in a row; None if there are none."""
    if not images:
        return None
    cells = [_cell(name, image) for name, image in images.items()]
    blank = np.zeros_like(cells[0])
    cells += [blank] * (-len(cells) % min(_COLUMNS, len(cells)))
    columns = min(_COLUMNS, len(cells))
    return np.vstack([np.hstack(cells[n : n + columns]) for n in range(0, len(cells), columns)])


def stacked(above: Picture | None, below: Picture | None) -> Picture | None:
    """Both pictures, one below the other, or the one that is there."""
    if above is None or below is None:
        return below if above is None else above
    return np.vstack(_equally_wide(above, below))


def _equally_wide(above: Picture, below: Picture) -> list[Picture]:
    width = max(above.shape[1], below.shape[1])
    return [
        np.asarray(cv2.copyMakeBorder(p, 0, 6, 0, width - p.shape[1], cv2.BORDER_CONSTANT), np.uint8)
        for p in (above, below)
    ]


def _cell(name: str, image: Tensor) -> Picture:
    """One image in a square, with its name."""
    values = image.numpy()
    low, high = np.percentile(values, _ENDS_PERCENT)
    grey = ((values - low) / max(high - low, 1e-9) * 255).clip(0, 255).astype(np.uint8)
    shrink = (_CELL_PX - 6) / max(grey.shape)
    height, width = (max(1, round(n * shrink)) for n in grey.shape)
    small = cv2.resize(grey, (width, height), interpolation=cv2.INTER_AREA)
    cell = np.zeros((_CELL_PX, _CELL_PX, 3), np.uint8)
    cell[: small.shape[0], : small.shape[1]] = small[..., None]
    put_words(cell, name, (6, 18), 0.45, _YELLOW)
    return cell


def _middle(labels: Volume | None, volume: Volume) -> Tensor:
    """Centre of mass of what is labelled, or the middle of the grid."""
    if labels is None:
        return volume.centre()
    coarse = resample_isotropic(labels, max(*labels.spacing_mm, 4.0), nearest=True)
    where = coarse.data.nonzero().double()
    if len(where) == 0:
        return volume.centre()
    return transform_points(coarse.lps_from_index, where.mean(0).flip(0)[None])[0]


def _plane(
    grey: Volume | None, labels: Volume | None, colours: Mapping[int, tuple[int, int, int]], axis: int, at: int
) -> Picture:
    """One plane of voxels across an index axis (0: x), tinted by its labels."""
    shape = (grey or labels).data.select(2 - axis, at).shape  # type: ignore[union-attr]  # one of the two is there
    picture = np.zeros((*shape, 3), np.float32)
    if grey is not None:
        values = grey.data.select(2 - axis, at).float()
        low, high = _window(grey)
        picture += (((values - low) / (high - low)).clamp(0, 1) * 255).numpy()[..., None]
    if labels is not None:
        ids = labels.data.select(2 - axis, at).numpy()
        for number, (red, green, blue) in colours.items():
            inside = ids == number
            share = 1.0 if grey is None else _TINT
            picture[inside] = (1 - share) * picture[inside] + share * np.array([blue, green, red], np.float32)
    return picture.astype(np.uint8)


def _window(grey: Volume) -> tuple[float, float]:
    low, high = (float(v) for v in grey.data.aminmax())
    if low < _WINDOW_HU[0] and high > _WINDOW_HU[1] / 4:
        return _WINDOW_HU
    return low, max(high, low + 1e-6)


def _legend(names: Sequence[tuple[str, tuple[int, int, int]]]) -> Picture:
    """Names in RGB colours, one below the other."""
    panel = np.zeros((_LINE_PX * (len(names) + 1), _LEGEND_PX, 3), np.uint8)
    for line, (name, (red, green, blue)) in enumerate(names, 1):
        put_words(panel, name, (6, _LINE_PX * line), 0.45, (blue, green, red))
    return panel


def _captioned(panel: Picture, name: str, left: str, right: str) -> Picture:
    width = panel.shape[1]
    put_words(panel, left, (6, 18), 0.5, _WHITE)
    put_words(panel, right, (width - 10 * len(right) - 8, 18), 0.5, _WHITE)
    put_words(panel, name, (6, panel.shape[0] - 8), 0.45, _WHITE)
    return panel
