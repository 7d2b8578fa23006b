"""Tables of text as spreadsheets of any language save them: commas, semicolons or tabs, decimal points or commas.

What can only mean one thing is read, the rest is told with its line: a number with a comma between values with commas
is two values, and nobody knows which.
"""

import csv
import re
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from femoreg_torch.errors import InputError, shortened
from femoreg_torch.text import MOST_JSON_BYTES, decoded, read_bytes

_SEPARATORS = ",;\t"
_BREAK = re.compile("\r\n|\r|\n")
_NOT_LATIN_1 = re.compile(rb"[\x00-\x08\x0b\x0c\x0e-\x1f\x7f-\x9f]")  # bytes that differ among 8-bit sets, or no text
_NO_TEXT = re.compile(r"[\x00-\x08\x0b\x0c\x0e-\x1f]")
_SEPARATOR_TOLD = re.compile(r'"?sep=(.)"?')  # a first line of Excel's
_DECIMAL_COMMA = re.compile(r"[-+]?(\d+,\d*|,\d+)([eE][-+]?\d+)?")
_DECIMAL_POINT = re.compile(r"[-+]?(\d+\.\d*|\.\d+)([eE][-+]?\d+)?")


@dataclass(frozen=True)
class Row:
    """A row of a table: its line in the file, and its values by column, without spaces around them."""

    line: int
    values: dict[str, str]


def read_lines(path: Path) -> list[str]:
    """The lines of a table: UTF-8, or Latin-1 where no letter can be mistaken. Raises `InputError`."""
    content = read_bytes(path, MOST_JSON_BYTES)
    try:
        text = decoded(content, str(path), "CSV")
    except InputError:
        if _NOT_LATIN_1.search(content):
            raise
        text = content.decode("latin-1")
    if (found := _NO_TEXT.search(text)) is not None:
        line = len(_BREAK.findall(text[: found.start()])) + 1
        raise InputError(f"{path}, line {line}: cannot be read as CSV: the letter U+{ord(found[0]):04X} is no text.")
    return _BREAK.split(text)


def read_csv(path: Path, columns: Collection[str]) -> list[Row]:
    """The rows of a table by its header, which must hold these columns; capitals or small letters do not matter.

    Between the values stand commas, semicolons or tabs. Blank lines are passed over. Raises `InputError` that names
    file and line.
    """
    lines = read_lines(path)
    at = next((number for number, line in enumerate(lines) if line.strip(f" {_SEPARATORS}")), 0)
    separators = _SEPARATORS
    if told := _SEPARATOR_TOLD.fullmatch(lines[at].strip()):
        separators, lines[at] = told[1], ""
        at = next((number for number, line in enumerate(lines) if line.strip()), at)
    known = {name.casefold(): name for name in columns}
    headers = {
        separator: [known.get(name.casefold(), name) for name in _cells(lines[at], separator)]
        for separator in separators
    }
    fitting = [separator for separator, header in headers.items() if set(columns) <= set(header)]
    if not fitting:
        raise InputError(
            f"{path}, line {at + 1}: a header with {', '.join(columns)}, and rows below it, were expected, found "
            f"{shortened(lines[at])}."
        )
    separator = max(fitting, key=lambda one: len(headers[one]))
    header = headers[separator]
    if twice := sorted({name for name in header if name and header.count(name) > 1}):
        raise InputError(f"{path}, line {at + 1}: column {shortened(twice[0])} stands there twice. Keep one.")
    rows = list(rows_of(["" for _ in lines[: at + 1]] + lines[at + 1 :], header, columns, separator, str(path)))
    if not rows:
        raise InputError(f"{path}: a header with {', '.join(header)}, and rows below it, were expected, found no row.")
    return rows


def rows_of(
    lines: Sequence[str], header: Sequence[str], needed: Collection[str], separator: str, where: str
) -> Iterator[Row]:
    """The rows in lines of a table by these columns; lines without a value are passed over.

    Raises `InputError` that starts with `where` and the line for a row that is no CSV, has more values than there are
    columns, or does not reach a needed one.
    """
    least = max((header.index(name) + 1 for name in needed), default=0)
    reader = csv.reader(lines, delimiter=separator, strict=True, skipinitialspace=True)
    line = 1
    try:
        for cells in reader:
            values = [cell.strip() for cell in cells]
            if separator != ",":  # behind a decimal comma, an empty cell too many would be a value that has moved
                values = values[: len(header)] if not any(values[len(header) :]) else values
            if any(value.strip(_SEPARATORS) for value in values):
                if not least <= len(values) <= len(header):
                    raise InputError(
                        f"{where}, line {line}: {len(values)} values were found, but there are {len(header)} columns "
                        f"({shortened(', '.join(header), 80)}). {_mended(values, len(header), separator)}"
                    )
                values += [""] * (len(header) - len(values))
                yield Row(line, dict(zip(header, values, strict=True)))
            line = reader.line_num + 1
    except csv.Error as error:
        raise InputError(f"{where}, line {line}: cannot be read as CSV ({error}).") from error


def separator_of(lines: Sequence[str], least: int) -> str:
    """What stands between the values of a table without a header: what parts every line into as many as are needed."""
    filled = [line for line in lines if line.strip(f" {_SEPARATORS}")]
    return next((one for one in ";\t" if filled and all(len(_cells(line, one)) >= least for line in filled)), ",")


def decimal(text: str) -> float:
    """A number with a decimal point or comma. Raises `ValueError` for another text."""
    text = text.strip()
    return float(text.replace(",", ".")) if _DECIMAL_COMMA.fullmatch(text) else float(text)


def check_decimal_marks(rows: Sequence[Row], columns: Collection[str], where: str) -> None:
    """Raises `InputError` where numbers in these columns have decimal points in some rows, and commas in others.

    One of the two then parts the thousands, and nobody knows which.
    """
    marks = {",": _DECIMAL_COMMA, ".": _DECIMAL_POINT}
    first = {}
    for row in rows:
        for mark, pattern in marks.items():
            if mark not in first and any(pattern.fullmatch(row.values.get(name, "")) for name in columns):
                first[mark] = row.line
    if len(first) == len(marks):
        raise InputError(
            f"{where}: line {first[',']} has a decimal comma, and line {first['.']} a decimal point. Write one kind."
        )


def _cells(line: str, separator: str) -> list[str]:
    """The values of one line, without spaces around them; none of what is no CSV."""
    try:
        cells = next(csv.reader([line], delimiter=separator, strict=True, skipinitialspace=True), [])
    except csv.Error:
        return []
    return [cell.strip() for cell in cells]


def _mended(values: Sequence[str], count: int, separator: str) -> str:
    if len(values) < count:
        return "Complete it, or take it away."
    if separator == ",":
        return "Is there a comma in a number or a text? Save the table with semicolons between the values."
    return "Put a text that holds what parts the values in quotation marks."
