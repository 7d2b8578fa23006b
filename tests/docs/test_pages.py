"""The code on the pages runs, and the commands that they show are commands as they are."""

import os
import re
import shlex
import subprocess
import sys
import tomllib
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any

import pytest
from page_blocks import ROOT, Block, blocks_of, pages

from femoreg_torch.commands.main import GROUP, parser_of
from femoreg_torch.errors import InputError
from femoreg_torch.registration import load_plan
from femoreg_torch.text import yaml_content
from models.kinds import LOSSES, NETWORKS

SHELL, PYTHON = ("sh", "bash"), "python"
LANGUAGES = (*SHELL, PYTHON, "yaml", "toml", "text", "json", "")
BLOCKS = [block for page in pages() for block in blocks_of(page)]
USUAL = [page for page in pages() if any(b.language == PYTHON and b.mark is None for b in blocks_of(page))]
APART = [page for page in pages() if any(b.mark == "run apart" for b in blocks_of(page))]


def run_python(block: Block, names: dict[str, Any]) -> None:
    """Run a block among the names of the blocks before it; a failure tells page and line."""
    exec(compile("\n" * block.line + block.code, block.page, "exec"), names)


def shell_lines(block: Block) -> list[str]:
    """The commands of a block, one each, without the brackets around what may be left out."""
    code = re.sub(r"\[(--[^\]]+)\]", r"\1", block.code.replace("\\\n", " "))
    return [line.strip() for line in code.splitlines()]


def femoreg_arguments() -> list[tuple[str, list[str]]]:
    """Place and arguments of every `femoreg` command in a block of the pages."""
    shown = [block for block in BLOCKS if block.language in (*SHELL, "text", "")]
    lines = [(block.place, line) for block in shown for line in shell_lines(block)]
    found = [(place, shlex.split(line, comments=True)) for place, line in lines if line.startswith("femoreg ")]
    return [(place, words[1:]) for place, words in found]


def test_every_block_says_what_it_is() -> None:
    assert not [
        block.place for block in BLOCKS if block.language.split(" ")[0] not in LANGUAGES and block.language[:1] != "{"
    ]


def test_every_block_of_a_shell_is_run_or_says_why_not() -> None:
    assert not [block.place for block in BLOCKS if block.language in SHELL and block.mark is None]


def test_the_commands_on_the_pages_are_as_the_parsers_have_them() -> None:
    commands = {command.name: command for command in entry_points(group=GROUP)}
    shown = femoreg_arguments()
    assert len(shown) > 20
    for place, (name, *arguments) in shown:
        assert name in commands, place
        parser = parser_of(commands[name].load(), name)
        try:
            parser.parse_args(arguments)
        except Exception as error:
            pytest.fail(f"{place}: femoreg {name}: {error}")


def test_yaml_on_the_pages_can_be_read() -> None:
    whole = [block for block in BLOCKS if block.language == "yaml" and "…" not in block.code]
    assert len(whole) > 5
    for block in whole:
        try:
            yaml_content(block.code, block.place)
        except InputError as error:
            pytest.fail(str(error))


def test_kinds_on_the_page_of_settings_are_kinds() -> None:
    """By its class or by its kind: a heading names what a preset has to say."""
    page = (ROOT / "docs/reference/settings.md").read_text(encoding="utf-8")
    headed = dict(re.findall(r"### Training: (?:network|loss) `(\w+)`\n\n```\{femoreg-keys\} [\w.]+:(\w+)", page))
    assert headed == {kind: record.__name__ for kind, record in (NETWORKS | LOSSES).items()}


@pytest.mark.parametrize("page", USUAL)
def test_python_on_a_page_runs(page: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    names: dict[str, Any] = {"__name__": "page"}
    monkeypatch.setitem(sys.modules, "page", type(sys)("page"))  # dataclasses look their module up
    for block in blocks_of(page):
        if block.language == PYTHON and block.mark is None:
            run_python(block, names)


def test_the_similarity_of_the_tutorial_is_one_of_a_preset(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The page's class, entry point and preset, installed as a reader would install them."""
    blocks = blocks_of("docs/tutorials/own-similarity.md")
    (code,) = (block.code for block in blocks if block.code.startswith("@dataclass"))
    (project,) = (tomllib.loads(block.code) for block in blocks if block.language == "toml")
    (preset,) = (block.code for block in blocks if block.language == "yaml")
    group = "femoreg_torch.similarities"
    lines = [f"[{group}]", *(f"{name} = {place}" for name, place in project["project"]["entry-points"][group].items())]
    metadata = tmp_path / "my_package-0.1.dist-info"
    metadata.mkdir()
    (metadata / "METADATA").write_text("Metadata-Version: 2.1\nName: my-package\nVersion: 0.1\n", encoding="utf-8")
    (metadata / "entry_points.txt").write_text("\n".join(lines), encoding="utf-8")
    (tmp_path / "my_package.py").write_text(
        f"from dataclasses import dataclass\n\nimport torch\n\n\n{code}", encoding="utf-8"
    )
    (tmp_path / "my_preset.yaml").write_text(preset, encoding="utf-8")
    monkeypatch.syspath_prepend(str(tmp_path))
    similarities = {
        step.name: getattr(step, "similarity", None) for step in load_plan(tmp_path / "my_preset.yaml").steps
    }
    sys.modules.pop("my_package")
    assert repr(similarities["everything together, fine"]) == "RobustDifferences(scale=0.2)"
    assert sum(type(one).__name__ == "RobustDifferences" for one in similarities.values()) == 1


@pytest.mark.long
def test_what_is_run_apart_runs_from_the_first_page_to_the_last(tmp_path: Path) -> None:
    """In one folder, each block in a process of its own, as a reader would who takes one page after the other."""
    without_limits = {key: value for key, value in os.environ.items() if not key.endswith("_NUM_THREADS")}
    environment = without_limits | {"PATH": f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"}
    apart = [block for page in APART for block in blocks_of(page) if block.mark == "run apart"]
    assert len(apart) > 8
    for block in apart:
        shell = ["bash", "-e", "-u", "-c", block.code]
        command = shell if block.language in SHELL else [sys.executable, "-c", block.code]
        ran = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, encoding="utf-8")
        assert ran.returncode == 0, (
            f"{block.place}: status {ran.returncode}\n{ran.stdout[-2000:]}\n{ran.stderr[-2000:]}"
        )


def test_a_mark_without_a_reason_is_none() -> None:
    assert not re.search(
        r"<!-- (run apart|not run)(?!: .{5,} -->)", "".join((ROOT / p).read_text(encoding="utf-8") for p in pages())
    )
