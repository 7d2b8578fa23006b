"""Files with a header of text, MetaImage and NRRD: what ITK's readers of them crash on, or pass over.

They crash on a file of values that is not there or has a very long name, and on lists that are shorter than the header
says. They pass over values that are cut off or damaged, where these are compressed, and read an origin of NaN as zero.
MetaImage: its documentation at itk.org, and `MET_ValueTypeSize` of MetaIO. NRRD: teem.sourceforge.net/nrrd/format.html.
"""

import math
import re
import zlib
from collections.abc import Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from femoreg_torch.arrays import check_claim, opened
from femoreg_torch.errors import InputError, shortened

META_SUFFIXES, NRRD_SUFFIXES = (".mha", ".mhd"), (".nrrd", ".nhdr")
_LONGEST_HEADER = 2**20  # bytes; a segmentation of 3D Slicer names all its segments there
_CHUNK = 2**20
_META_SIZE = re.compile(rb"^Element(Spacing|Size)[ \t]*=", re.MULTILINE)
_NRRD_SIZE = re.compile(rb"^(spacings|space directions):", re.MULTILINE | re.IGNORECASE)
_OTHER_UNITS = {  # of lengths; what else may stand there says nothing, as "" for an axis that is no length
    "m", "meter", "meters", "metre", "metres", "dm", "cm", "centimeter", "centimeters", "centimetre", "centimetres",
    "um", "µm", "μm", "micron", "microns", "micrometer", "micrometers", "nm", "in", "inch", "inches",
}  # fmt: skip
_NOWHERE = re.compile(r"nan|inf", re.IGNORECASE)
_PLACES = (  # fields of both formats that say where voxels lie
    "Offset", "Position", "Origin", "ElementSpacing", "TransformMatrix", "Rotation", "Orientation", "space origin",
    "space directions", "spacings",
)  # fmt: skip
# Lists in the header of a MetaImage, with as many values as the power of its dimensions that is given.
_META_LISTS = {
    "DimSize": 1, "ElementSpacing": 1, "ElementSize": 1, "Offset": 1, "Position": 1, "Origin": 1,
    "CenterOfRotation": 1, "TransformMatrix": 2, "Rotation": 2, "Orientation": 2,
}  # fmt: skip
_META_BYTES = {
    "MET_CHAR": 1, "MET_UCHAR": 1, "MET_SHORT": 2, "MET_USHORT": 2, "MET_INT": 4, "MET_UINT": 4, "MET_LONG": 4,
    "MET_ULONG": 4, "MET_LONG_LONG": 8, "MET_ULONG_LONG": 8, "MET_FLOAT": 4, "MET_DOUBLE": 8,
}  # fmt: skip
_NRRD_BYTES = {
    name: size
    for size, names in {
        1: "signed char, int8, int8_t, uchar, unsigned char, uint8, uint8_t",
        2: "short, short int, signed short, signed short int, int16, int16_t, ushort, unsigned short, "
        "unsigned short int, uint16, uint16_t",
        4: "int, signed int, int32, int32_t, uint, unsigned int, uint32, uint32_t, float",
        8: "longlong, long long, long long int, signed long long, signed long long int, int64, int64_t, ulonglong, "
        "unsigned long long, unsigned long long int, uint64, uint64_t, double",
    }.items()
    for name in names.split(", ")
}


@dataclass(frozen=True)
class _Values:
    """Where the values of a file stand."""

    path: Path
    start: int  # byte
    claimed: int | None  # bytes, uncompressed; None where ITK tells itself what is wrong with them
    compressed: bool


def check_text_header(path: Path) -> None:
    """Raises `InputError` for a MetaImage or NRRD file (by its name) that ITK would crash on, or read wrongly.

    Its values are all there, and those that are compressed are not damaged. Files of other names are passed.
    """
    values = _values(path)
    if values is not None:
        _check_values(values, path)


def check_voxel_size(path: Path) -> None:
    """Raises `InputError` for a MetaImage or NRRD file (by its name) that does not tell how large its voxels are.

    ITK takes 1 mm for that. Files of other names are passed.
    """
    name = path.name.lower()
    if not name.endswith((*META_SUFFIXES, *NRRD_SUFFIXES)):
        return
    with opened(path) as file:
        header = file.read(_LONGEST_HEADER)
    if name.endswith(META_SUFFIXES):
        told, line = _META_SIZE.search(header.partition(b"ElementDataFile")[0]), "ElementSpacing = x y z"
    else:
        told, line = _NRRD_SIZE.search(re.split(rb"\r?\n\r?\n", header, maxsplit=1)[0]), "spacings: x y z"
    if told is None:
        raise InputError(
            f"{path}: no size of voxels stands in its header. Export it anew, or add the line `{line}`, in mm."
        )


def file_of_values(path: Path) -> Path:
    """The file in which the values of a volume stand: another one than `path` where its header names one.

    Raises `InputError` as `check_text_header` for a header that says something else.
    """
    values = _values(path)
    return path if values is None else values.path


def _values(path: Path) -> _Values | None:
    """None for files of other names."""
    name = path.name.lower()
    if not name.endswith((*META_SUFFIXES, *NRRD_SUFFIXES)):
        return None
    with opened(path) as file:
        beginning = file.read(_LONGEST_HEADER)
    return _of_meta_image(beginning, path) if name.endswith(META_SUFFIXES) else _of_nrrd(beginning, path)


def _of_meta_image(beginning: bytes, path: Path) -> _Values:
    last = re.search(rb"^ElementDataFile[ \t]*=[^\n]*(\n|$)", beginning, re.MULTILINE)
    if last is None:
        raise InputError(f"{path}: no MetaImage, its header has no line `ElementDataFile = …`. Export it anew.")
    fields = _fields(_lines(beginning[: last.end()]), "=", path)
    dimensions = _number(fields, "NDims", path, least=2, most=4)
    for key, power in _META_LISTS.items():
        if key in fields and len(fields[key].split()) != dimensions**power:
            raise InputError(
                f"{path}: `{key}` in its header has {len(fields[key].split())} values for {dimensions} dimensions. "
                "Export it anew."
            )
    if not _is_true(fields.get("BinaryData", "True")):
        raise InputError(f"{path}: its values are text (`BinaryData` in its header). Save them as binary.")
    _check_units([fields.get("DistanceUnits", "")], path)
    shape = _sizes(fields, "DimSize", path)
    each = _bytes_each(fields, "ElementType", _META_BYTES, path)
    channels = _number(fields, "ElementNumberOfChannels", path, least=1, most=2**16, otherwise="1")
    skipped = _number(fields, "HeaderSize", path, least=-1, most=2**40, otherwise="0")
    check_claim(path, (*shape, channels), each, None)
    claimed = math.prod(shape) * channels * each
    compressed = _is_true(fields.get("CompressedData", "False"))
    source = fields["ElementDataFile"]
    if source.lower() == "local":
        if skipped > 0:
            raise InputError(f"{path}: `HeaderSize` in its header is for values in another file. Export it anew.")
        if compressed:
            _check_compressed_size(fields, path, path.stat().st_size - last.end())
        return _Values(path, last.end(), claimed, compressed)
    there = _file_of_values(source, path)
    return _Values(there, there.stat().st_size - claimed if skipped < 0 else skipped, claimed, compressed)


def _check_compressed_size(fields: Mapping[str, str], path: Path, there: int) -> None:
    """Raises `InputError` unless a header tells how many compressed bytes follow it: ITK needs it, and does not say so.

    Without it, it returns memory that nothing was written to.
    """
    told = fields.get("CompressedDataSize", "")
    if told.strip() != str(there):
        found = f"says {shortened(told, 40)}" if told else "is missing"
        raise InputError(
            f"{path}: {there} bytes of compressed values follow its header, where `CompressedDataSize` {found}: it is "
            "damaged, or its values cannot be told. Save it anew, with 3D Slicer, say."
        )


def _of_nrrd(beginning: bytes, path: Path) -> _Values:
    """Nothing is claimed where values are text, or start elsewhere in the file: ITK tells of these what is wrong."""
    if not beginning.startswith(b"NRRD"):
        raise InputError(f"{path}: no NRRD file, it does not begin with `NRRD`. Export it anew.")
    end = re.search(rb"\r?\n\r?\n", beginning)
    header = beginning if end is None else beginning[: end.start()]
    own = re.compile(r"#|[^:]*:=")  # comments, and what users add
    lines = [re.sub(r"^[^:]*", lambda key: key[0].lower(), line) for line in _lines(header) if not own.match(line)]
    fields = _fields(lines, ": ", path)
    source = fields.get("data file", fields.get("datafile"))
    there = path if source is None else _file_of_values(source, path)
    if source is None and end is None:
        raise InputError(f"{path}: no empty line ends its header, so it holds no values. Export it anew.")
    _check_units(re.findall(r'"([^"]*)"', fields.get("space units", fields.get("units", ""))), path)
    shape = _sizes(fields, "sizes", path)
    each = _bytes_each({"type": fields.get("type", "").lower()}, "type", _NRRD_BYTES, path)
    check_claim(path, shape, each, None)
    encoding = fields.get("encoding", "").lower()
    skips = {fields.get(key, "0") for key in ("line skip", "lineskip", "byte skip", "byteskip")}
    if encoding not in ("raw", "gz", "gzip") or skips != {"0"}:
        return _Values(there, 0, None, False)
    start = end.end() if source is None and end is not None else 0
    return _Values(there, start, math.prod(shape) * each, encoding != "raw")


def _check_units(units: Iterable[str], path: Path) -> None:
    """Raises `InputError` for lengths that are not in mm: ITK passes over their unit and takes all for mm."""
    if others := [unit for unit in units if unit.strip().lower() in _OTHER_UNITS]:
        raise InputError(
            f"{path}: its header tells lengths in {others[0].strip()}, but mm were expected. Save it anew in mm."
        )


def _fields(lines: Iterable[str], sign: str, path: Path) -> dict[str, str]:
    """The fields of a header by their names. Raises `InputError` for one that is there twice, and places of NaN."""
    found: dict[str, str] = {}
    for line in lines:
        key, separator, value = line.partition(sign)
        key = key.strip()
        if not separator:
            continue
        if key in found:
            raise InputError(f"{path}: `{shortened(key, 40)}` stands twice in its header. Export it anew.")
        found[key] = value.strip()
    for key in _PLACES:
        if _NOWHERE.search(found.get(key, "")):
            raise InputError(f"{path}: `{key}` in its header is not a finite number. Export it anew.")
    return found


def _lines(header: bytes) -> list[str]:
    return [line.rstrip("\r") for line in header.decode("utf-8", "replace").split("\n")]


def _is_true(text: str) -> bool:
    """As MetaIO reads it, by the first letter."""
    return text[:1] in ("T", "t", "1")


def _number(fields: Mapping[str, str], key: str, path: Path, least: int, most: int, otherwise: str = "") -> int:
    text = fields.get(key, otherwise)
    if re.fullmatch(r"-?[0-9]{1,15}", text) is None or not least <= int(text) <= most:
        raise InputError(f"{path}: `{key}` in its header is to be {least} to {most}, found {shortened(text, 40)}.")
    return int(text)


def _sizes(fields: Mapping[str, str], key: str, path: Path) -> tuple[int, ...]:
    words = fields.get(key, "").split()
    if not words or any(re.fullmatch(r"[0-9]{1,12}", word) is None for word in words):
        found = shortened(fields.get(key, ""), 40)
        raise InputError(f"{path}: `{key}` in its header is to hold whole numbers, found {found}. Export it anew.")
    return tuple(map(int, words))


def _bytes_each(fields: Mapping[str, str], key: str, sizes: Mapping[str, int], path: Path) -> int:
    kind = fields.get(key, "")
    if kind not in sizes:
        raise InputError(f"{path}: `{key}` in its header is no type of numbers, {shortened(kind, 40)}. Export it anew.")
    return sizes[kind]


def _file_of_values(source: str, path: Path) -> Path:
    """The file that a header names. Raises `InputError` where there is none."""
    if source.split()[:1] == ["LIST"] or "%" in source:
        raise InputError(f"{path}: its values stand in several files. Save it as one file.")
    there = path.parent / source
    with suppress(OSError, ValueError):  # a name that is too long, or holds a zero
        if source and there.is_file():
            return there
    raise InputError(
        f"{path}: its values stand in another file, {shortened(source, 100)}, which is not there. Put it there, or "
        "save both as one file."
    )


def _check_values(values: _Values, path: Path) -> None:
    if values.claimed is None:
        return
    there = values.path.stat().st_size - values.start
    if not values.compressed:
        if there != values.claimed or values.start < 0:
            raise InputError(
                f"{path}: its header claims {values.claimed} bytes of values, found {max(there, 0)}. The file is cut "
                "off or damaged: export or copy it anew."
            )
        return
    try:
        whole = _inflated(values, values.claimed) == values.claimed
    except zlib.error:
        whole = False
    if not whole:
        raise InputError(
            f"{path}: its compressed values are damaged, or not the {values.claimed} bytes that its header claims. "
            "Export or copy it anew."
        )


def _inflated(values: _Values, most: int) -> int:
    """How many bytes are compressed there by zlib or gzip, counted until there are too many; −1 if the end is missing.

    The checksum at the end is compared. Raises `zlib.error` for what is damaged.
    """
    stream, count = zlib.decompressobj(zlib.MAX_WBITS | 32), 0
    with opened(values.path) as file:
        file.seek(values.start)
        while not stream.eof and count <= most:
            some = stream.unconsumed_tail or file.read(_CHUNK)
            if not some:
                return -1
            count += len(stream.decompress(some, 16 * _CHUNK))
    return count
