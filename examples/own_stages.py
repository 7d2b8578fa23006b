"""A workflow of one's own, put together in Python: a coarse search, then a fine refinement, in two views."""

from phantom_parts import MIDDLE, two_views

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
    scene, truth = two_views(4, (5.0, -4.0, 25.0))
    outcome = femoreg.run_plan(scene, PLAN, None, seed=1)
    for stage in outcome.trace:
        print(f"{stage.name}: cost {stage.cost:.4f} after {stage.evaluations} evaluations, {stage.stop}")
    off = pose_difference(truth, outcome.poses.camera1_from["object"], MIDDLE)
    print(f"{off[0]:.2f}° and {off[1]:.2f} mm off")
    return off


if __name__ == "__main__":
    main()
