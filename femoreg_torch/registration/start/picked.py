"""Landmarks that a person picked in an image: do they lie in it, and how else may they be meant where none fits?"""

from collections.abc import Callable, Mapping, Sequence

import torch
from torch import Tensor

from femoreg_torch.errors import InputError
from femoreg_torch.geometry import Camera, transform_points
from femoreg_torch.pnp import PnpResult

_EDGE_PX = 1.0  # beyond the last pixel's centre, where a marker on the border may come to lie
_FEW = 3  # of landmarks that are told with their places
# From the farthest landmark to the detector: skin and cover take some 2 cm, depths by four landmarks are 1 to 3 cm off.
_NEAR_MM, _CLEAR_MM = 40.0, 100.0
_UPRIGHT = 0.7  # cosine between the way up of the picture and that to the head
_MM = "in mm instead of pixels, as 3D Slicer shows them for images that tell their pixel size: divide them by it"

Fits = Callable[[Sequence[str], Tensor], PnpResult | None]  # of names and places (N, 2) in the stored picture


def check_in_picture(names: Sequence[str], pixels: Tensor, camera: Camera) -> None:
    """Raises `InputError` where most landmarks (N, 2), column and row, lie beside the stored picture of `camera`.

    Nobody can have picked them there: they are of another coordinate system or size of picture. A few may be told by
    where a program projects them.
    """
    beside = ~_in_picture(pixels, camera)
    if 2 * beside.sum() <= len(names):
        return
    wrong = beside.nonzero()[:, 0].tolist()
    told = ", ".join(f"{names[n]} at ({pixels[n, 0]:.0f}, {pixels[n, 1]:.0f})" for n in wrong[:_FEW])
    more = f" and {len(wrong) - _FEW} more" if len(wrong) > _FEW else ""
    size = f"{camera.shape[1]} × {camera.shape[0]} pixels"
    if _in_picture(-pixels, camera).all():
        why = "With column and row negated all would lie in it: the file says RAS and means LPS. Correct that word"
    else:
        why = (
            "Are they of a picture of another size, in another coordinate system (RAS for LPS), or in mm? Columns and "
            "rows of the stored picture are wanted"
        )
    raise InputError(f"landmarks in the image: {told}{more} lie outside the picture of {size}. {why}.")


def check_before_detector(
    pnp: PnpResult,
    marks: Mapping[str, Tensor],
    names: Sequence[str],
    pixels: Tensor,
    camera: Camera,
    fits: Fits,
) -> None:
    """Raises `InputError` where a start puts a landmark of `marks` (3,), LPS mm, beyond the detector, or near it while
    `pixels` (N, 2) fit better if they are taken for mm.

    In mm, places are nearer to one another than in pixels below 1 mm, so that the patient seems to lie farther away.
    """
    name, gap = _nearest_to_detector(pnp.camera_from_object, marks, camera)
    if gap >= _NEAR_MM:
        return
    by_mm = fits(names, _as_mm(pixels, camera))
    in_mm = (
        by_mm is not None
        and by_mm.misfit < pnp.misfit  # as there are thin patients close to their detectors
        and _nearest_to_detector(by_mm.camera_from_object, marks, camera)[1] > _CLEAR_MM
    )
    if not in_mm and gap >= 0:
        return
    where = f"{gap:.0f} mm before the detector" if gap >= 0 else f"{-gap:.0f} mm behind the detector"
    why = (
        f"They fit {_MM}"
        if in_mm
        else "Are they pixels of the stored picture, and source distance and pixel size of the C-arm right? Mend them"
    )
    raise InputError(f"landmarks in the image: by them {name} lies {where}, where no patient fits. {why}.")


def meant_otherwise(
    names: Sequence[str], pixels: Tensor, camera: Camera, fits: Fits, mirror: Mapping[str, str]
) -> str | None:
    """In words, how landmarks (N, 2) of which no pose comes may be meant instead, as a pose fits then; None: no idea.

    A picture that is mirrored, has its rows counted from below, or columns and rows exchanged, is a mirror image each
    time. The pose that has the head up tells which.
    """
    rows = camera.shape[0]
    column, row = pixels.unbind(-1)
    exchanged = [mirror.get(name, name) for name in names]
    readings = {
        _MM: (names, _as_mm(pixels, camera)),
        "with left and right exchanged (-l and -r), or in a picture that is mirrored": (exchanged, pixels),
        "with rows counted from below": (names, torch.stack([column, rows - 1 - row], -1)),
        "with column and row exchanged": (names, torch.stack([row, column], -1)),
    }
    fitting: dict[str, float] = {}
    for words, (called, places) in readings.items():
        pnp = fits(called, places) if _in_picture(places, camera).all() else None
        if pnp is not None:
            fitting[words] = -float(pnp.camera_from_object[1, 2])
    upright = [words for words, up in fitting.items() if up > _UPRIGHT]
    return ", or ".join(upright or fitting) or None


def _in_picture(pixels: Tensor, camera: Camera) -> Tensor:
    """Which of the places (N, 2) lie in the picture, bool."""
    last = pixels.new_tensor([camera.shape[1] - 1, camera.shape[0] - 1])
    return ((pixels >= -_EDGE_PX) & (pixels <= last + _EDGE_PX)).all(-1)


def _as_mm(pixels: Tensor, camera: Camera) -> Tensor:
    """Places (N, 2) in pixels, if they were told in mm from the centre of the first pixel."""
    return pixels / pixels.new_tensor([camera.pixel_mm[1], camera.pixel_mm[0]])


def _nearest_to_detector(camera_from_ct: Tensor, marks: Mapping[str, Tensor], camera: Camera) -> tuple[str, float]:
    """The landmark that lies farthest from the source, and its way to the detector in mm."""
    depths = transform_points(camera_from_ct, torch.stack(list(marks.values())).double())[:, 2]
    farthest = int(depths.argmax())
    return list(marks)[farthest], camera.sdd_mm - float(depths[farthest])
