"""What is wrong with a text that is no YAML, told so that it can be mended: the line, and what to write there.

libyaml tells where it lost its way and what it expected. What a person wrote wrongly is mostly in that line, in the one
where the open value begins, or in the one before.
"""

import re
from collections.abc import Iterator, Sequence

import yaml

_BREAK = re.compile("\r\n|[\n\r\x85\u2028\u2029]")  # as YAML 1.1, libyaml's, counts lines
_TAB = re.compile(r"[ -]*\t")
_NO_SPACE = re.compile(r"\s*(?:- +)?([A-Za-z_][\w-]+):([^\s:/\\].*)")  # more than one letter: `C:` is a drive
_NO_SPACE_AFTER_DASH = re.compile(r"\s*-([A-Za-z_][\w-]*:.*)")
_COLON_IN_VALUE = re.compile(r"""\s*(?:- +)?[\w-]+: +([^\s'"\[{&*].*:(?:\s.*)?)""")
_MARKED = re.compile(r"(?:^|[:,\[-]\s*)([@`%*&|>!][^\s,\]]*)")  # a value whose first letter means something to YAML
_QUOTE_IN_VALUE = re.compile(r"""(['"])[^'"]*\1[^\s,\]}:#]""")
_LONGEST = 60
_PATH_WITH_ESCAPES = re.compile(r"[A-Za-z]:[^\w]|.*\.\w{1,5}\Z", re.S)
_CONTROL = re.compile(r"[\x00-\x1f\x7f-\x9f]")
ESCAPES = "in double quotes \\ begins an escape. Write / in its place, or put the value in single quotes"


def fault(text: str, error: yaml.MarkedYAMLError) -> tuple[int, str]:
    """The number of the line that is at fault, and what is wrong with it in one sentence or two."""
    lines = _BREAK.split(text)
    problem = str(error.problem or error.context)
    at = 0 if error.problem_mark is None else min(error.problem_mark.line, len(lines) - 1)
    begun = at if error.context_mark is None else min(error.context_mark.line, len(lines) - 1)
    for number in _suspects(lines, at, begun):
        if (told := _in_line(lines[number])) is not None:
            return number + 1, told
    if "escape" in problem or "hexdecimal" in problem:
        return at + 1, f"{ESCAPES}."
    if (colon := _COLON_IN_VALUE.fullmatch(lines[at])) and "mapping values" in problem:
        return at + 1, f"a colon in the value `{_short(colon[1])}`. Put the value in quotes."
    if ("any token" in problem or "alphabetic" in problem) and (marked := _MARKED.search(lines[at])):
        return at + 1, f"`{_short(marked[1])}`: {marked[1][0]} means something to YAML. Put the value in quotes."
    if "expected key" in problem and _QUOTE_IN_VALUE.search(lines[at]):
        return at + 1, "a quotation mark stands within a value. Put the value in the other kind of quotation marks."
    if "quoted scalar" in str(error.context):
        return begun + 1, "a quotation mark is opened and not closed. Close it."
    if "flow" in str(error.context):
        return begun + 1, "a bracket is opened and not closed, or a comma is missing behind it. Write it."
    if at and ("mapping values" in problem or "expected key" in problem or "indicator" in problem):
        return (
            at + 1,
            "its indentation or quotation marks do not fit the lines above. Put keys below one another.",
        )
    return at + 1, f"{problem}. Look at this line and the one before."


def missing_space(text: str) -> tuple[int, str] | None:
    """The first line of a text whose colon lacks the space behind it, and how to mend it; None if there is none."""
    for number, line in enumerate(_BREAK.split(text), 1):
        if _NO_SPACE.fullmatch(line):
            return number, str(_in_line(line))
    return None


def fault_of_key(key: str) -> str | None:
    """What is wrong with a key that was written without quotes, if anything is."""
    if _NO_SPACE_AFTER_DASH.fullmatch(f"{key}:"):
        return f"key `{_short(key)}`: a space is missing after the dash"
    if key != key.strip():
        space = key[0] if key[0].isspace() else key[-1]
        return f"key {_short(key)!r}: U+{ord(space):04X} is no space to YAML. Write a usual space"
    return None


def is_escaped_path(value: str) -> bool:
    r"""Whether a value from double quotes seems to be a path of Windows, whose `\n` or `\t` became something else."""
    return _CONTROL.search(value) is not None and _PATH_WITH_ESCAPES.match(value) is not None


def _suspects(lines: Sequence[str], at: int, begun: int) -> Iterator[int]:
    yield at
    if begun != at:
        yield begun
    before = next((number for number in range(at - 1, -1, -1) if lines[number].strip()), None)
    if before is not None and before != begun:
        yield before


def _in_line(line: str) -> str | None:
    """What is wrong with a line by itself, if anything is."""
    if _TAB.match(line):
        return "a tab stands where YAML wants spaces. Indent with spaces."
    if colon := _NO_SPACE.fullmatch(line):
        return f"a space is missing after the colon. Write `{_short(f'{colon[1]}: {colon[2].rstrip()}')}`."
    if dash := _NO_SPACE_AFTER_DASH.fullmatch(line):
        return f"a space is missing after the dash. Write `{_short(f'- {dash[1].rstrip()}')}`."
    return None


def _short(text: str) -> str:
    return text if len(text) <= _LONGEST else text[: _LONGEST - 1] + "…"
