"""A pose found by Adam through the differentiable projector: no stage, no scene, only `project` and a similarity."""

import torch
from phantom_parts import lumpy_object, noisy

import femoreg_torch as femoreg
from femoreg_torch.geometry import about_point, exp_se3


def main() -> float:
    """Register one object to one image; returns how far its middle is off at the end, mm across the image."""
    camera = femoreg.load_carm("cios_fusion").camera.downsampled(12)
    volume = lumpy_object()
    truth = torch.eye(4, dtype=torch.float64)
    truth[:3, 3] = torch.tensor([5.0, -8.0, 700.0])
    image = noisy(femoreg.project(volume, truth[None], camera, step_mm=0.5)[0])
    cost = femoreg.GradNcc(patch_radius=5).against(image, None)

    start = truth.clone()
    start[:3, 3] += torch.tensor([4.0, -3.0, 10.0])
    unit = torch.tensor([0.02, 0.02, 0.02, 1.0, 1.0, 4.0], dtype=torch.float64)  # rad and mm
    delta = torch.zeros(6, dtype=torch.float64, requires_grad=True)
    optimiser = torch.optim.Adam([delta], lr=0.3)
    for _ in range(80):
        optimiser.zero_grad()
        pose = about_point(exp_se3((delta * unit)[None]), start[:3, 3]) @ start
        loss = cost(femoreg.project(volume, pose, camera, step_mm=2.0))[0]
        loss.backward()
        optimiser.step()
    found = (about_point(exp_se3((delta.detach() * unit)[None]), start[:3, 3]) @ start)[0]
    error = float((found - truth)[:2, 3].norm())
    print(f"cost {float(loss.detach()):.3f}, {error:.2f} mm off across the image")
    return error


if __name__ == "__main__":
    main()
