"""`femoreg inspect`, `femoreg check` and `femoreg new-case`: a user's own data."""

from pathlib import Path
from typing import TYPE_CHECKING, Literal

if TYPE_CHECKING:
    from femoreg_torch.intake.planes import Picture


def inspect(path: Path, *, out: Path = Path("inspect.png"), series: str | None = None) -> None:
    """Say what a file or folder holds, and what may be wrong with it, and show it in a picture.

    Knows: CTs and label maps (DICOM folder, NIfTI, NRRD, MHA), segmentations of 3D Slicer (.seg.nrrd), folders with a
    mask for each bone (TotalSegmentator), DICOM SEG; landmarks and other points (.mrk.json, .fcsv, .csv, .json),
    meshes, transforms (.tfm, .h5), images, and case folders. Of a folder with several of these it says in one line each
    what they are. A volume is shown in three planes.

    Args:
        path: File or folder.
        out: Picture to write (PNG), where there is something to be shown.
        series: Of a DICOM folder with several series, the number, UID or a part of the description of one.
    """
    from rich.console import Console
    from rich.markup import escape

    from femoreg_torch.commands.telling import tell
    from femoreg_torch.intake import inspect_path

    _check_picture(out, path)
    console = Console(soft_wrap=True)
    found = inspect_path(path, series)
    console.print(f"[bold]{escape(str(path))}[/]: {escape(found.kind)}")
    for fact in found.facts:
        console.print(f"  {escape(fact)}", highlight=False)
    for warning in found.warnings:
        tell(console, "Warning", warning)
    if found.picture is not None:
        write_picture(out, found.picture)
        console.print(f"Picture: {escape(str(out))}")


def check(case: Path, *, out: Path = Path("check.png"), landmarks: Path | None = None, fast: bool = False) -> int:
    """List everything that is wrong with a case, at once, and draw how it was understood.

    The picture shows three planes of the CT with bones and landmarks, and the first view with the bones at the start
    pose, sides named, and with the device where it is meant to stand. Ends with status 1 if something is wrong.

    Args:
        case: Case folder with case.yaml.
        out: Picture to write (PNG).
        landmarks: Landmarks in the first image, in place of the network's: see `femoreg register --help`.
        fast: Do not look for the start pose in the images.
    """
    from rich.console import Console
    from rich.markup import escape

    from femoreg_torch.case import case_folder
    from femoreg_torch.case.start_files import read_pixels
    from femoreg_torch.commands.status import AMISS, DONE
    from femoreg_torch.commands.telling import tell
    from femoreg_torch.intake import check_case

    case = case_folder(case)
    _check_picture(out, case)
    console = Console(soft_wrap=True)
    pixels = None if landmarks is None else read_pixels(landmarks)
    with console.status("reading the case" if fast else "reading the case and looking for the start"):
        found = check_case(case, find_start=not fast, landmarks=pixels)
    for fact in found.facts:
        console.print(f"  {escape(fact)}", highlight=False)
    for warning in found.warnings:
        tell(console, "Warning", warning)
    for number, problem in enumerate(found.problems, 1):
        console.print(f"[bold red]{number}.[/] {escape(problem)}", highlight=False)
    if found.picture is not None:
        write_picture(out, found.picture)
        console.print(f"Picture: {escape(str(out))}")
    if found.problems:
        count = len(found.problems)
        console.print(f"[bold red]{count} problem{'s' * (count > 1)}.[/] Mend all and check again.")
        return AMISS
    beside = ", but for what is warned of" if found.warnings else ""
    console.print(f"[green]Nothing is wrong that can be seen before the registration{beside}.[/]")
    return DONE


def _check_picture(out: Path, source: Path) -> None:
    """Raises `InputError` for a name that is none of a picture, or is that of what the picture is made of."""
    from femoreg_torch.errors import InputError
    from femoreg_torch.files import check_files
    from femoreg_torch.text import MOST_YAML_BYTES, read_bytes

    check_files(out)
    if out.suffix.lower() not in (".png", ".jpg"):
        raise InputError(f"{out}: a name that ends in .png was expected. Choose another with --out.")
    if not (out.exists() and source.exists()):
        return
    form = source / "case.yaml"
    in_case = form.is_file() and out.parent.samefile(source)
    if out.samefile(source) or (in_case and out.name.encode() in read_bytes(form, MOST_YAML_BYTES)):
        raise InputError(f"{out}: is what the picture is made of. Choose another name with --out.")


def write_picture(path: Path, picture: "Picture") -> None:
    """Write a picture (PNG or JPEG, by its name), whole or not at all."""
    from femoreg_torch import pictures
    from femoreg_torch.files import temporary_file

    with temporary_file(path) as part:
        pictures.write_picture(part, picture)


def new_case(
    out: Path,
    *,
    ct: Path | None = None,
    series: str | None = None,
    labels: Path | None = None,
    bones: str | None = None,
    landmarks: Path | None = None,
    plan: Path | None = None,
    side: Literal["left", "right"] | None = None,
    device: Path | None = None,
    device_points: Path | None = None,
    material: str | None = None,
    hu: float | None = None,
    guide: str | None = None,
    before_entry_mm: float | None = None,
    turned_deg: float | None = None,
    in_front_mm: float | None = None,
    device_transform: Path | None = None,
    images: tuple[Path, ...] = (),
    device_images: tuple[Path, ...] = (),
    carm: str | None = None,
    intensity: Literal["raw", "log"] | None = None,
    frames: int | Literal["mean"] | None = None,
    source: Literal["anterior", "posterior", "left", "right"] | None = None,
    mirrored: bool = False,
    turned: Literal[0, 90, 180, 270] = 0,
    ignore_header: bool = False,
    segment: bool = False,
) -> None:
    """Make a case folder of a CT, a segmentation, landmarks, a plan, a device and fluoroscopic images.

    Files are taken as scanner, 3D Slicer or TotalSegmentator leave them. What is needed and not given is asked for, if
    this runs in a terminal. The folder appears whole and checked (as by `femoreg check --fast`) or not at all;
    everything that is wrong is told at once. Files are copied; a DICOM CT becomes ct.nii.gz.

    Args:
        out: Case folder to make.
        ct: CT: folder of a DICOM series, or a NIfTI, NRRD or MHA file.
        series: Which of several DICOM series: its number, UID, or a part of its description.
        labels: Segmentation: label map, .seg.nrrd of 3D Slicer, folder with a mask for each bone, or DICOM SEG.
        bones: Label table of the map (totalsegmentator_v2, femoreg, …, or a YAML file), if its parts have no names.
        landmarks: Landmarks of the CT: 3D Slicer markups (.mrk.json, .fcsv) or JSON; at least four, with the operated
            femoral head (FH).
        plan: Planned path: a line of 3D Slicer, or points `entry` and `target`; without a target, the femoral head.
        side: Operated side; by default that of the femur which the entry point lies on.
        device: CAD model (STL, PLY, OBJ, 3MF, GLB, STEP), mm. Left out: a case without a device.
        device_points: Its points tip, base and center, in its own space: 3D Slicer markups or JSON. Without `center` it
            is the middle of its box.
        material: What the device is made of: steel, titanium, cobalt chromium, aluminium, peek or pmma.
        hu: HU of the device, in place of a material; 5000 if neither is given.
        guide: Which way the guide points at its nominal pose: `along the planned path` (the default), `from the side`,
            `from the front`, `from the back`, `from above`, `from below` or `from the middle`.
        before_entry_mm: How far before the entry point its tip stands (by default 0); negative: past it.
        turned_deg: By how much it is turned about the guide (by default 0), by the right-hand rule about base → tip.
        in_front_mm: How far all of it stands in front of that place (by default 0), towards the front of the patient.
        device_transform: In place of these: a transform of 3D Slicer under which the device stands right in the CT.
        images: Images without the device, one for each C-arm pose, in order; or a folder of them.
        device_images: Images with the device, in the same order; or a folder of them.
        carm: C-arm: a preset (cios_fusion, cios_spin) or a YAML file; by default what the tags of the first DICOM image
            say.
        intensity: raw (bone dark) or log (attenuation, bone bright); by default what the files say, or else raw.
        frames: Of cine runs, a frame's number from 1, or `mean` of all.
        source: Side of the patient that the X-ray source stands on; by default what the header of the first image says,
            or else anterior.
        mirrored: The pictures are mirror images of the usual ones, which have the patient's left on their right. By
            default what PatientOrientation in the header of the first image says.
        turned: Degrees by which the pictures are turned clockwise against head up; by default as `mirrored`.
        ignore_header: What DICOM headers say of the side of the source and of the pictures' orientation means nothing.
        segment: Find the bones in the CT if --labels is not given, and propose landmarks if --landmarks is not; see
            `femoreg segment` and `femoreg landmarks`.
    """
    import sys

    from rich.console import Console
    from rich.markup import escape

    from femoreg_torch.commands.asking import ask_for_missing
    from femoreg_torch.commands.telling import tell
    from femoreg_torch.intake import NewCase, make_case

    given = NewCase(
        ct=ct,
        series=series,
        labels=labels,
        bones=bones,
        landmarks=landmarks,
        plan=plan,
        side=side,
        device=device,
        device_points=device_points,
        material=material,
        hu=hu,
        guide=guide,
        before_entry_mm=before_entry_mm,
        turned_deg=turned_deg,
        in_front_mm=in_front_mm,
        device_transform=device_transform,
        images=tuple(images),
        device_images=tuple(device_images),
        carm=carm,
        intensity=intensity,
        frames=frames,
        source=source,
        mirrored=mirrored,
        turned=turned,
        ignore_header=ignore_header,
        segment=segment,
    )
    console = Console(soft_wrap=True)
    if sys.stdin.isatty():
        given = ask_for_missing(given, console)
    with console.status("making the case"):
        notes, warnings = make_case(out, given)
    for note in notes:
        console.print(f"  {escape(note)}", highlight=False)
    for warning in warnings:
        tell(console, "Warning", warning)
    console.print(f"Case written to {escape(str(out))}. Look at it with `femoreg check`, then `femoreg register`.")
