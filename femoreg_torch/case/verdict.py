"""The one verdict on a result. It fails closed: what is not known to be trusted is not trusted."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from femoreg_torch.case.quality import ObjectQuality

NO_QUALITY = "the result does not say how good it is"


@dataclass(frozen=True)
class Verdict:
    """Whether a registration can be trusted, and why not, in words."""

    trusted: bool
    reasons: tuple[str, ...]  # empty if it can

    @property
    def sentence(self) -> str:
        """The verdict in one sentence."""
        if self.trusted:
            return "Trusted: every check of the registration passed."
        return f"Not trusted: {'; '.join(self.reasons)}."


def verdict_on(objects: Sequence[str], quality: Mapping[str, ObjectQuality], doubts: Sequence[str] = ()) -> Verdict:
    """The verdict on poses of the named objects from the quality of each; `doubts` are further reasons against it."""
    reasons = list(doubts)
    if not objects or not quality:
        reasons.append(NO_QUALITY)
    else:
        for name in dict.fromkeys((*objects, *quality)):
            if name not in quality:
                reasons.append(f"{name}: the result does not say how good its pose is")
            elif quality[name].trusted is not True:
                reasons.append(f"{name}: {quality[name].reason or 'no reason given'}")
    return Verdict(not reasons, tuple(reasons))
