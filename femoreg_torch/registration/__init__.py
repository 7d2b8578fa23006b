"""Registration: scene, objective, stages as data, the workflow that runs them, and the quality of its result."""

from femoreg_torch.registration.plan import Plan, load_plan
from femoreg_torch.registration.prepare import prepare_scene
from femoreg_torch.registration.scene import Poses, Scene
from femoreg_torch.registration.workflow import Outcome, StepTrace, run_plan

__all__ = ["Outcome", "Plan", "Poses", "Scene", "StepTrace", "load_plan", "prepare_scene", "run_plan"]
