"""Protocols: which procedures they have, what their conditions change, and that unknown keys are refused."""

from pathlib import Path
from typing import Any

import pytest
import yaml
from femoreg_torch.configs import load_preset, preset_names

from femoreg_torch.errors import InputError
from femoreg_torch.settings import read_record
from sim.study.conditions import simulation_of
from sim.study.protocol import Protocol, load_protocol, varied
from sim.study.study import plan_study
from sim.study.work import Simulated, settings_of
from sim.theatre.settings import Simulation

PROTOCOLS = [name for name in preset_names("study") if "vary" in load_preset("study", name)]


def written(folder: Path, **content: Any) -> str:
    path = folder / "mine.yaml"
    path.write_text(yaml.safe_dump(content), encoding="utf-8")
    return str(path)


@pytest.mark.parametrize("name", PROTOCOLS)
def test_every_preset_can_be_read_and_its_conditions_differ(name: str) -> None:
    protocol = load_protocol(name)
    settings = settings_of(protocol, name)
    digests = {setting.digest for setting in settings.values()}
    assert len(digests) == len(protocol.vary)
    told = [tuple(sorted(varied(variation).items())) for variation in protocol.vary]
    assert len(set(told)) == len(told)  # the table can tell them apart by what was varied


def test_the_protocols_that_are_promised_are_there() -> None:
    assert {"paper", "device_as_fiducial", "views", "dose", "field_of_view", "devices", "masks", "motion"} <= {
        *PROTOCOLS
    }
    assert {"intrinsics", "ct", "starts", "wrong", "closed_loop", "own_cases"} <= {*PROTOCOLS}
    assert load_protocol("paper").procedures == 1000


@pytest.mark.parametrize("name", PROTOCOLS)
def test_the_first_run_of_every_preset_can_be_set_up(name: str, tmp_path: Path) -> None:
    """All that a run needs is read and checked before anything is simulated."""
    if "cases" in load_preset("study", name):
        pytest.skip("its cases are the user's")
    plan = plan_study(name, 1, tmp_path, None, False)
    assert isinstance(plan.work, Simulated)
    run, *others = plan.runs
    assert (run.procedure.number, run.kind, len(others)) == (1, "procedural", len(plan.work.settings) - 1)
    setting = plan.work.settings[run.condition]
    content = simulation_of(setting.variation, setting.simulation)
    assert read_record(Simulation, content, name).acquisition.step_mm > 0
    assert setting.plan.steps
    assert not list(tmp_path.iterdir())


def test_the_procedures_of_the_accuracy_page_are_a_protocol(tmp_path: Path) -> None:
    protocol = load_protocol("accuracy")
    everything = protocol.first(60, real=True)
    assert len(everything) == 60
    assert everything == load_protocol("conditions").first(60, real=True)
    assert len({p.seed for p in everything}) == len({p.name for p in everything}) == 60
    assert (everything[0].name, everything[1].name, everything[41].name) == (
        "01_301_left",
        "02_bmf_right",
        "42_z013_left",
    )
    procedural = [p for p in everything if p.procedural]
    assert protocol.first(60, real=False) == procedural
    assert len({p.patient for p in procedural}) == 30
    for part in (everything, procedural, everything[:20]):
        assert sum(p.side == "left" for p in part) == len(part) / 2
    for subject in protocol.bones:
        of_it = [p for p in everything if p.patient == subject]
        assert len(of_it) == 5
        assert {p.side for p in of_it} == {"left", "right"}
    assert {p.patient for p in everything[:20]} >= set(protocol.bones)
    with pytest.raises(InputError, match="has 30 procedures, 31"):
        plan_study("accuracy", 31, tmp_path, None, False)


@pytest.mark.parametrize("real", [False, True])
def test_a_procedure_is_the_same_however_many_are_asked_for(real: bool) -> None:
    protocol = load_protocol("paper")
    one, other = ([protocol.procedure(n, real) for n in range(1, count)] for count in (8, 200))
    assert one == other[:7]
    assert len({procedure.seed for procedure in other}) == len(other)
    for kind in (True, False):
        sides = [procedure.side for procedure in other if procedure.procedural is kind]
        assert not sides or 0.4 < sides.count("left") / len(sides) < 0.6
    if real:
        assert {procedure.patient for procedure in other if not procedure.procedural} == set(protocol.subjects)


def test_the_patients_are_nobody_that_was_trained_on_or_measured_with() -> None:
    protocol = load_protocol("paper")
    patients = {int(protocol.procedure(n, False).patient) for n in range(1, 1001)}
    training = load_preset("training", "hip14")
    told = yaml.safe_dump(training)
    known = {int(word) for word in told.replace("[", " ").replace(",", " ").replace("]", " ").split() if word.isdigit()}
    known |= {int(p.patient) for p in load_protocol("accuracy").first(60, real=True) if p.procedural}
    assert {1, 7, 101, 301, 330} <= known
    assert not patients & known
    assert min(patients) > 10000


def test_another_seed_gives_other_procedures() -> None:
    first, second = (Protocol([], seed=seed).procedure(1, False) for seed in (1, 2))
    assert first.seed != second.seed


def test_all_runs_of_fewer_procedures_are_among_those_of_more(tmp_path: Path) -> None:
    few, many = (plan_study("dose", count, tmp_path, None, False).runs for count in (2, 5))
    assert list(few) == list(many)[: len(few)]
    assert len(many) == 5 * 7
    assert dict(many[0].varied) == {"dose_ugy": 5}


def test_settings_are_told_apart_by_what_they_change_alone(tmp_path: Path) -> None:
    base = {"extends": "paper", "vary": [{"name": "a", "xray": {"kvp": 80}}]}
    digests = []
    for change in ({}, {"preset": "paper"}, {"simulation": "mixed"}, {"seed": 3}):
        runs = plan_study(written(tmp_path, **base, **change), 1, tmp_path, None, False).runs
        digests.append({run.condition: run.settings for run in runs})
    assert digests[0] == digests[2]
    assert all(digests[0][name] != digests[1][name] != digests[3][name] for name in ("a", "paper"))
    more = plan_study(written(tmp_path, extends="paper", vary=[{"name": "b"}]), 1, tmp_path, None, False).runs
    assert more[0].settings == digests[0]["paper"]  # a condition more leaves the others as they are


@pytest.mark.parametrize(
    ("content", "says"),
    [
        ({"vary": [{"name": "a"}], "color": 1}, "unknown key 'color'"),
        ({"vary": [{"name": "a", "xray": {"kpv": 80}}]}, "a, xray: unknown key 'kpv'"),
        ({"vary": [{"name": "a", "told": {"fault": "rain"}}]}, "no fault 'rain'"),
        ({"vary": [{"name": "a", "preset": "quickest"}]}, "no registration preset 'quickest'"),
        ({"vary": [{"name": "a/b"}]}, "letters, digits and _"),
        ({"vary": [{"name": "a"}, {"name": "a"}]}, "2 conditions are called 'a'"),
        ({"vary": []}, "at least one condition"),
        ({"vary": [{"name": "a"}], "procedures": 0}, "procedures: at least 1"),
        ({"seed": 1}, "has no `vary`"),
        ({"vary": [{"name": "a", "xray": {"kvp": 80}}], "cases": ["x"]}, "recorded cases cannot be simulated .*xray"),
        ({"vary": [{"name": "a"}], "cases": ["nowhere/*"]}, "no folder with a case.yaml fits nowhere"),
        ({"vary": [{"name": "a", "varied": {"x": [1, 2]}}]}, "varied, x: a number or text"),
        ({"vary": [{"name": "a", "views": 9}]}, "a, views: 1 to 3 views were expected, so many there are; found 9"),
        ({"vary": [{"name": "a", "views": 0}]}, "a, views: 1 to 3 views .* found 0"),
    ],
)
def test_what_is_wrong_is_told(content: dict[str, Any], says: str, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=says):
        plan_study(written(tmp_path, **content), 1, tmp_path, None, False)


def test_real_bones_that_are_not_there_are_told_before_anything_is_made(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"--data: .*bmf.npz: there is no such file"):
        plan_study("paper", 1, tmp_path, tmp_path, False)


def test_real_bones_that_are_there_are_every_second_patient(tmp_path: Path) -> None:
    (tmp_path / "meshes").mkdir()
    for subject in load_protocol("paper").subjects:
        (tmp_path / "meshes" / f"{subject}.npz").touch()
    without, with_them = (plan_study("paper", 4, tmp_path, data, False).runs for data in (None, tmp_path))
    assert [run.kind for run in without] == ["procedural"] * 4
    assert [run.kind for run in with_them] == ["procedural", "real"] * 2
    assert [run.procedure.patient for run in with_them] == ["10001", "bmf", "10003", "gias2"]
    assert not {run.name for run in without} & {run.name for run in with_them}  # they do not mix


def test_the_page_on_studies_names_every_preset_and_its_examples_can_be_read(tmp_path: Path) -> None:
    page = (Path(__file__).parents[3] / "docs" / "study.md").read_text(encoding="utf-8")
    for name in PROTOCOLS:
        assert f"`{name}`" in page
    varying, recorded = (block.split("```")[0] for block in page.split("```yaml\n")[1:])
    (tmp_path / "varying.yaml").write_text(varying, encoding="utf-8")
    protocol = load_protocol(tmp_path / "varying.yaml")
    assert [variation.name for variation in protocol.vary][:2] == ["paper", "low_dose"]
    settings_of(protocol, "varying")
    (tmp_path / "recorded.yaml").write_text(recorded, encoding="utf-8")
    assert load_protocol(tmp_path / "recorded.yaml").cases == ["recordings/*", "another/case"]


def test_the_paper_preset_registers_the_same_procedures() -> None:
    usual, slow = load_protocol("paper"), load_protocol("paper_preset")
    assert slow.first(5, real=True) == usual.first(5, real=True)
    assert (slow.vary, slow.simulation) == (usual.vary, usual.simulation)
    assert (slow.preset, slow.procedures) == ("paper", 60)
