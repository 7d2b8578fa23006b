"""What is asked of a pose by landmarks, whoever found them."""

from collections.abc import Callable, Mapping, Sequence

from torch import Tensor

from femoreg_torch.anatomy import Anatomy
from femoreg_torch.errors import InputError
from femoreg_torch.pnp import PnpResult

# Greatest standard deviation of the rotation, over all axes, of a start by landmarks alone, or by few of them and
# outlines. Outlines mend what is more open (9° open: 2 to 3° off afterwards).
MOST_ROTATION_DEG = 5.0
_SURE_OF_SIDES = 3.0  # log likelihood by which landmarks are to fit better than those of the other side
BY_HAND = "Pick the landmarks in the image (--landmarks), or put a view from the front or from behind first."


def check_rotation(pnp: PnpResult) -> None:
    """Raises `InputError` where landmarks leave the rotation open by more than `MOST_ROTATION_DEG`."""
    if pnp.rotation_deviation_deg > MOST_ROTATION_DEG:
        raise InputError(
            f"too few usable landmarks: {int(pnp.inliers.sum())} of {len(pnp.inliers)} agree, but they fix the "
            f"rotation only to {pnp.rotation_deviation_deg:.0f}°, and no outlines help. Take a view that shows more "
            "landmarks, give more of them by hand (--landmarks), or name the bones of the label map under `ct.bones`."
        )


def check_sides(
    pnp: PnpResult,
    anatomy: Anatomy,
    landmarks: Mapping[str, Tensor],
    names: Sequence[str],
    fitted: Callable[[Sequence[str], Sequence[int]], PnpResult],
    advice: str,
) -> None:
    """Raises `InputError` with this `advice` where landmarks of a view from a side may be those of the other side.

    `fitted` gives the pose if rows of what was seen are the landmarks of given names.

    From a side, a body and its mirror image cast nearly the same shadow, and only perspective tells them apart: picked
    with left and right exchanged, the landmarks of a pelvis gave poses 20° and 80 mm off, within 10 mm on the detector.
    """
    left, back, _ = pnp.camera_from_object[2, :3].abs().tolist()
    if left <= back:
        return
    mirror = {mark.name: mark.mirror for mark in anatomy.landmarks}
    both = [n for n, name in enumerate(names) if mirror.get(name) in landmarks]
    own, other = [names[n] for n in both], [mirror[names[n]] for n in both]
    try:
        gain = fitted(own, both).misfit - fitted(other, both).misfit
    except InputError:  # too few of them, or none of the other side fits
        return
    if gain > -_SURE_OF_SIDES:
        how = "better" if gain > _SURE_OF_SIDES else "about as well"
        raise InputError(
            f"landmarks in the image: with left and right exchanged they fit {how}. Seen from a side, the two lie one "
            f"over the other. {advice}"
        )
