"""Models of objects that are no bones: one solid, a file of several bodies, a list of parts, or a scan."""

from pathlib import Path

from femoreg_torch.anatomy.tables import label_ids
from femoreg_torch.case.fields import Fields
from femoreg_torch.case.model import Model, Part
from femoreg_torch.errors import InputError
from femoreg_torch.volume.materials import DENSITIES

MODEL_KEYS = ("model", "volume", "labels", "hu", "material", "parts")
_VOLUME_SUFFIXES = (".nii", ".nii.gz", ".nrrd", ".nhdr", ".mha", ".mhd")
_AIR_HU, _MOST_HU = -1000.0, 1e6  # tungsten, the densest that devices have parts of, has some 350,000
BODIES_SUFFIXES = (".3mf", ".obj", ".glb", ".step", ".stp")  # of files that hold several bodies with names


def is_model(entry: Fields) -> bool:
    """Whether an object has a model of its own."""
    return "model" in entry or "volume" in entry or "parts" in entry


def read_model(entry: Fields, folder: Path) -> Model:
    """The mesh under `model`, the `volume`, or the `parts`, with their materials. Raises `InputError`."""
    if "parts" in entry:
        parts = _bodies(entry, folder) if isinstance(entry.content["parts"], dict) else _listed(entry, folder)
        return Model(parts[0].path, None, parts=parts)
    path, labels = _model_file(entry, folder)
    if "volume" in entry and labels is None:
        for key in ("hu", "material"):
            if key in entry:
                raise InputError(
                    f"{entry.where(key)}: a `volume` without `labels` holds HU itself. Name the labels, or drop "
                    f"`{key}`."
                )
        return Model(path, None)
    hu, material = _material(entry)
    return Model(path, hu, labels, material)


def _bodies(entry: Fields, folder: Path) -> tuple[Part, ...]:
    """The bodies by name of the one file under `model`."""
    _without(entry, "volume", "labels", "hu", "material")
    path = entry.file_path("model", folder)
    if not path.name.lower().endswith(BODIES_SUFFIXES):
        raise InputError(
            f"{entry.where('model')}: {path.name} has no bodies with names ({', '.join(BODIES_SUFFIXES)} have). Give "
            "`parts` as a list with a file each."
        )
    bodies = entry.mapping("parts")
    parts = []
    for name in bodies.content:
        hu, material = _material(bodies.mapping(name).only("hu", "material"))
        parts.append(Part(path, hu, material=material, body=str(name)))
    return _some(parts, entry)


def _listed(entry: Fields, folder: Path) -> tuple[Part, ...]:
    """Parts in files of their own."""
    _without(entry, "model", "volume", "labels", "hu", "material")
    parts = []
    for part in entry.mappings("parts"):
        part.only("model", "volume", "labels", "hu", "material", "name")
        path, labels = _model_file(part, folder)
        if "volume" in part and labels is None:
            raise InputError(f"{part.where('labels')}: missing. Say which labels of the `volume` are this part.")
        hu, material = _material(part)
        name = part.text("name", "a name") if "name" in part else None
        parts.append(Part(path, hu, labels, material, name=name))
    return _some(parts, entry)


def _without(entry: Fields, *keys: str) -> None:
    for key in keys:
        if key in entry:
            raise InputError(
                f"{entry.where(key)}: `parts` are given too. Either name the bodies of one `model` (parts: {{sleeve: "
                "{material: steel}}), or list the parts with their files."
            )


def _some(parts: list[Part], entry: Fields) -> tuple[Part, ...]:
    if not parts:
        raise InputError(f"{entry.where('parts')}: is empty. Name at least one part.")
    return tuple(parts)


def _material(entry: Fields) -> tuple[float | None, str | None]:
    """The `hu` or the name of the `material`; the other is None."""
    if "material" not in entry:
        entry.value("hu", "a number, or `material` in its place,")
        hu = entry.number("hu")
        if not _AIR_HU < hu <= _MOST_HU:
            raise InputError(
                f"{entry.where('hu')}: HU of a solid, above {_AIR_HU:g} (air) and up to {_MOST_HU:g}, were expected, "
                f"found {hu:g}."
            )
        return hu, None
    if "hu" in entry:
        raise InputError(f"{entry.where('material')}: `hu` is given too. Keep one of the two.")
    return None, entry.choice("material", tuple(DENSITIES))


def _model_file(entry: Fields, folder: Path) -> tuple[Path, tuple[int, ...] | None]:
    """The mesh or the volume, and the labels of its voxels if it is a labelled volume."""
    if "model" in entry and "volume" in entry:
        raise InputError(f"{entry.where('volume')}: `model` (a mesh) is given too. Keep one of the two.")
    if "volume" not in entry:
        if "labels" in entry:
            raise InputError(f"{entry.where('labels')}: only a `volume` has labels, found `model` (a mesh).")
        path = entry.file_path("model", folder)
        if path.name.lower().endswith(_VOLUME_SUFFIXES):
            raise InputError(f"{entry.where('model')}: a mesh was expected, found {path.name}. Give it as `volume`.")
        return path, None
    path = entry.file_path("volume", folder)
    if not path.name.lower().endswith(_VOLUME_SUFFIXES):
        raise InputError(
            f"{entry.where('volume')}: a volume ({', '.join(_VOLUME_SUFFIXES)}) was expected, found {path.name}. "
            "Give a mesh as `model`."
        )
    if "labels" not in entry:
        return path, None
    return path, label_ids(entry.value("labels", "a list of label ids"), entry.where("labels"))
