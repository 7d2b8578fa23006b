"""Label tables: which ids of a label map belong to which bone."""

import re
import unicodedata
from collections.abc import Iterable
from pathlib import Path

from femoreg_torch.anatomy.body import Anatomy
from femoreg_torch.configs import load_preset, preset_names
from femoreg_torch.errors import InputError, shortened

_GROUP = "anatomy/labels"
LARGEST_ID = 65535
_OF_THE_HIPS = ("hip_left", "hip_right", "femur_left", "femur_right")
_SIDES = {  # as people shorten them, and in German, French, Spanish and Latin; without accents
    "left": "l lt li links linke linker linkes g gauche izq izquierdo izquierda sinister sinistra sinistrum",
    "right": "r rt re rechts rechte rechter rechtes d droit droite der derecho derecha dexter dextra dextrum",
}
_SIDE_OF = {word: side for side, words in _SIDES.items() for word in words.split()}

LabelTable = dict[str, tuple[int, ...]]  # ids of bones (or of groups of bones) by name


def label_table_names() -> list[str]:
    """Names of the tables in `configs/anatomy/labels/`."""
    return preset_names(_GROUP)


def label_table(name: str | Path) -> LabelTable:
    """Ids of each bone in the label maps of a known source, by the table's name or YAML file.

    Raises `InputError` with the known names if there is no such table, and for ids that are not whole numbers above 0.
    """
    where = f"label table {name}"
    content = load_preset(_GROUP, name)
    if set(content) != {"anatomy", "bones"}:
        raise InputError(
            f"{where}: the keys `anatomy` and `bones` were expected, found {', '.join(map(str, content))}."
        )
    if not isinstance(content["bones"], dict):
        raise InputError(
            f"{where}, bones: bones with their ids were expected, as in {{femur_left: 5}}, found "
            f"{shortened(content['bones'])}."
        )
    return {str(bone): label_ids(ids, f"{where}, bones.{bone}") for bone, ids in content["bones"].items()}


def fitting_tables(ids: Iterable[int]) -> list[str]:
    """Names of the shipped label tables of which a map with these ids holds both hip bones and both femora.

    Other bones may lie outside of a CT of the hips.
    """
    there = set(ids)
    return [
        name
        for name in label_table_names()
        if {n for bone, of_bone in label_table(name).items() if bone in _OF_THE_HIPS for n in of_bone} <= there
    ]


def label_ids(value: object, where: str) -> tuple[int, ...]:
    """One id, or a list of ids, as a tuple. Raises `InputError` that starts with `where`."""
    ids = value if isinstance(value, list) else [value]
    if not ids or not all(type(n) is int and 0 < n <= LARGEST_ID for n in ids):
        raise InputError(f"{where}: a label id above 0, or a list of them, was expected, found {shortened(value)}.")
    return tuple(ids)


def bone_of_name(anatomy: Anatomy, text: str) -> str | None:
    """The bone, or group of bones, that another program calls by this name (a segment, a file), or None.

    Neither the order of the words nor what stands between them counts: "Femur (Right)", "femur_R", "rt. femur" and
    "fémur droit" are one bone.
    """
    wanted = _words(text)
    for bone in anatomy.bones:
        if wanted in [_words(name) for name in (bone.name, *bone.names)]:
            return bone.name
    return next((group for group in anatomy.groups if wanted == _words(group)), None)


def _words(text: str) -> list[str]:
    """The words of a name in order of the alphabet, in lower case without accents, sides in English."""
    letters = unicodedata.normalize("NFKD", text.lower())
    plain = "".join(letter for letter in letters if not unicodedata.combining(letter))
    return sorted(_SIDE_OF.get(word, word) for word in re.findall(r"[^\W_]+", plain))
