"""Single-view registration of a labelled image: a start pose turned and shifted in the image plane comes back."""

from pathlib import Path

import torch

from femoreg_torch.drr import project
from femoreg_torch.fluoro import downsample
from femoreg_torch.geometry import about_point, exp_so3, load_carm, rigid, rotation_angle, transform_points
from femoreg_torch.volume import hu_to_attenuation, read_ct, resample_isotropic
from training.labelled import LabelledImage
from training.single_view import single_view_registration

TRUTH = torch.tensor([[1.0, 0, 0, 5], [0, 0, -1, 4], [0, 1, 0, 760], [0, 0, 0, 1]]).double()
REFINEMENT = """
extends: fast
steps:
  - {name: "pelvis in view 1, coarse", remove: true}
  - {name: "femur in view 1, coarse", remove: true}
  - {name: "everything together", imaging: {scatter: 0, tissue: 0}}
  - {name: "everything together, fine", imaging: {scatter: 0, tissue: 0}}
"""


def test_the_pelvis_comes_back(case: Path, tmp_path: Path) -> None:
    """The image is drawn from the CT itself, all that is bone in it, on pixels eight times as large as the C-arm's."""
    camera = load_carm("cios_fusion").camera.downsampled(8)
    ct = resample_isotropic(read_ct(case / "ct.nii.gz"), 1.0)  # as what is registered: first, and then bone is told
    bone = ct.with_data(hu_to_attenuation(ct.data.float().where(ct.data > 300, torch.tensor(-1000.0)), -1000.0))
    finer = load_carm("cios_fusion").camera.downsampled(2)
    image = downsample(project([bone], TRUTH[None, None], finer, 0.3)[0], 4)
    none = torch.zeros(0)
    labelled = LabelledImage("boxes", image, camera, none, none, none > 0, none, TRUTH)
    middle = TRUTH[:3, 3]
    turn = rigid(exp_so3(torch.deg2rad(torch.tensor([0.0, 0.0, 2.0], dtype=torch.float64))))
    shift = rigid(translation=torch.tensor([3.0, -4.0, 0.0], dtype=torch.float64))
    preset = tmp_path / "refinement.yaml"
    preset.write_text(REFINEMENT, encoding="utf-8")
    found = single_view_registration(case, str(preset))(labelled, shift @ about_point(turn, middle) @ TRUTH)
    assert torch.rad2deg(rotation_angle(TRUTH[:3, :3].mT @ found[:3, :3])) < 0.3
    off = (transform_points(found, torch.zeros(1, 3).double()) - middle)[0]
    assert off[:2].norm() < 1  # of 5
    assert off[2].abs() < 5  # one view hardly tells the depth
