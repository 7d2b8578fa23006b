"""Where the errors of an object are told."""

from torch import Tensor

from femoreg_torch.case import Case
from femoreg_torch.errors import InputError
from femoreg_torch.registration.prepare.models import model_attenuation
from femoreg_torch.volume import BoneLabels, label_box_centre


def reference_point(case: Case, name: str, bones: BoneLabels | None) -> Tensor:
    """Where the errors of an object are told, (3,) mm in its space."""
    thing = case.objects[name]
    if thing.reference is not None:
        return thing.reference
    if thing.model is not None:
        return model_attenuation(thing.model).volume.centre()
    if bones is None:
        raise InputError(f"{case.folder}: has no label map to find the middle of {name}. Add `ct.labels`.")
    return label_box_centre(bones.labels, bones.of(thing.bones, case.anatomy))
