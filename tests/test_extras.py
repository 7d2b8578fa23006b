"""The core of the distribution works alone, and whatever needs more says which extra to install."""

import re
import subprocess
import sys
import tomllib
from importlib.metadata import packages_distributions
from pathlib import Path

import pytest

from femoreg_torch.extras import missing_extra

ROOT = Path(__file__).resolve().parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]


def normalised(distribution: str) -> str:
    """Name of a distribution without version or extras, as package indexes compare it (PEP 503)."""
    return re.sub(r"[-_.]+", "-", re.split(r"[\[<>=~! ]", distribution)[0]).lower()


def distributions(extra: str) -> set[str]:
    """Names of all distributions that an extra installs, those of the extras it includes as well."""
    found: set[str] = set()
    for requirement in PROJECT["optional-dependencies"][extra]:
        if own := re.fullmatch(r"femoreg-torch\[(.*)\]", requirement):
            found.update(*(distributions(name) for name in own[1].split(",")))
        else:
            found.add(normalised(requirement))
    return found


IMPORT_NAMES = {name: name for name in distributions("all")} | {  # the name of the distribution, if it tells no other
    package: normalised(names[0])
    for package, names in packages_distributions().items()
    if normalised(names[0]) in distributions("all")
}


def run_without_extras(code: str) -> subprocess.CompletedProcess[str]:
    """Run Python in which no package of an extra can be found."""
    hide = f"import sys; sys.modules.update(dict.fromkeys({sorted(IMPORT_NAMES)}))\n"  # None: as if not installed
    return subprocess.run([sys.executable, "-c", hide + code], cwd=ROOT, capture_output=True, encoding="utf-8")


COMMAND = "from femoreg_torch.commands.main import main, prepare_process; prepare_process(); sys.exit(main({}))"


@pytest.mark.parametrize(
    "code",
    [
        "import femoreg_torch, femoreg_torch.registration.run, femoreg_torch.detect, femoreg_torch.evaluation",
        COMMAND.format(["--help"]),
        COMMAND.format(["register", "--help"]),
        COMMAND.format(["detect", "--help"]),
    ],
    ids=["import", "overview", "register", "detect"],
)
def test_the_core_needs_no_extra(code: str) -> None:
    done = run_without_extras(code)
    assert done.returncode == 0, done.stderr
    assert done.stderr == ""


@pytest.mark.parametrize("distribution", sorted(distributions("all")))
def test_a_missing_package_names_an_extra_that_brings_it(distribution: str) -> None:
    packages = [package for package, name in IMPORT_NAMES.items() if name == distribution]
    errors = [ModuleNotFoundError(f"No module named '{name}.sub'", name=f"{name}.sub") for name in packages]
    lines = [line for line in map(missing_extra, errors) if line is not None]
    assert lines, f"none of {packages} is known"
    for line in lines:
        named = re.search(r"femoreg-torch\[(\w+)\]", line)
        assert named is not None
        assert distribution in distributions(named[1])


def test_what_is_in_no_extra_is_not_spoken_of() -> None:
    assert missing_extra(ModuleNotFoundError("No module named 'somebody'", name="somebody")) is None
    assert missing_extra(ModuleNotFoundError("nothing named")) is None


@pytest.mark.parametrize(
    ("command", "extras"),
    [
        (["phantom"], {"sim"}),
        (["train", "quick.yaml", "--out"], {"sim", "train", "all"}),
        (["tables"], {"study"}),
        (["report"], {"study", "all"}),
    ],
)
def test_a_command_without_its_extra_says_so_in_one_line(tmp_path: Path, command: list[str], extras: set[str]) -> None:
    done = run_without_extras(COMMAND.format([*command, str(tmp_path / "out")]))
    assert done.returncode == 2, done.stderr
    assert done.stderr.count("\n") == 1
    named = re.search(r"pip install 'femoreg-torch\[(\w+)\]'", done.stderr)
    assert named is not None, done.stderr
    assert named[1] in extras
    assert not (tmp_path / "out").exists()


def test_no_extra_repeats_the_core() -> None:
    core = {normalised(requirement) for requirement in PROJECT["dependencies"]}
    assert not core & distributions("all")
