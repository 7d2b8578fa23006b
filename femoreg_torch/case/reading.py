"""A case folder into a `Case`, every field checked."""

from pathlib import Path

from femoreg_torch.case import femoroplasty_form
from femoreg_torch.case.femoroplasty import TEMPLATE
from femoreg_torch.case.fields import Fields
from femoreg_torch.case.model import Case
from femoreg_torch.case.objects import read_object, read_plan
from femoreg_torch.case.parts import (
    read_anatomy_and_bones,
    read_carm,
    read_display,
    read_truth,
    read_view,
    with_known_poses,
)
from femoreg_torch.errors import InputError, shortened
from femoreg_torch.paths import why_unreadable
from femoreg_torch.text import read_yaml_and_lines
from femoreg_torch.volume import read_landmarks

CASE_NAME = "case.yaml"
VERSIONS = (1, 2)
_MAKE = "Make a case with `femoreg new-case` or `femoreg simulate`."
_KEYS = ("version", "anatomy", "ct", "landmarks", "objects", "plan", "carm", "display", "views", "truth")


def case_folder(path: Path) -> Path:
    """The folder that is meant by the path of a case: that folder, or the one in which this `case.yaml` stands.

    Raises `InputError` for another file, and for what is missing or cannot be read.
    """
    path = Path(path)
    if path.name == CASE_NAME and path.is_file():
        return path.parent
    beside = f"Name the folder {path.parent}." if (path.parent / CASE_NAME).is_file() else _MAKE
    if (why := why_unreadable(path, beside, "folder")) is not None:
        raise InputError(f"{path}: {why}")
    return path


def read_fields(folder: Path) -> Fields:
    """The mapping in `case.yaml`. Raises `InputError` as `case_folder` does, and if it is missing or something else."""
    folder = case_folder(folder)
    path = folder / CASE_NAME
    if not path.is_file():
        inside = sorted(other.parent.name for other in folder.glob(f"*/{CASE_NAME}"))
        meant = f"Its folders do: {shortened(', '.join(inside), 100)}. Name one." if inside else _MAKE
        raise InputError(f"{folder}: not a case folder, it holds no {CASE_NAME}. {meant}")
    content, lines = read_yaml_and_lines(path)
    return Fields(content, str(path), lines=lines)


def read_case(folder: Path) -> Case:
    """The case of the `case.yaml` in `folder`, or of that file itself. Images and volumes are only looked for.

    Raises `InputError` that names file and key for anything missing, unknown or of another kind than expected.
    """
    folder = case_folder(folder)
    top = read_fields(folder)
    if read_version(top) == 1:
        return femoroplasty_form.read_version_1(top, folder)
    if "template" in top:
        top.choice("template", (TEMPLATE,))
        return femoroplasty_form.read_femoroplasty(top, folder)
    case = _read_objects(top.only(*_KEYS), folder)
    _check_kinds(case, top)
    return case


def read_version(top: Fields) -> int:
    """The version of the format that `case.yaml` has. Raises `InputError` for one that is not known."""
    version = top.value("version", " or ".join(map(str, VERSIONS)))
    if type(version) is not int or version not in VERSIONS:
        known = " and ".join(map(str, VERSIONS))
        quoted = isinstance(version, str) and version.strip() in map(str, VERSIONS)
        mend = " Take the quotes away: it is a number." if quoted else ""
        raise InputError(
            f"{top.where('version')}: this FemoReg Torch reads versions {known}, found {shortened(version)}.{mend}"
        )
    return version


def _read_objects(top: Fields, folder: Path) -> Case:
    """A case whose objects are written out."""
    anatomy, bones = read_anatomy_and_bones(top, folder)
    ct = top.mapping("ct").only("image", "labels", "bones") if "ct" in top else None
    known = anatomy.landmark_names if anatomy else None
    landmarks = read_landmarks(top.file_path("landmarks", folder), known) if "landmarks" in top else {}
    entries = top.mapping("objects")
    objects = {name: read_object(entries, name, folder, bones, anatomy, landmarks) for name in entries.content}
    if not objects:
        raise InputError(f"{top.where('objects')}: is empty. Name at least one object to be registered.")
    for name, thing in objects.items():
        if thing.start.beside is not None and (thing.start.beside not in objects or thing.start.beside == name):
            others = ", ".join(other for other in objects if other != name)
            raise InputError(f"{entries.where(name)}.start.beside: the name of another object was expected: {others}.")
    views = tuple(read_view(view, folder) for view in top.mappings("views")) if "views" in top else ()
    display = read_display(top)
    truth, truth_source = read_truth(top, folder, list(objects), len(views))
    return Case(
        folder=folder,
        carm=read_carm(top, display, views),
        objects=objects,
        views=with_known_poses(views, top),
        anatomy=anatomy,
        ct_path=ct.file_path("image", folder, may_be_folder=True) if ct else None,
        labels_path=ct.file_path("labels", folder, may_be_folder=True) if ct and "labels" in ct else None,
        bones=bones,
        landmarks=landmarks,
        plan=read_plan(top.mapping("plan"), folder, objects, landmarks) if "plan" in top else None,
        truth=truth,
        truth_source=truth_source,
        display=display,
    )


def _check_kinds(case: Case, top: Fields) -> None:
    """Raises `InputError` for an object shown in a kind of images that no view has a place for."""
    if not case.views:
        return
    for name, thing in case.objects.items():
        for kind in thing.images or ():
            if kind not in case.kinds:
                raise InputError(
                    f"{top.where('objects')}.{name}.images: no view has an image {shortened(kind)}. There are: "
                    f"{', '.join(case.kinds)}."
                )
