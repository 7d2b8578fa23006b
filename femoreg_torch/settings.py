"""Settings from YAML into frozen dataclasses, every key and type checked."""

import dataclasses
import functools
import json
import re
from argparse import Action
from collections.abc import Iterator, Mapping, Sequence
from types import NoneType, UnionType
from typing import Any, TypeVar, Union, get_args, get_origin, get_type_hints

from jsonargparse import ArgumentError, ArgumentParser, DefaultHelpFormatter, set_dumper, set_loader

from femoreg_torch.errors import InputError, shortened
from femoreg_torch.text import check_no_aliases, yaml_content

_T = TypeVar("_T")
SEEDS = (0, 2**31 - 1)  # that every generator of random numbers takes
_MODE = "plain"  # of jsonargparse's parsers: text in values and files is read by our one door for YAML
_LONGEST = 300  # characters of what jsonargparse says of a value, which it quotes as a whole


def plain_parser(**settings: Any) -> ArgumentParser:
    """A parser of jsonargparse that raises `ArgumentError`, and reads YAML as `femoreg_torch.text` does."""
    set_loader(_MODE, _argument, exceptions=(InputError,))
    set_dumper(_MODE, json.dumps)
    return ArgumentParser(exit_on_error=False, parser_mode=_MODE, formatter_class=_Help, **settings)


class _Help(DefaultHelpFormatter):
    """Tells the kind of a value in words, and no default where there is none."""

    def _get_help_string(self, action: Action) -> str:
        kind = self._get_type_str(action)
        if kind is None:  # a flag, or one of the parser's own
            return "" if action.help is None else super()._get_help_string(action).removesuffix(_DEFAULT_OF_A_FLAG)
        notes = ["required"] if action.required else []
        if words := _kind_in_words(kind):
            notes.append(words)
        if not action.required and action.default is not None:
            notes.append("default: %(default)s")
        return f"{action.help or ''} ({'; '.join(notes)})" if notes else action.help or ""


def _kind_in_words(kind: str) -> str:
    """How help tells the type of a value, which jsonargparse writes as Python does; a choice lists its words itself."""
    kind = re.sub(r"Optional\[(.*)\]", r"\1", _CLASS.sub(r"\1", kind).removesuffix(" | null"))
    if listed := re.fullmatch(r"(?:list|tuple)\[(\w+)(?:, \.\.\.)?\]", kind):
        return f"{LIST} of {_WORDS_OF_MANY[listed[1]]}"
    union = re.fullmatch(r"Union\[(.*)\]", kind)
    if union is None and kind.startswith("Literal"):
        return ""
    return _either([each for each in (union[1] if union else kind).split(", ") if each != "null"])


def _either(kinds: Sequence[str]) -> str:
    """Types or choices in words, `or` before the last."""
    words = [_WORDS.get(kind, _CHOICE.sub(r"\1", kind)) for kind in kinds]
    return " or ".join([", ".join(words[:-1]), words[-1]] if words[1:] else words)


def _argument(text: str) -> Any:
    content = yaml_content(text, "value")
    _check_texts(content, "value")
    return content


_CLASS = re.compile(r"<class '(?:\w+\.)*(\w+)'>")
_UNION = re.compile(
    r"Does not validate against any of the Union subtypes Subtypes: \[(.*?)\] Errors: .*?(?= Given value|$)"
)


_REFUSED = re.compile(
    r"(?:Expected an? (.*?)\.|(.*?) was expected\.)(?: Given value type: \S+)? (?:Given|Got) value: ?(.*)"
)
_KEY = re.compile(r'Parser key "([^"]*)": (.*)')
_WORDS = {"int": "a whole number", "float": "a number", "bool": "true or false", "str": "text", "Path": "a path"}
_WORDS_OF_MANY = {"int": "whole numbers", "float": "numbers", "str": "texts", "Path": "paths"}
_CHOICE = re.compile(r"(?:typing\.)?Literal\[(.*)\]")
_DEFAULT_OF_A_FLAG = " (default: %(default)s)"  # as jsonargparse writes it
LIST = "a list"  # how `told` begins where one was expected


def told(error: Exception) -> str:
    """What jsonargparse says of a value, on one line, the middle of what is long left out: key, expected, found."""
    text = _CLASS.sub(r"\1", " ".join(str(error).split()))
    text = _UNION.sub(lambda found: f"{found[1].replace(', NoneType', '')} was expected.", text)
    if key := _KEY.fullmatch(text):
        text = f"{key[1]}: {_REFUSED.sub(_in_words, key[2])}"
    return text if len(text) <= _LONGEST else f"{text[: _LONGEST // 2]} … {text[-_LONGEST // 2 :]}"


def _in_words(found: re.Match[str]) -> str:
    kinds = found[1] or found[2]
    if choice := _CHOICE.fullmatch(kinds):
        kinds = f"one of {choice[1]}"
    elif listed := re.fullmatch(r"list(?:\[(?:\w+\.)*(\w+)\])?", kinds):
        kinds = f"{LIST}{f' of {_WORDS_OF_MANY[listed[1]]}' if listed[1] in _WORDS_OF_MANY else ''}"
    else:
        kinds = _either(kinds.split(", "))
    return f"{kinds} was expected, found {shortened(found[3])}"


def read_record(kind: type[_T], content: dict[str, Any], where: str, ready: Mapping[str, Any] | None = None) -> _T:
    """An object of the dataclass `kind` from a mapping; records, lists and unions inside follow their annotations.

    Keys with a default may be left out. `ready` holds fields that were read already. Raises `InputError` that starts
    with `where` for what is not a mapping, a key that is unknown or missing, and a value of another type or one that
    the record itself refuses.
    """
    _check_form(kind, content, where)
    _check_texts(content, where)
    ready = ready or {}
    parser = _parser(kind, frozenset(ready))  # type: ignore[arg-type]  # a class can be hashed
    try:
        return kind(**vars(parser.instantiate(parser.parse_object(content))), **ready)
    except (ArgumentError, TypeError, ValueError, OverflowError) as error:
        raise InputError(f"{where}: {told(error)}") from error


def _check_form(hint: Any, value: Any, where: str) -> None:
    """Raises `InputError` unless mappings with known keys stand where records are expected, and null where it may.

    jsonargparse would take a text in the place of a record for the name of a class, and import its module: code from
    data. It also takes null for any field.
    """
    kinds = get_args(hint) if get_origin(hint) in (Union, UnionType) else (hint,)
    if value is None:
        if NoneType not in kinds and Any not in kinds:
            raise InputError(f"{where}: a value was expected, found null. Leave the key out for its default.")
        return
    kinds = tuple(kind for kind in kinds if kind is not NoneType)
    records = [kind for kind in kinds if dataclasses.is_dataclass(kind)]
    if records and (isinstance(value, dict) or len(records) == len(kinds)):
        _check_keys(records[0], value, where)
    for kind in kinds:
        items = get_args(kind)
        if get_origin(kind) in (list, tuple) and isinstance(value, list) and items:
            for number, item in enumerate(value):
                of = items[0] if len(items) == 1 or items[1] is Ellipsis else items[min(number, len(items) - 1)]
                if len(kinds) == 1:
                    _check_form(of, item, f"{where}[{number}]")
        elif get_origin(kind) is dict and isinstance(value, dict) and items:
            for key, item in value.items():
                _check_form(items[1], item, f"{where}, {shortened(key)}")


def _check_texts(value: Any, where: str) -> None:
    """`check_no_aliases` for all texts in lists and mappings within one another."""
    if isinstance(value, str):
        check_no_aliases(value, where)
    elif isinstance(value, list | tuple):
        for number, item in enumerate(value):
            _check_texts(item, f"{where}[{number}]")
    elif isinstance(value, dict):
        for key, item in value.items():
            _check_texts(item, f"{where}, {shortened(key)}")


def _check_keys(record: Any, value: Any, where: str) -> None:
    if not isinstance(value, dict):
        raise InputError(f"{where}: a mapping of keys and values was expected, found {shortened(value)}.")
    hints = get_type_hints(record)
    for key, item in value.items():
        if key not in record.__dataclass_fields__:
            known = ", ".join(record.__dataclass_fields__)
            raise InputError(f"{where}: unknown key {shortened(key)}. Known keys: {known}.")
        _check_form(hints[key], item, f"{where}, {key}")


def check_within(record: Any, **ranges: tuple[float, float]) -> None:
    """Raises `InputError` for a field of `record` that lies out of its range (ends included), or is not finite.

    A field may be a number, None, or a list of numbers or of such lists.
    """
    for key, (low, high) in ranges.items():
        for value in _numbers(getattr(record, key)):
            if not low <= value <= high:
                raise InputError(f"{key}: {low:g} to {high:g} was expected, found {value:g}.")


def check_rising(record: Any, *keys: str) -> None:
    """Raises `InputError` for a pair of numbers, low and high, whose first is the greater. Other values pass."""
    for key in keys:
        value = getattr(record, key)
        if isinstance(value, list | tuple) and len(value) == 2 and value[0] > value[1]:
            raise InputError(f"{key}: low and high were expected in this order, found {value[0]:g} and {value[1]:g}.")


def _numbers(value: Any) -> Iterator[float]:
    if isinstance(value, list | tuple):
        for item in value:
            yield from _numbers(item)
    elif value is not None:
        yield value


@functools.cache
def _parser(kind: type[Any], without: frozenset[str]) -> ArgumentParser:
    """The parser of a record's fields but for some; made once, as a preset holds many records of one kind."""
    parser = plain_parser()
    parser.add_class_arguments(kind, skip=set(without))
    return parser
