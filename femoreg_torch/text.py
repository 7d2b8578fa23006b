"""The one door for YAML and JSON: plain data only, of limited size and depth, every key once.

PyYAML's own constructors turn `2020-13-45` into an exception, `010` into 8, `12:30` into 750 and `no` into False, keep
the last of two equal keys, and let a few hundred bytes of aliases grow to billions of values. Here scalars follow the
core schema of YAML 1.2 (chapter 10.3), tags are refused, and aliases count as what they stand for.
"""

import json
import math
import re
from collections.abc import Iterable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NoReturn

import yaml

from femoreg_torch.errors import InputError, shortened
from femoreg_torch.paths import check_readable
from femoreg_torch.yaml_faults import ESCAPES, fault, fault_of_key, is_escaped_path, missing_space

MOST_YAML_BYTES = 2**20  # a case of a hundred views has a tenth of it
MOST_JSON_BYTES = 2**26  # a result with the whole course of its optimisation has some 2**21
_DEEPEST = 50  # lists and mappings within one another; presets have 8
_MOST_VALUES = 200_000  # of a YAML text, an alias counted as what it stands for
_MOST_DIGITS = 18  # of a whole number, which then fits into 64 bits

_NULL = re.compile(r"|~|null|Null|NULL")
_TRUE, _FALSE = re.compile(r"true|True|TRUE"), re.compile(r"false|False|FALSE")
_INTEGER = re.compile(r"[-+]?(0|[1-9][0-9]*)")
_FLOAT = re.compile(r"[-+]?(\.[0-9]+|(0|[1-9][0-9]*)(\.[0-9]*)?)([eE][-+]?[0-9]+)?")
_INFINITE = re.compile(r"[-+]?\.(inf|Inf|INF)")
_NAN = re.compile(r"\.(nan|NaN|NAN)")
_Loader = getattr(yaml, "CSafeLoader", yaml.SafeLoader)  # libyaml where PyYAML was built with it
_NO_KEY = object()


def read_bytes(path: Path, most: int) -> bytes:
    """The content of a file. Raises `InputError` as `check_readable` does, and if it holds more bytes."""
    check_readable(path)
    try:
        with path.open("rb") as file:
            content = file.read(most + 1)
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror or error}).") from error
    if len(content) > most:
        raise InputError(
            f"{path}: is larger than {most / 2**20:g} MB, which no file of this kind is. Is it another one?"
        )
    return content


def read_yaml(path: Path) -> dict[str, Any]:
    """The mapping in a YAML file. Raises `InputError` as `yaml_mapping` does, and if the file cannot be read."""
    return yaml_mapping(read_bytes(path, MOST_YAML_BYTES), str(path))


def read_yaml_and_lines(path: Path) -> tuple[dict[str, Any], dict[str, int]]:
    """As `read_yaml`, and the line of each key and list item, by names like `views[0].anatomy`."""
    return _mapping_and_lines(read_bytes(path, MOST_YAML_BYTES), str(path))


def yaml_mapping(text: str | bytes, where: str) -> dict[str, Any]:
    """The mapping that a YAML text holds. Raises `InputError` as `yaml_content` does, and if it holds another thing."""
    return _mapping_and_lines(text, where)[0]


def _mapping_and_lines(text: str | bytes, where: str) -> tuple[dict[str, Any], dict[str, int]]:
    built = _built(text, where)
    content = built.content
    if content is None:
        raise InputError(f"{where}: is empty, a mapping of keys and values was expected.")
    if isinstance(content, str) and (found := missing_space(decoded(text, where, "YAML"))) is not None:
        raise InputError(f"{where}, line {found[0]}: {found[1]}")
    if not isinstance(content, dict):
        raise InputError(f"{where}: a mapping of keys and values was expected, found {type(content).__name__}.")
    return content, built.lines


def yaml_content(text: str | bytes, where: str) -> Any:
    """What a YAML text holds: mappings with keys of text, lists, text, numbers, booleans and None.

    Raises `InputError` that starts with `where` for what is no YAML, is larger or deeper than any file of ours, has a
    tag, two equal keys, an endless alias, nan, or a whole number of more than 18 digits.
    """
    return _built(text, where).content


def _built(text: str | bytes, where: str) -> "_Builder":
    if len(text) > MOST_YAML_BYTES:
        raise InputError(f"{where}: is larger than {MOST_YAML_BYTES / 2**20:g} MB, which no file of this kind is.")
    builder, text = _Builder(where), decoded(text, where, "YAML")
    try:
        for event in yaml.parse(text, Loader=_Loader):
            builder.take(event)
    except yaml.MarkedYAMLError as error:
        line, told = fault(text, error)
        raise InputError(f"{where}, line {line}: cannot be read as YAML: {told}") from error
    except (yaml.YAMLError, UnicodeError) as error:  # PyYAML encodes what it is given: lone surrogates are an error too
        raise InputError(f"{where}: cannot be read as YAML ({' '.join(str(error).split())[:200]}).") from error
    return builder


def decoded(content: str | bytes, where: str, kind: str) -> str:
    """Text of a file of this kind, which is to be UTF-8, with or without a mark at its beginning.

    Raises `InputError` that starts with `where` and tells the line of the first byte that is none of UTF-8.
    """
    if isinstance(content, str):
        return content
    if content.startswith((b"\xff\xfe", b"\xfe\xff")):
        raise InputError(f"{where}: cannot be read as {kind}: it is UTF-16, or no text. Save it as UTF-8.")
    if b"\0" in content:
        raise InputError(f"{where}: cannot be read as {kind}: it holds bytes of 0, so is no text. Is it another file?")
    try:
        return content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line, byte = content[: error.start].count(b"\n") + 1, content[error.start]
        raise InputError(
            f"{where}, line {line}: cannot be read as {kind}: the byte 0x{byte:02X} is none of UTF-8. Save it as UTF-8."
        ) from error


def check_no_aliases(text: str, where: str) -> None:
    """Raises `InputError` for a text that is YAML of lists or mappings with aliases.

    jsonargparse reads a text in the place of a number as YAML, by PyYAML itself, and quotes what it holds: half a
    kilobyte of aliases of aliases would fill the memory.
    """
    if "&" not in text or "*" not in text:
        return
    with suppress(yaml.YAMLError):  # neither can jsonargparse read it then
        seen = {type(event) for event in yaml.parse(text, Loader=_Loader)}
        if yaml.AliasEvent in seen and seen & {yaml.SequenceStartEvent, yaml.MappingStartEvent}:
            raise InputError(f"{where}: {shortened(text)} holds aliases (*), a plain value was expected.")


@dataclass(eq=False)
class _Open:
    """A list or mapping whose end has not been read."""

    value: dict[str, Any] | list[Any]
    anchor: str | None = None
    path: str = ""  # the keys and numbers that lead to it
    size: int = 1  # values, those inside counted
    key: Any = _NO_KEY  # the key that waits for its value
    key_is_plain: bool = False  # without quotes


class _Builder:
    """Puts the values of a YAML text together, event by event."""

    def __init__(self, where: str) -> None:
        self.where = where
        self.content: Any = None
        self.lines: dict[str, int] = {}  # by path
        self._open: list[_Open] = []
        self._anchors: dict[str, tuple[Any, int]] = {}  # values and their sizes
        self._documents = 0
        self._line = 0

    def take(self, event: yaml.Event) -> None:
        self._line = event.start_mark.line + 1 if event.start_mark else 0
        if isinstance(event, yaml.DocumentStartEvent):
            self._documents += 1
            if self._documents > 1:
                self._refuse("holds a second document (`---`), one was expected")
        elif isinstance(event, yaml.AliasEvent):
            if event.anchor not in self._anchors:
                self._refuse(f"alias *{shortened(event.anchor)} stands for nothing, or for what it stands in")
            self._put(*self._anchors[event.anchor], None)
        elif isinstance(event, yaml.ScalarEvent | yaml.CollectionStartEvent):
            self._begin(event)
        elif isinstance(event, yaml.CollectionEndEvent):
            done = self._open.pop()
            self._put(done.value, done.size, done.anchor)

    def _begin(self, event: Any) -> None:
        if event.tag is not None:
            self._refuse(f"tag {shortened(event.tag)}: plain values without tags were expected")
        if isinstance(event, yaml.ScalarEvent):
            self._put(self._scalar(event), 1, event.anchor, plain=event.implicit[0])
            return
        if len(self._open) == _DEEPEST:
            self._refuse(f"lists and mappings stand more than {_DEEPEST} deep in one another")
        path = self._path() if self._open else ""
        self._open.append(_Open({} if isinstance(event, yaml.MappingStartEvent) else [], event.anchor, path))

    def _path(self) -> str:
        """The path of the value that comes next; that of a list item gets its line."""
        inside = self._open[-1]
        if isinstance(inside.value, dict):
            return f"{inside.path}.{inside.key}" if inside.path else str(inside.key)
        path = f"{inside.path}[{len(inside.value)}]"
        self.lines[path] = self._line
        return path

    def _put(self, value: Any, size: int, anchor: str | None, plain: bool = False) -> None:
        """A whole value into the list or mapping that it stands in."""
        if anchor is not None:
            self._anchors[anchor] = value, size
        if not self._open:
            self.content = value
            return
        inside = self._open[-1]
        inside.size += size
        if inside.size > _MOST_VALUES:
            self._refuse(f"holds more than {_MOST_VALUES} values, aliases counted as what they stand for")
        if isinstance(inside.value, list):
            inside.value.append(value)
        elif inside.key is _NO_KEY:
            inside.key, inside.key_is_plain = self._key(value, inside, plain), plain
        else:
            if value is None and inside.key_is_plain and (found := missing_space(inside.key)) is not None:
                self._refuse(found[1].rstrip("."))
            inside.value[inside.key] = value
            inside.key = _NO_KEY

    def _key(self, value: Any, inside: _Open, plain: bool) -> str:
        if not isinstance(value, str | int | float) or isinstance(value, bool):
            self._refuse(f"key {shortened(value)}: keys of text were expected")
        key = str(value)
        path = f"{inside.path}.{key}" if inside.path else key
        if key in inside.value:
            self._refuse(f"key {shortened(value)} stands there twice, first in line {self.lines[path]}. Keep one")
        if plain and (wrong := fault_of_key(key)) is not None:
            self._refuse(wrong)
        self.lines[path] = self._line
        return key

    def _scalar(self, event: yaml.ScalarEvent) -> Any:
        text = event.value
        if not event.implicit[0]:  # quoted
            if event.style == '"' and is_escaped_path(text):
                self._refuse(f"{shortened(text)}: {ESCAPES}")
            return text
        if _NULL.fullmatch(text):
            return None
        if _TRUE.fullmatch(text) or _FALSE.fullmatch(text):
            return _TRUE.fullmatch(text) is not None
        if _INTEGER.fullmatch(text):
            return self._checked(text, int)
        if _FLOAT.fullmatch(text):
            return self._checked(text, float)
        if _INFINITE.fullmatch(text):
            return -math.inf if text.startswith("-") else math.inf
        if _NAN.fullmatch(text):
            self._refuse(f"{text} is no number")
        return text

    def _checked(self, text: str, kind: type[int] | type[float]) -> int | float:
        try:
            return _whole(text) if kind is int else _finite(text)
        except ValueError as error:
            self._refuse(str(error))

    def _refuse(self, problem: str) -> NoReturn:
        raise InputError(f"{self.where}, line {self._line}: {problem}.")


def _whole(text: str) -> int:
    if len(text.lstrip("+-")) > _MOST_DIGITS:
        raise ValueError(f"a number of {len(text.lstrip('+-'))} digits, at most {_MOST_DIGITS} were expected")
    return int(text)


def _finite(text: str) -> float:
    value = float(text)
    if not math.isfinite(value):
        raise ValueError(f"the number {shortened(text)} is too large")
    return value


def json_content(text: str | bytes, where: str, with_nan: bool = False) -> Any:
    """What a JSON text holds; `with_nan` also lets NaN and Infinity pass, which JSON does not know.

    Raises `InputError` that starts with `where` for what is no JSON, is larger or deeper than any file of ours, has two
    equal keys in one object, or a whole number of more than 18 digits.
    """
    if len(text) > MOST_JSON_BYTES:
        raise InputError(f"{where}: is larger than {MOST_JSON_BYTES / 2**20:g} MB, which no file of this kind is.")
    if not text.strip():
        raise InputError(f"{where}: is empty, JSON was expected.")
    try:
        content = json.loads(
            decoded(text, where, "JSON"),
            object_pairs_hook=_each_key_once,
            parse_int=_whole,
            parse_float=float if with_nan else _finite,
            parse_constant=float if with_nan else _not_finite,
        )
    except InputError:
        raise
    except ValueError as error:  # JSONDecodeError among them
        raise InputError(f"{where}: cannot be read as JSON ({shortened(error, 160)}).") from error
    except RecursionError:
        raise InputError(f"{where}: lists and objects stand more than {_DEEPEST} deep in one another.") from None
    _check_depth(content, where)
    return content


def _each_key_once(pairs: Iterable[tuple[str, Any]]) -> dict[str, Any]:
    found: dict[str, Any] = {}
    for key, value in pairs:
        if key in found:
            raise ValueError(f"key {shortened(key)} stands there twice, keep one")
        found[key] = value
    return found


def _not_finite(word: str) -> float:
    raise ValueError(f"{word} is no number of JSON")


def _check_depth(content: Any, where: str) -> None:
    level = [content]
    for _ in range(_DEEPEST + 1):
        inside = (
            value.values() if isinstance(value, dict) else value for value in level if isinstance(value, dict | list)
        )
        level = [value for values in inside for value in values if isinstance(value, dict | list)]
        if not level:
            return
    raise InputError(f"{where}: lists and objects stand more than {_DEEPEST} deep in one another.")
