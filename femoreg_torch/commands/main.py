"""`femoreg COMMAND …`: finds the commands, parses their arguments, and turns bad input into one line.

A command is a plain typed function that an installed package names in the entry-point group
`femoreg_torch.commands`; its Google docstring is its help. Parameters without a default that come before a `*` are
positional (a `list[…]` takes one or more values), all others are options (a `tuple[…, ...]` takes several values);
`Annotated[int, "-n"]` adds a short form.
Only the chosen command is imported.
"""

import ast
import atexit
import gc
import inspect
import io
import itertools
import os
import re
import sys
import warnings
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from difflib import get_close_matches
from importlib.machinery import PathFinder
from importlib.metadata import EntryPoint, entry_points
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn, get_args, get_origin, get_type_hints

import femoreg_torch
from femoreg_torch.commands.status import BAD_INPUT, DONE, INTERRUPTED
from femoreg_torch.errors import InputError, defect_in_one_line, shortened
from femoreg_torch.extras import missing_extra
from femoreg_torch.memory import keep_freed_memory

if TYPE_CHECKING:
    from jsonargparse import ArgumentParser

GROUP = "femoreg_torch.commands"
_LONGEST = 2000  # characters of a complaint
_REQUIRED = "the following arguments are required"  # as argparse says it
_LIST_IN_A_SHELL = """'[A, B]'; an item with commas or brackets needs quotes of its own, '["A=[1, 2]", B]'"""
# Objects made before Python looks for rings of forgotten ones: imports make hundreds of thousands that stay. With
# Python's own 700 the search takes a seventh of the time of `import torch`.
_COLLECTED_AFTER = 50_000, 20, 20
_RANGES = {  # of options that have one meaning in all commands
    "seed": (0, 2**31 - 1),
    "spacing_mm": (0.3, 5),
    "jobs": (1, 1024),
    "count": (1, 100_000),
    "procedures": (1, 1_000_000),
    "devices": (1, 1024),
    "nodes": (1, 1024),
    "volume_ml": (0.1, 100),  # of cement
    "distance_mm": (0.01, 100),
}


def main(argv: Sequence[str] | None = None) -> int:
    """Run `femoreg` with these arguments (those of the process if None) and return its exit status.

    0: done; 1: a run of a study failed, or `check` found something wrong; 2: bad input, told in one line on stderr, a
    case of a batch that was refused or failed, or what `doctor` found amiss; 3: done, but not trusted; 130:
    interrupted. Whatever else goes wrong is a defect: it is told in one line too, with status 2, and keeps its
    traceback where the environment has FEMOREG_TRACEBACK.
    """
    arguments = list(sys.argv[1:] if argv is None else argv)
    commands = _commands(entry_points(group=GROUP))
    try:
        try:
            return _carry_out(arguments, commands)
        finally:
            if sys.stdout is not None:
                sys.stdout.flush()  # what cannot be printed, on a full disk, is told now
    except InputError as error:
        return _complain(str(error))
    except ModuleNotFoundError as error:
        advice = missing_extra(error)
        return _tell_defect(error) if advice is None else _complain(advice)
    except BrokenPipeError:  # whoever read the output has gone, as `head` does
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # or Python complains when it ends
        return BAD_INPUT
    except SystemExit as error:  # rich's end where the reader has gone is 1, that of `--help` is 0
        if error.code != 1:
            raise
        return BAD_INPUT
    except OSError as error:
        return _complain(f"{_place(error)}: {error.strerror or error}.")
    except MemoryError:
        return _complain("the memory does not suffice. Close other programs, or crop the volumes.")
    except KeyboardInterrupt as stop:
        _complain(str(stop) or "interrupted.")
        return INTERRUPTED
    except Exception as error:
        return _tell_defect(error)


def _commands(found: Iterable[EntryPoint]) -> dict[str, EntryPoint]:
    """By name, in their order; of several of one name this project's own, which no other package replaces."""
    commands: dict[str, EntryPoint] = {}
    for command in found:
        is_own = command.dist is not None and command.dist.name == "femoreg-torch"
        if command.name not in commands or is_own:
            commands[command.name] = command
    return commands


def _place(error: OSError) -> str:
    """The file that an error of the system is about: of two, as of a copy, the one written if there is no room."""
    from femoreg_torch.files import NO_ROOM

    written = error.filename2 if error.errno in NO_ROOM else None
    place = error.filename if written is None else written
    return "a file could not be read or written" if place is None else str(place)


def _carry_out(arguments: list[str], commands: dict[str, EntryPoint]) -> int:
    if not arguments or arguments[0] in ("-h", "--help"):
        print(_overview(commands))
    elif arguments[0] == "--version":
        print(f"femoreg {femoreg_torch.__version__}")
    elif arguments[0] in commands:
        return _run(commands[arguments[0]], arguments[1:])
    else:
        meant = "".join(f" Did you mean {name}?" for name in get_close_matches(arguments[0], commands, 1, 0.7))
        raise InputError(f"no command {shortened(arguments[0])}.{meant} There are: {', '.join(commands)}.")
    return DONE


def console_script() -> NoReturn:
    """The installed command `femoreg`: `main`, and an end without Python's own clearing up.

    Taking modules and memory apart one by one takes more than a second after a registration, and the system does it at
    once. Before that, threads have ended, and all that was registered for the end has run.
    """
    prepare_process()
    keep_freed_memory()
    gc.set_threshold(*_COLLECTED_AFTER)
    ended: list[int] = []
    atexit.register(_end, ended)  # what is registered first runs last
    ended.append(main())
    sys.exit(ended[0])


def prepare_process() -> None:
    """Streams that take all that is printed, and no warnings of libraries, unless Python was asked for them."""
    for name, mode in (("stdin", "r"), ("stdout", "w"), ("stderr", "w")):
        if getattr(sys, name) is None:  # closed by whoever started this; its number must not become that of a file
            setattr(sys, name, Path(os.devnull).open(mode, encoding="utf-8"))  # noqa: SIM115
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            with suppress(OSError):  # a stream that has become another one
                stream.reconfigure(errors="backslashreplace")  # few letters, in an old locale: no × and ü
    if not sys.warnoptions:
        warnings.simplefilter("ignore")
        os.environ["PYTHONWARNINGS"] = "ignore"  # for processes that this one starts


def _end(ended: Sequence[int]) -> None:
    for stream in (sys.stdout, sys.stderr):
        with suppress(OSError):  # of which `main` has told, if it could
            stream.flush()
    if ended:
        os._exit(ended[0])


def _tell_defect(error: Exception) -> int:
    if "FEMOREG_TRACEBACK" in os.environ:
        raise error
    return _complain(
        f"defect: {defect_in_one_line(error)}. Please report it, with what FEMOREG_TRACEBACK=1 makes it print."
    )


def _complain(message: str) -> int:
    """Print one line on stderr, without what could steer a terminal."""
    from femoreg_torch.files import named_as_asked

    line = "".join(
        c if c.isprintable() else "\N{REPLACEMENT CHARACTER}" for c in " ".join(named_as_asked(message).split())
    )
    if len(line) > _LONGEST:
        line = f"{line[: _LONGEST // 2]} … {line[-_LONGEST // 2 :]}"
    with suppress(OSError):  # stderr may be full, or gone
        print(f"femoreg: {line}".encode(errors="backslashreplace").decode(), file=sys.stderr)
    return BAD_INPUT


def _overview(commands: dict[str, EntryPoint]) -> str:
    width = max((len(name) for name in commands), default=0)
    lines = [f"  {name:{width}}  {_summary(command)}" for name, command in commands.items()]
    return "\n".join(
        [
            "usage: femoreg COMMAND …",
            "",
            femoreg_torch.__doc__ or "",
            "",
            "commands:",
            *lines,
            "",
            "`femoreg COMMAND --help` explains one; `femoreg --version` prints the version.",
        ]
    )


def _summary(command: EntryPoint) -> str:
    """First line of the command's docstring, from its source, since importing all commands would take seconds."""
    package, *rest = command.module.split(".")
    spec = find_spec(package)
    for name in rest:
        found = spec.submodule_search_locations if spec else None
        spec = PathFinder.find_spec(name, found) if found else None
    if spec is None or spec.origin is None:
        return "(not installed here)"
    for node in ast.parse(Path(spec.origin).read_text(encoding="utf-8")).body:
        if isinstance(node, ast.FunctionDef) and node.name == command.attr:
            return (ast.get_docstring(node) or "").partition("\n")[0]
    return "(not installed here)"


def _run(command: EntryPoint, arguments: list[str]) -> int:
    try:
        function = command.load()
    except (ImportError, AttributeError) as error:
        raise InputError(
            f"the command {command.name}, {command.value}, cannot be imported ({error}). Mend or remove the package "
            "that names it."
        ) from error
    status = function(**_parse(function, command.name, arguments))
    return DONE if status is None else int(status)


def parser_of(function: Callable[..., Any], name: str) -> "ArgumentParser":
    """The parser of a command's arguments, made from its signature and docstring."""
    from docstring_parser import parse as parse_docstring

    from femoreg_torch.settings import plain_parser

    text = parse_docstring(function.__doc__ or "")
    help_of = {parameter.arg_name: parameter.description for parameter in text.params}
    parser = plain_parser(prog=f"femoreg {name}", description=text.description)
    hints = get_type_hints(function)
    if "config" not in hints:
        parser.add_argument("--config", action="config", help="YAML file with options; the command line overrides it")
    annotated = get_type_hints(function, include_extras=True)
    for parameter in inspect.signature(function).parameters.values():
        if parameter.name not in hints:
            raise InputError(f"the command {name}: its parameter `{parameter.name}` needs a type.")
        flags, settings = _argument(parameter, hints[parameter.name])
        flags += getattr(annotated[parameter.name], "__metadata__", ())  # short forms, as in Annotated[int, "-n"]
        parser.add_argument(*flags, **settings, help=help_of.get(parameter.name))
    return parser


def _parse(function: Callable[..., Any], name: str, arguments: list[str]) -> dict[str, Any]:
    """Keyword arguments for `function`. Raises `InputError` for what does not fit its signature."""
    from jsonargparse import ArgumentError

    from femoreg_torch.settings import LIST, told
    from femoreg_torch.text import check_no_aliases, read_yaml

    for word in arguments:
        option, _, value = word.partition("=") if word.startswith("--") else ("", "", word)
        check_no_aliases(value, f"{name}: {option}" if option else name)
    if any(word == "" or re.fullmatch(r"--[\w-]+=", word) for word in arguments):
        raise InputError(f"{name}: an argument is empty. Is a variable of the shell not set?")
    options = [word.partition("=")[0] for word in arguments if word.startswith("--") and word != "--"]
    if twice := next((word for word in options if options.count(word) > 1), None):
        raise InputError(f"{name}: {shortened(twice)} stands there twice. Keep one.")
    parser = parser_of(function, name)
    if "config" not in get_type_hints(function):
        for here, after in itertools.pairwise([*arguments, ""]):
            option, equals, value = here.partition("=")
            if option == "--config":
                read_yaml(Path(value if equals else after))  # which says what is wrong, and where
    try:
        values = parser.instantiate(parser.parse_args(arguments))
    except (ArgumentError, TypeError, ValueError, OSError) as error:  # OSError: a file of options that cannot be read
        known = inspect.signature(function).parameters
        key, colon, rest = told(error).rstrip(". ").partition(":")
        if key == _REQUIRED:
            raise InputError(f"{name}: {_missing(name, known.values(), rest)}. See `femoreg {name} --help`.") from error
        if key in known and (known[key].kind is known[key].KEYWORD_ONLY or known[key].default is not known[key].empty):
            key = f"--{key.replace('_', '-')}"
            if rest.strip().startswith(LIST):
                rest += f". Write {key} {_LIST_IN_A_SHELL}"
        raise InputError(f"{name}: {key}{colon}{rest}. See `femoreg {name} --help`.") from error
    for key, (low, high) in _RANGES.items():
        if isinstance(value := values.get(key), int | float) and not low <= value <= high:
            raise InputError(f"{name}: --{key.replace('_', '-')}: {low} to {high} was expected, found {value}.")
    return {key: values[key] for key in get_type_hints(function) if key != "return"}


def _missing(name: str, parameters: Iterable[inspect.Parameter], named: str) -> str:
    """What was expected, and which of it is given and which is missing: the parameters `named`, with commas."""
    written, expected = {}, f"femoreg {name}"
    for parameter in parameters:
        if parameter.default is parameter.empty:
            value, option = parameter.name.upper(), parameter.kind is parameter.KEYWORD_ONLY
            written[parameter.name] = f"--{parameter.name.replace('_', '-')}" if option else value
            expected += f" {written[parameter.name]} {value}" if option else f" {value}"
    missing = named.replace(" ", "").split(",")
    words = [f"{word} is {'missing' if key in missing else 'given'}" for key, word in written.items()]
    return f"`{expected}` was expected; {', '.join(words)}"


def _argument(parameter: inspect.Parameter, hint: Any) -> tuple[list[str], dict[str, Any]]:
    """Names and settings of a parameter for jsonargparse's `add_argument`."""
    required = parameter.default is parameter.empty
    if required and parameter.kind is not parameter.KEYWORD_ONLY:
        if get_origin(hint) is list:
            return [parameter.name], {"type": get_args(hint)[0], "nargs": "+"}
        return [parameter.name], {"type": hint}
    settings: dict[str, Any] = {"dest": parameter.name}
    if required:
        settings |= {"type": hint, "required": True}
    elif get_origin(hint) is tuple:
        settings |= {"type": get_args(hint)[0], "nargs": "+", "default": list(parameter.default)}
    elif parameter.default is False:
        settings |= {"action": "store_true"}
    else:
        settings |= {"type": hint, "default": parameter.default}
    return [f"--{parameter.name.replace('_', '-')}"], settings


if __name__ == "__main__":
    console_script()
