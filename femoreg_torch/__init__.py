"""Fiducial-free 2D/3D registration of femur and drilling device for robot-assisted femoroplasty."""

import os
from importlib import import_module
from typing import TYPE_CHECKING, Any

__version__ = "0.1.0"

# Threads that wait actively for one another make everything ten times slower where others use the machine too. OpenMP
# asks for this once, when torch is imported: how often its threads look before they sleep.
if "OMP_WAIT_POLICY" not in os.environ:
    os.environ.setdefault("GOMP_SPINCOUNT", "1000")

# OpenCV asks for this once, when it is imported, and then allocates no image that claims to be larger than a detector.
os.environ.setdefault("OPENCV_IO_MAX_IMAGE_PIXELS", str(2**26))

if TYPE_CHECKING:
    from femoreg_torch.anatomy import Anatomy as Anatomy
    from femoreg_torch.anatomy import label_table as label_table
    from femoreg_torch.anatomy import load_anatomy as load_anatomy
    from femoreg_torch.case import Case as Case
    from femoreg_torch.case import CaseObject as CaseObject
    from femoreg_torch.case import Result as Result
    from femoreg_torch.case import Start as Start
    from femoreg_torch.case import Verdict as Verdict
    from femoreg_torch.case import read_case as read_case
    from femoreg_torch.case import read_result as read_result
    from femoreg_torch.case import write_case as write_case
    from femoreg_torch.detect import load_network as load_network
    from femoreg_torch.drr import project as project
    from femoreg_torch.errors import InputError as InputError
    from femoreg_torch.evaluation import evaluate as evaluate
    from femoreg_torch.evaluation import write_report as write_report
    from femoreg_torch.geometry import Camera as Camera
    from femoreg_torch.geometry import CArm as CArm
    from femoreg_torch.geometry import Poses as Poses
    from femoreg_torch.geometry import load_carm as load_carm
    from femoreg_torch.optimize import Bobyqa as Bobyqa
    from femoreg_torch.optimize import CmaEs as CmaEs
    from femoreg_torch.optimize import LevenbergMarquardt as LevenbergMarquardt
    from femoreg_torch.registration import BodyPlan as BodyPlan
    from femoreg_torch.registration import Level as Level
    from femoreg_torch.registration import OrbitSearch as OrbitSearch
    from femoreg_torch.registration import Plan as Plan
    from femoreg_torch.registration import RigidObject as RigidObject
    from femoreg_torch.registration import Scene as Scene
    from femoreg_torch.registration import Stage as Stage
    from femoreg_torch.registration import load_plan as load_plan
    from femoreg_torch.registration import prepare_scene as prepare_scene
    from femoreg_torch.registration import register as register
    from femoreg_torch.registration import run_plan as run_plan
    from femoreg_torch.similarity import GradientOrientation as GradientOrientation
    from femoreg_torch.similarity import GradNcc as GradNcc
    from femoreg_torch.similarity import Ncc as Ncc
    from femoreg_torch.volume import Volume as Volume
    from femoreg_torch.volume import read_ct as read_ct
    from femoreg_torch.volume import read_volume as read_volume
    from femoreg_torch.volume import voxelise_mesh as voxelise_mesh

# The public names by module, imported when they are first used: `import femoreg_torch` alone loads nothing heavy.
_PUBLIC = {
    "anatomy": ("Anatomy", "label_table", "load_anatomy"),
    "case": ("Case", "CaseObject", "Result", "Start", "Verdict", "read_case", "read_result", "write_case"),
    "detect": ("load_network",),
    "drr": ("project",),
    "errors": ("InputError",),
    "evaluation": ("evaluate", "write_report"),
    "geometry": ("CArm", "Camera", "Poses", "load_carm"),
    "optimize": ("Bobyqa", "CmaEs", "LevenbergMarquardt"),
    "registration": (
        "BodyPlan",
        "Level",
        "OrbitSearch",
        "Plan",
        "RigidObject",
        "Scene",
        "Stage",
        "load_plan",
        "prepare_scene",
        "register",
        "run_plan",
    ),
    "similarity": ("GradNcc", "GradientOrientation", "Ncc"),
    "volume": ("Volume", "read_ct", "read_volume", "voxelise_mesh"),
}
_MODULE_OF = {name: module for module, names in _PUBLIC.items() for name in names}


def __getattr__(name: str) -> Any:
    if name not in _MODULE_OF:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_MODULE_OF[name]}"), name)


def __dir__() -> list[str]:
    return sorted({*_MODULE_OF, "__doc__", "__version__"})
