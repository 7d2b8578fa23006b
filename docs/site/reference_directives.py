"""Pages of reference that are made from the code itself: commands, public names, keys of presets.

Each directive writes Markdown from parsers, docstrings or dataclasses, which Sphinx then reads like any other.
"""

import dataclasses
import inspect
import re
from abc import ABC, abstractmethod
from collections.abc import Iterator
from importlib import import_module
from importlib.metadata import entry_points
from typing import Any, ClassVar, Literal, get_args, get_origin, get_type_hints

import yaml
from docutils import nodes
from sphinx.application import Sphinx
from sphinx.util.docutils import SphinxDirective

import femoreg_torch
from femoreg_torch.commands.main import GROUP, parser_of


class FromCode(SphinxDirective, ABC):
    """Puts Markdown made by `markdown` in its place, headings included."""

    optional_arguments = 1

    def run(self) -> list[nodes.Node]:
        """The nodes that Sphinx reads from it."""
        return self.parse_text_to_nodes("\n".join(self.markdown()), allow_section_headings=True)

    @abstractmethod
    def markdown(self) -> Iterator[str]:
        """Lines of Markdown."""


class Commands(FromCode):
    """Every command with the help that it prints."""

    def markdown(self) -> Iterator[str]:
        """A table of all, then a heading and a help each."""
        commands = {command.name: command.load() for command in entry_points(group=GROUP)}
        yield from ("| command | does |", "| --- | --- |")
        for name, function in commands.items():
            summary = (inspect.getdoc(function) or "").partition("\n\n")[0].replace("\n", " ")
            yield f"| [`femoreg {name}`](#femoreg-{name}) | {_cell(summary.partition('. ')[0].rstrip('.'))} |"
        yield ""
        for name, function in commands.items():
            yield from (f"## femoreg {name}", "", "```text")
            yield parser_of(function, name).format_help().rstrip()
            yield from ("```", "")


class PublicNames(FromCode):
    """Every name of `import femoreg_torch as femoreg`, with signature and docstring."""

    _of: ClassVar[dict[bool, str]] = {True: "autoclass", False: "autofunction"}

    def markdown(self) -> Iterator[str]:
        """A heading for each room, and its names."""
        for room, names in femoreg_torch._PUBLIC.items():
            yield from (f"## {room}", "", inspect.getdoc(import_module(f"femoreg_torch.{room}")) or "", "")
            for name in names:
                public = getattr(femoreg_torch, name)
                is_class = inspect.isclass(public)
                yield from (f"### {name}", "", "```{eval-rst}", f".. {self._of[is_class]}:: femoreg_torch.{name}")
                if is_class:
                    yield "   :members:"
                yield from ("```", "")
                if is_class and (comments := _comments(public)):
                    yield from ("| field | is |", "| --- | --- |")
                    yield from (f"| `{field}` | {_cell(meaning)} |" for field, meaning in comments.items())
                    yield ""


class Keys(FromCode):
    """The keys of a record of settings, `module:Class`: its docstring, and type and default of every key."""

    required_arguments = 1
    optional_arguments = 0

    def markdown(self) -> Iterator[str]:
        """The docstring and a table."""
        module, _, name = self.arguments[0].partition(":")
        record = getattr(import_module(module), name)
        hints = get_type_hints(record)
        comments = _comments(record)
        yield from (inspect.getdoc(record) or "", "", "| key | value | left out | |", "| --- | --- | --- | --- |")
        for field in dataclasses.fields(record):
            cells = (f"`{field.name}`", _told(hints[field.name]), _default(field), comments.get(field.name, ""))
            yield f"| {' | '.join(map(_cell, cells))} |"
        yield ""


def _cell(text: str) -> str:
    return text.replace("|", "\\|")


def _told(hint: Any) -> str:
    """A type in the words of a YAML file."""
    words = {float: "number", int: "whole number", str: "text", bool: "true, false", type(None): "null", Any: "any"}
    if hint in words:
        return words[hint]
    kinds = [kind for kind in get_args(hint) if kind is not Ellipsis]
    if get_origin(hint) is Literal:
        return ", ".join(f"`{kind}`" for kind in kinds)
    if get_origin(hint) in (list, tuple):
        return f"[{', '.join(map(_told, kinds))}{', …' if len(get_args(hint)) > len(kinds) or len(kinds) == 1 else ''}]"
    if get_origin(hint) is dict:
        return f"mapping of {_told(kinds[0])} to {_told(kinds[1])}"
    if kinds:
        return " or ".join(dict.fromkeys(map(_told, kinds)))
    return str(getattr(hint, "__name__", hint))


def _default(field: "dataclasses.Field[Any]") -> str:
    if field.default is not dataclasses.MISSING:
        value = field.default
    elif field.default_factory is not dataclasses.MISSING:
        value = field.default_factory()
    else:
        return "**needed**"
    if dataclasses.is_dataclass(value):
        return f"that of {type(value).__name__}"
    return (
        f"`{yaml.safe_dump(value, default_flow_style=True, allow_unicode=True).removesuffix('...' + chr(10)).strip()}`"
    )


def _comments(record: type) -> dict[str, str]:
    """What the source says behind each field."""
    found = (re.fullmatch(r"    (\w+): [^#]*# (.+)", line) for line in inspect.getsource(record).splitlines())
    return {match[1]: match[2] for match in found if match}


def setup(app: Sphinx) -> dict[str, bool]:
    """Make the directives known."""
    app.add_directive("femoreg-commands", Commands)
    app.add_directive("femoreg-names", PublicNames)
    app.add_directive("femoreg-keys", Keys)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
