"""A workflow of one's own, put together in Python: a coarse search, then a fine refinement, in two views."""

import torch
from phantom_parts import lumpy_object, noisy

import femoreg_torch as femoreg
from femoreg_torch.geometry import pose_difference

PLAN = femoreg.Plan(
    "my own order",
    (
        femoreg.Stage(
            name="coarse, in view 1",
            images="first",
            kinds=["image"],
            render=["object"],
            bodies=[femoreg.BodyPlan(["object"], rotation_deg=[6, 6, 6], translation_mm=[6, 6, 30])],
            level=femoreg.Level(pixel_mm=3.1, step_mm=2),
            similarity=femoreg.GradNcc(patch_radius=4),
            optimiser=femoreg.CmaEs(population=30, max_evaluations=450, tol_x=0.01),
        ),
        femoreg.Stage(
            name="fine, in both views",
            images="all",
            kinds=["image"],
            render=["object"],
            bodies=[femoreg.BodyPlan(["object"], rotation_deg=[1, 1, 1], translation_mm=[1, 1, 4])],
            level=femoreg.Level(pixel_mm=1.55, step_mm=1),
            similarity=femoreg.Ncc(patch_radius=5),
            optimiser=femoreg.LevenbergMarquardt(max_iterations=12),
        ),
    ),
)


def main() -> tuple[float, float]:
    """Register one object to two images from known C-arm poses; returns degrees and mm off."""
    carm, volume = femoreg.load_carm("cios_fusion"), lumpy_object()
    cameras = carm.orbit(torch.deg2rad(torch.tensor([0.0, 40.0], dtype=torch.float64)))  # of both views, from view 1
    truth = torch.eye(4, dtype=torch.float64)
    truth[:3, 3] = torch.tensor([5.0, -8.0, 640.0])
    camera = carm.camera.downsampled(4)
    images = femoreg.project(volume, cameras @ truth, camera, step_mm=0.5)

    start = truth.clone()
    start[:3, 3] += torch.tensor([5.0, -4.0, 25.0])
    middle = torch.zeros(3, dtype=torch.float64)
    scene = femoreg.Scene(
        femoreg.CArm(camera, carm.isocentre_mm, carm.orbit_axis),
        {"object": femoreg.RigidObject(volume, middle, ("image",), femoreg.Start(camera1_from=start))},
        {"image": tuple(noisy(image, seed) for seed, image in enumerate(images))},
        camera_from_camera1=cameras,
    )
    outcome = femoreg.run_plan(scene, PLAN, None, seed=1)
    for stage in outcome.trace:
        print(f"{stage.name}: cost {stage.cost:.4f} after {stage.evaluations} evaluations, {stage.stop}")
    off = pose_difference(truth, outcome.poses.camera1_from["object"], middle)
    print(f"{off[0]:.2f}° and {off[1]:.2f} mm off")
    return off


if __name__ == "__main__":
    main()
