"""A similarity, an optimiser and a step of one's own, from outside the packages: as objects, and by kind in presets."""

import importlib
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
import torch
from torch import Tensor

from femoreg_torch.case import Start
from femoreg_torch.drr import project
from femoreg_torch.errors import InputError
from femoreg_torch.geometry import CArm, centred_camera, rigid
from femoreg_torch.optimize import LevenbergMarquardt, Objective, Result, Stop
from femoreg_torch.registration import BodyPlan, Level, Plan, Scene, Stage, load_plan, run_plan
from femoreg_torch.registration.scene import RigidObject
from femoreg_torch.similarity import SmoothFixedSimilarity, against_field, similarity_quadratic
from femoreg_torch.volume import Volume, axis_aligned

MODULE = """
from dataclasses import dataclass, replace

import torch

from femoreg_torch.case import StageRecord
from femoreg_torch.optimize import Result, Stop


@dataclass(frozen=True)
class SquaredDifferences:
    gain: float = 1.0

    def against(self, fixed, weights):
        return lambda images: self.gain * (images - fixed).square().mean((1, 2))


@dataclass(frozen=True)
class Faulty:
    how: str

    def against(self, fixed, weights):
        if self.how == "raises at once":
            raise KeyError("mask")
        faults = {
            "raises": lambda images: {}["boom"],
            "one number": lambda images: (images - fixed).square().mean(),
            "one column": lambda images: (images - fixed).square().mean((1, 2))[:, None],
            "no tensor": lambda images: [0.0] * len(images),
            "linear": lambda images: images.sum((1, 2)),
            "nan": lambda images: images.sum((1, 2)) * float("nan"),
        }
        return faults[self.how]


@dataclass(frozen=True)
class Grid:
    steps: int

    def minimise(self, objective, n, seed):
        line = torch.linspace(-1, 1, self.steps, dtype=torch.float64)
        deltas = torch.cartesian_prod(*[line] * n).view(-1, n)
        values = objective(deltas)
        best = int(values.argmin())
        return Result(deltas[best], float(values[best]), Stop.BUDGET, len(deltas))


@dataclass(frozen=True)
class Lost:
    how: str

    def minimise(self, objective, n, seed):
        delta = torch.zeros(n, dtype=torch.float64)
        if self.how == "raises":
            return {}["boom"]
        if self.how == "none":
            return None
        if self.how == "words":
            return Result(delta, 0.0, "done", 1)
        if self.how == "list":
            return Result(delta.tolist(), 0.0, Stop.BUDGET, 1)
        return Result(delta[:1] if self.how == "short" else delta * float("nan"), 0.0, Stop.BUDGET, 1)


@dataclass(frozen=True)
class Bad:
    name: str
    how: str

    def left_out(self, scene, poses):
        return {}["left"] if self.how == "cannot say" else None

    def run(self, scene, poses, seed):
        if self.how == "raises":
            raise KeyError("boom")
        if self.how == "scales":
            scaled = {name: pose * 2 for name, pose in poses.camera1_from.items()}
            yield StageRecord(self.name, None, 0.0, 1, 0.0, "", replace(poses, camera1_from=scaled))


@dataclass(frozen=True)
class Nothing:
    name: str

    def left_out(self, scene, poses):
        return "it never does anything"

    def run(self, scene, poses, seed):
        raise AssertionError


not_settings = max
"""
ENTRY_POINTS = """
[femoreg_torch.similarities]
grid = mine_of_a_test:Grid
squared_differences = mine_of_a_test:SquaredDifferences
faulty = mine_of_a_test:Faulty
[femoreg_torch.optimisers]
squared_differences = mine_of_a_test:SquaredDifferences
grid = mine_of_a_test:Grid
gone = mine_of_a_test:Gone
lost = mine_of_a_test:Lost
function = mine_of_a_test:not_settings
[femoreg_torch.steps]
nothing = mine_of_a_test:Nothing
bad = mine_of_a_test:Bad
"""
PRESET = """
steps:
  - {name: idle, kind: nothing}
  - name: ball
    kind: stage
    images: first
    kinds: [plain]
    render: [all]
    bodies: [{move: [ball], rotation_deg: [0, 0, 0], translation_mm: [8, 8, 0]}]
    level: {pixel_mm: 2, step_mm: 2}
    similarity: {kind: squared_differences, gain: 4}
    optimiser: {kind: grid, steps: 9}
"""


@pytest.fixture
def installed(tmp_path: Path) -> Iterator[Path]:
    """A folder on the path with a package installed in it: a module, and the metadata that names its entry points."""
    (tmp_path / "mine_of_a_test.py").write_text(MODULE, encoding="utf-8")
    metadata = tmp_path / "mine-1.0.dist-info"
    metadata.mkdir()
    (metadata / "METADATA").write_text("Metadata-Version: 2.1\nName: mine\nVersion: 1.0\n", encoding="utf-8")
    (metadata / "entry_points.txt").write_text(ENTRY_POINTS, encoding="utf-8")
    sys.path.insert(0, str(tmp_path))
    importlib.invalidate_caches()
    yield tmp_path
    sys.path.remove(str(tmp_path))
    sys.modules.pop("mine_of_a_test", None)


@pytest.fixture
def scene() -> tuple[Scene, Tensor]:
    """One soft ball in one image, and its true pose; it starts 4 mm left of and 6 mm below it."""
    x, y, z = torch.meshgrid(*[torch.arange(-10.0, 11.0)] * 3, indexing="ij")
    ball = Volume(0.03 * torch.exp(-(x**2 + y**2 + 2 * z**2) / 32), axis_aligned((2, 2, 2), (-20, -20, -20)))
    carm = CArm(centred_camera(1000.0, (2.0, 2.0), (48, 56)), (0.0, 0.0, 620.0), (0.0, 1.0, 0.0))
    truth = rigid(translation=torch.tensor([4.0, -6.0, 600.0], dtype=torch.float64))
    image = project(ball, truth[None], carm.camera, 2.0)[0]
    start = Start(rigid(translation=torch.tensor([0.0, 0.0, 600.0], dtype=torch.float64)))
    thing = RigidObject(ball, torch.zeros(3, dtype=torch.float64), ("plain",), start)
    return Scene(carm, {"ball": thing}, {"plain": (image,)}), truth


class Differences:
    """Mean squared differences: neither a dataclass nor anything of the library."""

    def against(self, fixed: Tensor, weights: Tensor | None):  # type: ignore[no-untyped-def]
        return lambda images: (images - fixed).square().mean((1, 2))


class Adam:
    """Torch's Adam on slopes by finite differences."""

    def minimise(self, objective: Objective, n: int, seed: int) -> Result:
        delta = torch.zeros(n, dtype=torch.float64, requires_grad=True)
        adam = torch.optim.Adam([delta], lr=0.03)
        for _ in range(150):
            steps = 1e-2 * torch.eye(n, dtype=torch.float64)
            here = delta.detach()
            delta.grad = (objective(here + steps) - objective(here - steps)).double() / 2e-2
            adam.step()
        end = delta.detach()
        return Result(end, float(objective(end[None])[0]), Stop.BUDGET, 300 * n)


@pytest.mark.parametrize("optimiser", [Adam(), LevenbergMarquardt(tol_f=1e-12)])
def test_objects_of_one_s_own_make_a_stage(optimiser, scene: tuple[Scene, Tensor]) -> None:  # type: ignore[no-untyped-def]
    body = BodyPlan(["ball"], [0, 0, 0], [8, 8, 0])
    stage = Stage("own", "first", ["plain"], ["ball"], [body], Level(2, 2), Differences(), optimiser)
    found = run_plan(scene[0], Plan("own", (stage,)), None, seed=0)
    torch.testing.assert_close(found.poses.camera1_from["ball"], scene[1], atol=0.05, rtol=0)


def test_a_preset_names_what_another_package_registers(installed: Path, scene: tuple[Scene, Tensor]) -> None:
    (installed / "mine.yaml").write_text(PRESET, encoding="utf-8")
    plan = load_plan(installed / "mine.yaml")
    found = run_plan(scene[0], plan, None, seed=0)
    torch.testing.assert_close(found.poses.camera1_from["ball"], scene[1], atol=2.1, rtol=0)  # a grid of 2 mm
    assert [record.evaluations for record in found.trace] == [81]
    assert found.skipped == ("stage “idle” was left out: it never does anything",)


@pytest.mark.parametrize(
    ("old", "new", "says"),
    [
        ("kind: grid", "kind: gred", "unknown kind 'gred'. Known kinds: cma_es, bobyqa, levenberg_marquardt, function"),
        ("kind: grid", "kind: gone", "kind 'gone', mine_of_a_test:Gone, cannot be imported"),
        ("kind: grid", "kind: function", "was expected to be a dataclass"),
        (
            "steps: 9",
            "step: 9",
            "unknown key 'step'. Known keys: steps. .* null in place of its value",
        ),
        ("gain: 4", "gain: much", "gain"),
        ("kind: squared_differences, gain: 4", "kind: grid, steps: 4", r"has no method `against`, which this kind"),
        ("kind: grid, steps: 9", "kind: squared_differences", r"has no method `minimise`, which this kind needs"),
    ],
)
def test_mistakes_are_told(installed: Path, old: str, new: str, says: str) -> None:
    (installed / "mine.yaml").write_text(PRESET.replace(old, new), encoding="utf-8")
    with pytest.raises(InputError, match=f"mine.yaml, step 2.*, .*{says}"):
        load_plan(installed / "mine.yaml")


_EXPECTED = r"costs of shape \(\d+,\) were expected, one for each image \(B, H, W\), got"
_WITH_SLOPES = ("linear", "its second derivative is zero, and Levenberg–Marquardt needs .*Choose an optimiser")


@pytest.mark.parametrize(
    ("how", "says"),
    [
        ("raises at once", r"raised KeyError: 'mask' \(mine_of_a_test.py, line \d+\)"),
        ("raises", r"raised KeyError: 'boom' \(mine_of_a_test.py, line \d+\)"),
        ("one number", rf"{_EXPECTED} \(\)"),
        ("one column", rf"{_EXPECTED} \(\d+, 1\)"),
        ("no tensor", f"{_EXPECTED} list"),
        ("nan", "gave nan"),
        _WITH_SLOPES,
    ],
)
@pytest.mark.parametrize("optimiser", ["{kind: grid, steps: 9}", "{kind: levenberg_marquardt, max_iterations: 3}"])
def test_faults_of_a_similarity_are_told_by_its_name(  # type: ignore[no-untyped-def]
    installed: Path, scene, how: str, says: str, optimiser: str
) -> None:
    preset = PRESET.replace("kind: squared_differences, gain: 4", f"kind: faulty, how: {how}")
    (installed / "mine.yaml").write_text(preset.replace("{kind: grid, steps: 9}", optimiser), encoding="utf-8")
    plan = load_plan(installed / "mine.yaml")
    if how == "linear" and "grid" in optimiser:
        run_plan(scene[0], plan, None, seed=0)  # values alone it has
        return
    with pytest.raises(InputError, match=rf"similarity faulty \(mine_of_a_test:Faulty\): {says}"):
        run_plan(scene[0], plan, None, seed=0)


@pytest.mark.parametrize(
    ("how", "says"),
    [
        ("raises", r"raised KeyError: 'boom' \(mine_of_a_test.py, line \d+\)"),
        ("none", "a Result was expected, got NoneType"),
        ("words", "a Stop was expected to say why it ended, got str"),
        ("list", r"a finite delta of shape \(2,\) was expected"),
        ("short", r"a finite delta of shape \(2,\) was expected"),
        ("nan", r"a finite delta of shape \(2,\) was expected"),
    ],
)
def test_faults_of_an_optimiser_are_told_by_its_name(  # type: ignore[no-untyped-def]
    installed: Path, scene, how: str, says: str
) -> None:
    text = PRESET.replace("{kind: grid, steps: 9}", f"{{kind: lost, how: {how}}}")
    (installed / "mine.yaml").write_text(text, encoding="utf-8")
    with pytest.raises(InputError, match=rf"optimiser lost \(mine_of_a_test:Lost\): {says}"):
        run_plan(scene[0], load_plan(installed / "mine.yaml"), None, seed=0)


@pytest.mark.parametrize(
    ("how", "says"),
    [
        ("raises", r"step bad \(mine_of_a_test:Bad\): raised KeyError: 'boom' \(mine_of_a_test.py, line \d+\)"),
        ("cannot say", r"step bad \(mine_of_a_test:Bad\): raised KeyError: 'left' \(mine_of_a_test.py, line \d+\)"),
        ("yields nothing", r"bad \(mine_of_a_test:Bad\) gave no record"),
        ("scales", "the pose of the ball: not a rigid transform"),
    ],
)
def test_faults_of_a_step_are_told_by_its_name(installed: Path, scene, how: str, says: str) -> None:  # type: ignore[no-untyped-def]
    text = PRESET.replace("{name: idle, kind: nothing}", f"{{name: odd, kind: bad, how: {how}}}")
    (installed / "mine.yaml").write_text(text, encoding="utf-8")
    with pytest.raises(InputError, match=rf"mine.yaml, step “odd”: {says}"):
        run_plan(scene[0], load_plan(installed / "mine.yaml"), None, seed=0)


def test_a_kind_of_images_that_no_case_has_is_told(installed: Path, scene) -> None:  # type: ignore[no-untyped-def]
    (installed / "mine.yaml").write_text(PRESET.replace("[plain]", "[plane]"), encoding="utf-8")
    with pytest.raises(InputError, match=r"no images of a kind “plane”; there are: “plain”, and \[all\]"):
        run_plan(scene[0], load_plan(installed / "mine.yaml"), None, seed=0)


def test_a_similarity_with_derivatives_of_its_own_is_checked_too() -> None:
    class Own(Differences):
        def against(self, fixed: Tensor, weights: Tensor | None):  # type: ignore[no-untyped-def]
            class Fixed:
                def __call__(self, images: Tensor) -> Tensor:
                    return images.sum((1, 2))

                def quadratic(self, image: Tensor, jacobian: Tensor):  # type: ignore[no-untyped-def]
                    return 1.0, jacobian.new_zeros(1, jacobian.shape[-1]), jacobian.new_zeros(2, 2)

            return Fixed()

    prepared = against_field(Own(), torch.ones(6, 7), None, None)
    assert isinstance(prepared, SmoothFixedSimilarity)
    with pytest.raises(InputError, match=r"Own: second derivatives of shape \(3, 3\) were expected"):
        similarity_quadratic(prepared, torch.ones(6, 7), torch.ones(6, 7, 3))


def test_without_that_package_its_kinds_are_unknown(tmp_path: Path) -> None:
    (tmp_path / "mine.yaml").write_text(PRESET, encoding="utf-8")
    with pytest.raises(
        InputError, match=r"step 1 \('idle'\): unknown kind 'nothing'. Known kinds: stage, orbit_search"
    ):
        load_plan(tmp_path / "mine.yaml")
