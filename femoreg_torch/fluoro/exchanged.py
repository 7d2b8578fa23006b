"""Are images of a case exchanged: those of two views, or those with the device and those without?"""

from collections.abc import Mapping
from typing import Literal

import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d

_LOOK_PX = 96  # images are compared at about so many pixels across
_MORE_ALIKE = 0.2  # correlation by which another view's image must be more alike before it is told
# A device takes light. Pixels count that differ by a tenth of what the image without it spans, beyond what all of them
# differ by, as exposures do. Of 480 right pairs of two simulators none had a pixel brighter with the device, but
# for three between whose exposures the patient moved by 5 mm: 1 % brighter, 3 % darker. Of two pairs of different views
# 13 and 6 % were brighter, and 9 and 17 % darker. Thin wires change too few pixels to be told. Of 180 right pairs of
# four more simulators, with grey values of all kinds, none was taken for exchanged either.
_DIFFER, _LEAST_SHARE, _MOST_OTHER = 0.1, 0.005, 0.2


def views_exchanged(images: Mapping[str, Tensor], first_kind: str) -> list[str]:
    """In words, which images (H, W) look less like the first one of their own view than like that of another view.

    Or than like the negative of the first one of their own.

    Images are named `views[0].anatomy` and so on.
    """
    told = []
    looks = {key: _look(image) for key, image in images.items()}
    firsts = {key.rpartition(".")[0]: look for key, look in looks.items() if key.endswith(f".{first_kind}")}
    for key, look in looks.items():
        view = key.rpartition(".")[0]
        alike = {other: float((look * first).mean()) for other, first in firsts.items() if first.shape == look.shape}
        if key == f"{view}.{first_kind}" or view not in alike:
            continue
        nearest = max(alike, key=lambda other: alike[other])
        if -alike[view] > alike[nearest] + _MORE_ALIKE:
            told.append(
                f"{key}: looks like the negative of {view}.{first_kind} (correlation {alike[view]:.2f}). Are the grey "
                "values of one of the two inverted? `intensity` stands for all images of a view, so invert one file."
            )
        elif alike[nearest] > alike[view] + _MORE_ALIKE:
            told.append(
                f"{key}: looks like {nearest}.{first_kind} (correlation {alike[nearest]:.2f}) and not like "
                f"{view}.{first_kind} ({alike[view]:.2f}). Are images of two views exchanged? Both of a view are to be "
                "of one C-arm pose."
            )
    return told


def kinds_exchanged(attenuations: Mapping[str, Tensor | None], without: str, with_it: str) -> list[str]:
    """In words, in which views the image `with_it`, the device, shows less than that `without` it.

    `attenuations` (H, W), up to a scale, are named `views[0].anatomy` and so on.
    """
    exchanged = []
    for key, alone in attenuations.items():
        view, _, kind = key.rpartition(".")
        both = attenuations.get(f"{view}.{with_it}") if kind == without else None
        if alone is not None and both is not None and shows_less(alone, both):
            exchanged.append(view)
    if not exchanged:
        return []
    return [
        f"{', '.join(exchanged)}: `{without}` shows something dense that `{with_it}` lacks, not the other way round: "
        f"are the images with the device and those without it exchanged? `{with_it}` are those with it"
    ]


def shows_less(alone: Tensor, both: Tensor) -> bool:
    """Whether an image lacks something dense that the one without the device shows, and not the other way round.

    Both are coarse attenuation (H, W), of one view.
    """
    if alone.shape != both.shape:
        return False
    more, less = _differing(alone, both)
    return less > _LEAST_SHARE and more < _MOST_OTHER * less


def rough_attenuation(values: Tensor, intensity: Literal["raw", "log"]) -> Tensor:
    """Coarse attenuation of an image (H, W), up to a scale and an offset."""
    coarse = _coarse(values)
    return coarse if intensity == "log" else -_logs(coarse)


def _differing(alone: Tensor, both: Tensor) -> tuple[float, float]:
    """Shares of the pixels with clearly more, and with clearly less, attenuation in the second of two images (H, W)."""
    low, high = alone.flatten().quantile(torch.tensor([0.05, 0.95]))
    change = both - alone
    change = (change - change.median()) / (high - low).clamp_min(1e-30)
    return float((change > _DIFFER).float().mean()), float((change < -_DIFFER).float().mean())


def _look(image: Tensor) -> Tensor:
    """What is seen in an image (H, W), coarse, without slow changes of brightness: mean 0, mean square 1."""
    logs = _logs(_coarse(image.float() - image.min()))[None]
    detail = logs - avg_pool2d(logs, 11, stride=1, padding=5, count_include_pad=False)
    return ((detail - detail.mean()) / detail.std().clamp_min(1e-30))[0]


def _coarse(image: Tensor) -> Tensor:
    factor = max(1, round(min(image.shape) / _LOOK_PX))
    return avg_pool2d(image.float()[None], factor)[0]


def _logs(coarse: Tensor) -> Tensor:
    """Logarithms of values that may come down to zero."""
    positive = coarse.clamp_min(0)
    return (positive + 0.01 * positive.mean() + 1e-30).log()
