"""The card that a report opens with: can it be trusted, where is the guide, what corrects it, what is to be done."""

import math
from collections.abc import Iterator
from dataclasses import dataclass

from torch import Tensor

from femoreg_torch.case import Case, Result
from femoreg_torch.case.verdict import NO_QUALITY
from femoreg_torch.errors import InputError
from femoreg_torch.evaluation.report.uncertainty import GuideUncertainty, guide_uncertainty
from femoreg_torch.evaluation.report.words import sentence
from femoreg_torch.geometry import rotation_angle
from femoreg_torch.navigation import Guidance, guide, untold_turn

_TRUSTED = (
    "Every check passed: each image is explained by what was drawn into it, the views agree with one another, and the "
    "images fix every pose well enough."
)
_WITHIN_DEVIATIONS = 2.0  # an offset of so many standard deviations is not told apart from none
_NO_TURN_DEG = 0.005  # told as 0.00°


@dataclass(frozen=True)
class Number:
    """A measured number in words."""

    what: str
    value: str
    uncertainty: str


@dataclass(frozen=True)
class Card:
    """What a reader has to know first, in words."""

    trusted: bool
    headline: str
    reasons: tuple[str, ...]
    numbers: tuple[Number, ...]
    without_numbers: str  # why there are none; empty where there are
    correction: tuple[str, ...]
    next: tuple[str, ...]
    left_out: tuple[str, ...]


def card(case: Case, result: Result) -> Card:
    """The card of a result."""
    verdict = result.verdict
    headline = "Trusted" if verdict.trusted else "Not trusted"
    reasons = tuple(sentence(reason) for reason in verdict.reasons) or (_TRUSTED,)
    left_out = tuple(sentence(note) for note in result.skipped)
    try:
        found = guide(result)
    except InputError as error:
        steps = tuple(_next(result, None, None))
        return Card(verdict.trusted, headline, reasons, (), sentence(str(error)), (), steps, left_out)
    sure = guide_uncertainty(result)
    return Card(
        verdict.trusted,
        headline,
        reasons,
        tuple(_numbers(found, sure)),
        "",
        tuple(_correction(case, found, untold_turn(result, found))),
        tuple(_next(result, found, sure)),
        left_out,
    )


def _numbers(found: Guidance, sure: GuideUncertainty | None) -> Iterator[Number]:
    offset = float(found.tip_offset.norm())
    unknown = "uncertainty unknown"
    yield Number("Tip to entry point", f"{offset:.2f} mm", unknown if sure is None else f"± {sure.tip_mm:.2f} mm")
    yield Number(
        "Guide to planned path", f"{found.angle_deg:.2f}°", unknown if sure is None else f"± {sure.angle_deg:.2f}°"
    )


def _correction(case: Case, found: Guidance, untold: str | None) -> Iterator[str]:
    """The smallest motion that brings the guide onto the path, in words: first a turn, then a shift.

    `untold` says why directions along the tool's own axes are not known; None where they are.
    """
    turn = math.degrees(rotation_angle(found.correction[:3, :3]).item())
    shift = -found.tip_offset  # in the tool's frame
    length = float(shift.norm())
    if turn >= _NO_TURN_DEG:
        yield f"Turn the {found.tool} by {turn:.2f}° about its tip, until its guide is parallel to the planned path."
    moved = found.object_from_tool[:3, :3] @ shift
    in_ct = case.objects[found.object].model is None
    place = _anatomical(moved) if in_ct else f"{_vector(moved)} mm along the axes of the {found.object}"
    yield f"Move the tip by {length:.2f} mm: {place}."
    if untold is not None:
        yield f"Not known along the {found.tool}'s own axes: {untold}. So navigation.json is not trusted."
        return
    yield f"That is {_vector(shift)} mm along the {found.tool}'s own axes, before it is turned."
    yield "All of it as matrices: navigation.json, beside this report."


def _anatomical(shift: Tensor) -> str:
    """A shift (3,) along the axes of a CT (LPS) in words."""
    names = (("the patient's left", "the patient's right"), ("the back", "the front"), ("the head", "the feet"))
    parts = [f"{abs(mm):.1f} mm to {pair[mm < 0]}" for mm, pair in zip(shift.tolist(), names, strict=True)]
    return ", ".join(parts)


def _next(result: Result, found: Guidance | None, sure: GuideUncertainty | None) -> Iterator[str]:
    verdict = result.verdict
    if not verdict.trusted:
        if NO_QUALITY in verdict.reasons:
            yield "Register again: this result does not say how good it is."
            return
        yield "Do not steer by this result."
        yield "Look at the images below: whatever does not lie under its edges is in a wrong place."
        yield (
            "Put right what the reasons name, take new images if need be, and register again; if the start was wrong, "
            "from landmarks picked by hand (--landmarks)."
        )
        return
    yield "Look at the images below: the coloured edges must lie on the edges of the X-ray in every one."
    if found is None:
        yield "To steer a device, take images with it in each view and register again."
    elif sure is not None and _reached(found, sure):
        yield "The guide is where it is planned, as far as can be told: nothing to correct."
    else:
        yield f"Correct the {found.tool}, take new images with it, and register again."


def _reached(found: Guidance, sure: GuideUncertainty) -> bool:
    near = float(found.tip_offset.norm()) <= _WITHIN_DEVIATIONS * sure.tip_mm
    return near and found.angle_deg <= _WITHIN_DEVIATIONS * sure.angle_deg


def _vector(vector: Tensor) -> str:
    return "(" + ", ".join(f"{value + 0.0:.2f}" for value in vector.tolist()) + ")"
