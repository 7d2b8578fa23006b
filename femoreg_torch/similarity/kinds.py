"""Which similarity a preset means by `kind`."""

from typing import Any

from femoreg_torch.extensions import check_has, read_kind
from femoreg_torch.similarity.grad_ncc import GradNcc
from femoreg_torch.similarity.interface import Similarity
from femoreg_torch.similarity.ncc import Ncc
from femoreg_torch.similarity.orientation import GradientOrientation

SIMILARITIES = {"grad_ncc": GradNcc, "ncc": Ncc, "gradient_orientation": GradientOrientation}


def read_similarity(content: Any, where: str) -> Similarity:
    """A similarity from a mapping such as `{kind: grad_ncc, patch_radius: 5}`. Raises `InputError`, see `read_kind`."""
    similarity: Similarity = read_kind("femoreg_torch.similarities", SIMILARITIES, content, where)
    check_has(similarity, "femoreg_torch.similarities", ["against"], where)
    return similarity
