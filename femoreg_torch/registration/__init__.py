"""Registration: scene, objective, steps as data, the workflow that runs them, and the quality of its result."""

from femoreg_torch.geometry import Poses
from femoreg_torch.registration.imaging import Imaging
from femoreg_torch.registration.level import Level
from femoreg_torch.registration.objective import Prior
from femoreg_torch.registration.orbit import OrbitSearch
from femoreg_torch.registration.plan import Plan, load_plan, plan_from
from femoreg_torch.registration.prepare.scene import prepare_scene
from femoreg_torch.registration.run import register
from femoreg_torch.registration.scene import RigidObject, Scene
from femoreg_torch.registration.stage import BodyPlan, Stage
from femoreg_torch.registration.step import Step
from femoreg_torch.registration.workflow import Outcome, run_plan

__all__ = [
    "BodyPlan",
    "Imaging",
    "Level",
    "OrbitSearch",
    "Outcome",
    "Plan",
    "Poses",
    "Prior",
    "RigidObject",
    "Scene",
    "Stage",
    "Step",
    "load_plan",
    "plan_from",
    "prepare_scene",
    "register",
    "run_plan",
]
