"""Broken files made of valid ones: bytes changed, values of text replaced, and what is nasty by itself."""

import copy
import io
import json
import random
from collections.abc import Callable
from typing import Any

import h5py
import numpy as np
import yaml

_PLACE = "PLACE-OF-A-NASTY-VALUE"
_ALIASES = "[" + ", ".join(f"&a{n} [{', '.join([f'*a{n - 1}' if n else 'x'] * 9)}]" for n in range(12)) + "]"
NASTY = (  # values, as they stand in YAML; those of JSON follow
    "null",
    "true",
    "''",
    "0",
    "-1",
    "1.0e-9",
    "1.0e+300",
    "-.inf",
    ".inf",
    ".nan",
    "9" * 5000,
    "1e999999",
    "2020-13-45",
    "!!bool abc",
    "!!python/object/apply:os.system [ls]",
    "!!binary aGk=",
    "&x [*x]",
    "*nothing",
    _ALIASES,
    "[" * 5000,
    "{" * 3000,
    "[]",
    "{}",
    "[[]]",
    "{a: 1, a: 2}",
    "[1, two, null]",
    "{1: 2, null: 3}",
    '"\\0"',
    '"a\\0b"',
    "../../..",
    "/etc/passwd",
    "/dev/zero",
    "/proc/self/mem",
    ".",
    "x" * 100_000,
    '"\\e[31mred\\n\\n"',
    '"\\ud800"',
    "12:30:45",
    "0o17",
    "0x1F",
    "1_000",
    "yes",
    "'",
    '"',
    "- - - -",
    "?",
    "<<: *x",
    "a: b: c",
    "[1, 2",
    "\t",
    "%YAML 9.9",
    "---",
    "...",
)
NASTY_JSON = (
    "null",
    "true",
    '""',
    "0",
    "-1",
    "1e-9",
    "1e300",
    "1e999",
    "NaN",
    "-Infinity",
    "9" * 5000,
    "[" * 100_000,
    "[]",
    "{}",
    "[[]]",
    '{"a": 1, "a": 2}',
    '[1, "two", null]',
    '"\\u0000"',
    '"\\ud800"',
    '"../../.."',
    '"/etc/passwd"',
    '"/dev/zero"',
    '"' + "x" * 100_000 + '"',
    "0x1F",
    "'x'",
    "[1,]",
    '"',
    "{",
    "//",
    "[" * 60 + "]" * 60,
    '"\\u001b[31mred\\n"',
    "-0",
    "1" * 17,
)


def mutated_bytes(content: bytes, other: bytes, draw: random.Random) -> bytes:
    """One to three random changes of a file's bytes; `other` is another valid file, of whatever kind."""
    for _ in range(draw.choice((1, 1, 2, 3))):
        content = draw.choice(_CHANGES)(content, other, draw)
    return content


def mutated_text(content: Any, as_json: bool, other: bytes, draw: random.Random) -> bytes:
    """A file of YAML or JSON with values replaced, keys taken away, renamed or doubled; at times other bytes."""
    content = copy.deepcopy(content)
    nasty = draw.choice(NASTY_JSON if as_json else NASTY)
    for _ in range(draw.choice((1, 1, 1, 2, 4))):
        content = _changed(content, draw)
    text = json.dumps(content) if as_json else yaml.safe_dump(content, sort_keys=False, width=1000)
    text = text.replace(f'"{_PLACE}"', nasty) if as_json else text.replace(_PLACE, nasty)
    made = text.encode("utf-8", "surrogatepass")
    return mutated_bytes(made, other, draw) if draw.random() < 0.15 else made


def mutated_hdf5(content: bytes, draw: random.Random) -> bytes:
    """An HDF5 file with one entry taken away, or another thing in its place; bytes changed at random miss most."""
    made = io.BytesIO(content)
    with h5py.File(made, "a") as file:
        names: list[str] = []
        file.visit(names.append)
        name = draw.choice(names)
        del file[name]
        draw.choice(_HDF5)(file, name)
    return made.getvalue()


_HDF5: tuple[Callable[[Any, str], Any], ...] = (
    lambda file, name: None,
    lambda file, name: file.create_group(name),
    lambda file, name: file.create_dataset(name, data="a word", dtype=h5py.string_dtype()),
    lambda file, name: file.create_dataset(name, data=b"\xff\xfe"),
    lambda file, name: file.create_dataset(name, (3,), dtype=h5py.vlen_dtype(np.float32)),
    lambda file, name: file.create_dataset(name, data=h5py.Empty("f")),
    lambda file, name: file.create_dataset(name, (2**40,), "f4", chunks=True),
    lambda file, name: file.create_dataset(name, (2**13, 2**13, 2**13), "f4", chunks=True),
    lambda file, name: file.create_dataset(name, (4,), "f4", external=[("/etc/hostname", 0, 16)]),
    lambda file, name: file.create_dataset(name, (1,), dtype=h5py.ref_dtype),
    lambda file, name: file.create_dataset(name, data=np.zeros(2, [("a", "i4"), ("b", "f4")])),
    *(
        lambda file, name, value=value: file.create_dataset(name, data=value)
        for value in (0, -1, 0.5, 2**62, 1e30, np.nan, np.zeros(0), np.zeros((4, 4)), np.ones((3, 3, 3)), 1j)
    ),
    lambda file, name: file.__setitem__(name, h5py.SoftLink(f"/{name}")),
    lambda file, name: file.__setitem__(name, h5py.ExternalLink("nowhere.h5", "/x")),
)


def _changed(content: Any, draw: random.Random) -> Any:
    """The content with one value, drawn among all, changed."""
    places = list(_places(content))
    if not places:
        return _PLACE
    inside, key = draw.choice(places)
    change = draw.randrange(6)
    if change == 0:
        del inside[key]
    elif change == 1 and isinstance(inside, dict):
        inside[f"{key}x"] = inside.pop(key)
    elif change == 2 and isinstance(inside, list):
        inside.insert(key, copy.deepcopy(inside[key]))
    elif change == 3:
        source, name = draw.choice(places)
        inside[key] = copy.deepcopy(source[name]) if name in _keys(source) else None
    elif change == 4 and isinstance(inside[key], int | float) and not isinstance(inside[key], bool):
        inside[key] = draw.choice((-1, 0, 1e-9, 1000, 1e9, 0.5, 1e18)) * inside[key]
    else:
        inside[key] = _PLACE
    return content


def _keys(content: Any) -> list[Any]:
    return list(content) if isinstance(content, dict) else list(range(len(content)))


def _places(content: Any) -> Any:
    """Every mapping or list within, with each of its keys."""
    if isinstance(content, dict | list):
        for key in _keys(content):
            yield content, key
            yield from _places(content[key])


def _flip(content: bytes, _: bytes, draw: random.Random) -> bytes:
    changed = bytearray(content)
    for _n in range(min(len(changed), draw.choice((1, 2, 8, 64)))):
        changed[draw.randrange(len(changed))] = draw.randrange(256)
    return bytes(changed)


def _flip_in_header(content: bytes, _: bytes, draw: random.Random) -> bytes:
    changed = bytearray(content)
    for _n in range(draw.choice((1, 2, 8))):
        if changed:
            changed[draw.randrange(min(len(changed), 400))] = draw.choice((0, 1, 127, 128, 255, draw.randrange(256)))
    return bytes(changed)


def _cut(content: bytes, _: bytes, draw: random.Random) -> bytes:
    return content[: draw.randrange(len(content) + 1)]


def _cut_a_little(content: bytes, _: bytes, draw: random.Random) -> bytes:
    return content[: max(0, len(content) - draw.randrange(1, 20))]


def _zeros(content: bytes, _: bytes, draw: random.Random) -> bytes:
    start, length = draw.randrange(len(content) + 1), draw.choice((1, 4, 16, 256))
    return content[:start] + bytes(length) + content[start + length :]


def _largest(content: bytes, _: bytes, draw: random.Random) -> bytes:
    start, length = draw.randrange(min(len(content), 400) + 1), draw.choice((1, 2, 4, 8))
    return content[:start] + b"\xff" * length + content[start + length :]


def _digits(content: bytes, _: bytes, draw: random.Random) -> bytes:
    """A digit of a text header becomes a number that is much larger, negative or none."""
    places = [n for n, byte in enumerate(content[:600]) if 48 <= byte <= 57]
    if not places:
        return content
    n = draw.choice(places)
    return (
        content[:n]
        + draw.choice((b"2147483648", b"-1", b"nan", b"0", b"1e30", b"x", b"99999999999999999999"))
        + content[n + 1 :]
    )


def _insert(content: bytes, _: bytes, draw: random.Random) -> bytes:
    start = draw.randrange(len(content) + 1)
    return content[:start] + draw.randbytes(draw.choice((1, 2, 7, 100))) + content[start:]


def _doubled(content: bytes, _: bytes, draw: random.Random) -> bytes:
    start = draw.randrange(len(content) + 1)
    return content[: start + 200] + content[start:]


def _swapped(_: bytes, other: bytes, _draw: random.Random) -> bytes:
    return other


def _mixed(content: bytes, other: bytes, draw: random.Random) -> bytes:
    return content[: draw.randrange(len(content) + 1)] + other[draw.randrange(len(other) + 1) :]


def _empty(_: bytes, _other: bytes, _draw: random.Random) -> bytes:
    return b""


def _noise(_: bytes, _other: bytes, draw: random.Random) -> bytes:
    return draw.randbytes(draw.choice((1, 10, 1000)))


_CHANGES: tuple[Callable[[bytes, bytes, random.Random], bytes], ...] = (
    _flip, _flip, _flip_in_header, _flip_in_header, _cut, _cut_a_little, _zeros, _largest, _digits, _digits, _insert,
    _doubled, _swapped, _mixed, _empty, _noise,
)  # fmt: skip
