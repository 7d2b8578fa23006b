"""Files of CAD meshes: one surface, or several bodies with names. What is read is in mm."""

import re
import zipfile
from collections import Counter
from collections.abc import Sequence
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from femoreg_torch.arrays import opened, quiet
from femoreg_torch.errors import InputError, in_mm
from femoreg_torch.paths import check_readable
from femoreg_torch.volume.mesh import check_closed
from femoreg_torch.volume.step_files import STEP_SUFFIXES, glb_of_step

if TYPE_CHECKING:
    import trimesh

_SUFFIXES = (".stl", ".ply", ".obj", ".off", ".3mf", ".glb", *STEP_SUFFIXES)
_MOST_UNZIPPED = 2**29  # bytes of all that a 3MF file holds
_SHORTEST_MM, _LONGEST_MM = 5.0, 2000.0  # of a device; beyond them the file is likely in metres, inches or µm
_SAME_DECIMALS = 4  # of corners in mm
_FARTHEST_MM = 1e6  # of a corner from the origin


def read_mesh(path: Path) -> "trimesh.Trimesh":
    """A closed surface in mm from an STL, PLY, OBJ, OFF, 3MF, GLB or STEP file, equal vertices merged.

    Bodies of a file that holds several are taken together, one that stands there twice once. Raises `InputError`.
    """
    import trimesh

    bodies = _load(Path(path), split_objects=False, split_groups=False)
    whole = trimesh.util.concatenate(_each_once(list(bodies.values())))
    assert isinstance(whole, trimesh.Trimesh)  # as all bodies are
    return check_closed(whole, str(path))


def read_bodies(path: Path, names: Sequence[str]) -> "dict[str, trimesh.Trimesh]":
    """The closed bodies in mm of a 3MF, GLB, STEP or OBJ file by name, in the order of `names`.

    Bodies of an OBJ file are its objects, or its groups where it has not more than one object. Raises `InputError`
    unless `names` are those of all bodies of the file.
    """
    path = Path(path)
    bodies = _named(path)
    unknown = [name for name in names if name not in bodies]
    unnamed = [name for name in bodies if name not in names]
    if unknown or unnamed:
        wrong = [f"{', '.join(unknown)} is not in the file"] if unknown else []
        wrong += [f"{', '.join(unnamed)} has no material"] if unnamed else []
        raise InputError(
            f"{path}: {' and '.join(wrong)}. Name each body once under `parts`; the file has: {', '.join(bodies)}."
        )
    return {name: check_closed(bodies[name], f"{path}, body {name}") for name in names}


def body_names(path: Path) -> tuple[str, ...]:
    """Names of the bodies that `read_bodies` finds in a mesh file, by the alphabet. Raises `InputError`."""
    return tuple(sorted(_named(Path(path))))


def _named(path: Path) -> "dict[str, trimesh.Trimesh]":
    """The bodies of a file by name; those of an OBJ file are its objects, or its groups if it has but one object."""
    bodies = _load(path, split_objects=True, split_groups=False)
    if path.suffix.lower() == ".obj" and len(bodies) == 1:
        bodies = _load(path, split_objects=False, split_groups=True)
    return bodies


def _each_once(bodies: "Sequence[trimesh.Trimesh]") -> "list[trimesh.Trimesh]":
    """The bodies without those whose triangles are all those of an earlier one.

    `check_closed` sees to bodies within one mesh, where equal corners have one number; those of a 3MF, a GLB or an STL
    of several solids have numbers of their own each, and where they overlap voxels on the surface would count twice.
    """
    found: dict[bytes, trimesh.Trimesh] = {}
    for body in bodies:
        corners = np.round(body.triangles, _SAME_DECIMALS) + 0.0  # no −0
        lowest = np.lexsort(corners.transpose(2, 0, 1)[::-1])[:, 0]
        turned = np.take_along_axis(corners, ((lowest[:, None] + np.arange(3)) % 3)[..., None], 1).reshape(-1, 9)
        found.setdefault(turned[np.lexsort(turned.T[::-1])].tobytes(), body)
    return list(found.values())


def bounds_of(meshes: "Sequence[trimesh.Trimesh]", where: str) -> np.ndarray:
    """The lowest and the highest corner (2, 3) of the meshes of a device, mm.

    Raises `InputError` that starts with `where` if no device is of that size.
    """
    corners = np.concatenate([mesh.bounds for mesh in meshes])
    bounds = np.stack([corners.min(0), corners.max(0)])
    longest = float((bounds[1] - bounds[0]).max())
    if not _SHORTEST_MM <= longest <= _LONGEST_MM:
        raise InputError(
            f"{where}: its longest edge is {in_mm(longest)}, but a device has {_SHORTEST_MM:g} to {_LONGEST_MM:g} mm. "
            "The file is to be in mm (a GLB in metres, a 3MF or STEP in the unit that it names)."
        )
    return bounds


def is_in_ras(path: Path) -> bool:
    """Whether 3D Slicer wrote into the file that its coordinates are RAS; without a word they are LPS to Slicer."""
    with opened(path) as file:
        return b"SPACE=RAS" in file.read(512)


def _load(path: Path, split_objects: bool, split_groups: bool) -> "dict[str, trimesh.Trimesh]":
    """The surfaces of a file by name, where they stand in the file's scene, in mm. OBJ files can be split."""
    import trimesh  # takes most of a second, which reading of the CT hides

    check_readable(path)
    if path.suffix.lower() not in _SUFFIXES:
        raise InputError(f"{path}: a mesh ({', '.join(_SUFFIXES)}) was expected.")
    options: dict[str, Any] = {}
    if path.suffix.lower() == ".obj":
        options = {"split_objects": split_objects, "split_groups": split_groups, "group_material": False}
    try:
        with quiet():
            if path.suffix.lower() == ".3mf":
                _check_3mf(path)
            source, kind = _source(path)
            scene = trimesh.load_scene(source, file_type=kind, process=False, **options)
            bodies = _bodies(scene, path)
    except InputError:
        raise
    except Exception as error:  # trimesh's readers raise whatever their parsing runs into
        reason = " ".join(str(error).split())[:200] or type(error).__name__
        raise InputError(
            f"{path}: cannot be read as a mesh (STL, PLY, OBJ, OFF, 3MF, GLB or STEP): {reason}."
        ) from error
    if not bodies:
        raise InputError(f"{path}: the mesh holds no triangle.")
    return bodies


def _source(path: Path) -> tuple[Path | BytesIO, str]:
    """What trimesh reads for a file, and as which format. Raises `InputError`."""
    suffix = path.suffix[1:].lower()
    if path.suffix.lower() in STEP_SUFFIXES:
        return BytesIO(glb_of_step(path)), "glb"
    text = _text(path)
    return (path if text is None else BytesIO(text.encode())), suffix


def _text(path: Path) -> str | None:
    """The text of an STL or OBJ file; None for other files and for binary STL.

    Text that is not UTF-8 is Latin-1, as older CAD programs write names. Raises `InputError` for an STL file that is
    cut off: of bodies that do not end trimesh says nothing.
    """
    if path.suffix.lower() not in (".stl", ".obj"):
        return None
    with opened(path) as file:
        content = file.read()
    if path.suffix.lower() == ".stl" and _is_binary(content, path):
        return None
    try:
        text = content.decode("utf-8-sig")
    except UnicodeDecodeError:
        text = content.decode("latin-1")
    text = text.replace("\r\n", "\n").replace("\r", "\n")
    if path.suffix.lower() == ".obj":
        return text.replace("\t", " ")
    if path.suffix.lower() == ".stl":
        begun, ended = (len(re.findall(rf"^[ \t]*{word}\b", text, re.M | re.I)) for word in ("solid", "endsolid"))
        if begun > ended:
            raise InputError(f"{path}: has {begun} `solid` and {ended} `endsolid`: it is cut off. Export it anew.")
        if re.search(r"vertex\s+[-+]?\d+,\d", text, re.I):
            raise InputError(f"{path}: its numbers have a comma, and a decimal point was expected. Export it anew.")
    return text


def _is_binary(content: bytes, path: Path) -> bool:
    """Whether an STL file is a binary one. Raises `InputError` if its size is not that of the triangles it counts."""
    size, count = len(content), int.from_bytes(content[80:84], "little")
    if size >= 84 and size == 84 + 50 * count:
        return True
    if size >= 84 and b"\0" in content[:84]:
        raise InputError(
            f"{path}: counts {count} triangles, which take {84 + 50 * count} bytes, and has {size}: it is cut off or "
            "damaged. Export it anew."
        )
    return False


def _check_3mf(path: Path) -> None:
    """Raises `InputError` for a 3MF file that would grow beyond any device, or whose bodies trimesh cannot tell apart.

    It is a zip archive. Objects have numbers within each of its models, and trimesh takes equal ones for one object.
    """
    with zipfile.ZipFile(path) as archive:
        size = sum(entry.file_size for entry in archive.infolist())
        if size > _MOST_UNZIPPED:
            raise InputError(f"{path}: unpacks to {size / 2**20:.0f} MB, which no device has. Export it coarser.")
        models = [entry for entry in archive.namelist() if entry.lower().endswith(".model")]
        if models and not any(entry.lower().endswith("3dmodel.model") for entry in models):
            raise InputError(f"{path}: its model is called {models[0]}, 3D/3dmodel.model was expected. Export it anew.")
        found = [set(re.findall(rb"<(?:\w+:)?object\b[^>]*?\sid=\"([^\"]*)\"", archive.read(each))) for each in models]
    numbers = Counter(number for each in found for number in each)
    if twice := [number.decode(errors="replace") for number, count in numbers.items() if count > 1]:
        raise InputError(
            f"{path}: several of its {len(models)} models have an object of the number {twice[0]}, which cannot be "
            "told apart here. Export it as one model, or each body as STL."
        )


def _bodies(scene: "trimesh.Scene", path: Path) -> "dict[str, trimesh.Trimesh]":
    """The surfaces of a scene by name, in mm, equal vertices merged."""
    import trimesh

    mm = 1.0 if scene.units is None else trimesh.units.unit_conversion(scene.units, "mm")
    bodies = {}
    for node in sorted(scene.graph.nodes_geometry):
        place, geometry = scene.graph[node]
        unnamed = node.startswith("=>[") and geometry not in scene.graph.nodes_geometry  # a place in a STEP assembly
        name = str(geometry) if unnamed and geometry not in bodies else node
        surface = scene.geometry[geometry]
        if not isinstance(surface, trimesh.Trimesh):
            raise InputError(f"{path}: triangle meshes were expected, found {type(surface).__name__}.")
        if surface.vertices.shape[1:] != (3,):
            raise InputError(f"{path}: a corner lacks a coordinate. Export it anew.")
        if len(surface.faces) and (surface.faces.min() < 0 or surface.faces.max() >= len(surface.vertices)):
            raise InputError(f"{path}: a triangle has a corner that is not in the file. Export it anew.")
        mesh = trimesh.Trimesh(surface.vertices, surface.faces, process=False)
        mesh.apply_transform(place)
        mesh.apply_scale(mm)
        if (abs(mesh.vertices) > _FARTHEST_MM).any():
            raise InputError(
                f"{path}: a corner lies {in_mm(float(abs(mesh.vertices).max()))} from the origin. Is it in mm?"
            )
        mesh.merge_vertices()
        a, b, c = mesh.faces.T
        mesh.update_faces((a != b) & (b != c) & (c != a))  # slivers whose corners became one in the file's float32
        bodies[name] = mesh
    return bodies
