"""The command `femoreg detect`."""

from pathlib import Path
from typing import Literal


def detect(
    images: list[Path],
    *,
    out: Path,
    carm: str = "cios_fusion",
    intensity: Literal["raw", "log"] | None = None,
    mirrored: bool = False,
    turned: Literal[0, 90, 180, 270] = 0,
    frame: int | None = None,
    weights: Path | None = None,
    device: Literal["cpu", "cuda", "auto"] = "cpu",
) -> None:
    """Find the 14 hip landmarks and the bones in fluoroscopic images.

    Writes into OUT: landmarks.csv with the columns image, landmark, column_px, row_px, confidence, visible; and for
    each image a picture, and its visible landmarks as 3D Slicer markups (x = column, y = row, as for pixels of 1 mm).
    Patient left is expected on the right; an image that stands on its head, or has bone and background exchanged, is
    noticed. So is one with fewer than four landmarks, from which a start pose follows by the outlines of bones alone.

    Args:
        images: fluoroscopic images, or folders of nothing else: DICOM, PNG, TIFF, NIfTI, MHA or NRRD.
        out: folder of the results.
        carm: C-arm that the images come from: a preset, or a YAML file such as configs/carm/cios_fusion.yaml.
        intensity: raw (bone dark) or log (attenuation, bone bright); by default what the files say, or else raw.
        mirrored: whether the images are mirror images of usual ones, which have the patient's left on the right.
        turned: by how many degrees the images are turned clockwise against head up.
        frame: of cine runs in DICOM files, from 1.
        weights: network weights (safetensors); by default the shipped ones.
        device: where the network computes: cpu, cuda (the first GPU), or auto, a GPU where there is one.
    """
    from rich.console import Console

    from femoreg_torch.commands.telling import tell_device
    from femoreg_torch.detect import as_stored, filled, load_network, within_field
    from femoreg_torch.detect import detect as find
    from femoreg_torch.detect.writing import write_detections
    from femoreg_torch.errors import InputError
    from femoreg_torch.files import check_new_folder
    from femoreg_torch.fluoro import (
        Display,
        attenuation_image,
        check_matches,
        exposed_field,
        intensity_of,
        read_stored,
        settled_intensity,
    )
    from femoreg_torch.geometry import load_carm
    from femoreg_torch.pnp import MINIMUM

    check_new_folder(out)
    images = [file for path in images for file in _files(path)]
    repeated = {path.stem for path in images if sum(path.stem == other.stem for other in images) > 1}
    if repeated:
        raise InputError(f"images: the name {min(repeated)} stands there twice. Rename one, results go by this name.")
    display, as_shown = Display(mirrored=mirrored, turned_deg=turned), load_carm(carm).camera
    camera = display.camera(as_shown)
    console = Console()
    network = load_network(weights, tell_device(console, device))
    stored = [read_stored(path, None if frame is None else (frame,)) for path in images]
    for path, image in zip(images, stored, strict=True):
        check_matches(image.values, as_shown, f"{path}:")
    attenuation, detections = [], []
    for path, image in zip(images, stored, strict=True):
        settled = settled_intensity(intensity, image, str(path))
        upright, raw = display.to_camera(image.values_as(settled)), settled == "raw"
        field = exposed_field(upright if raw else intensity_of(upright), camera)
        shown = attenuation_image(upright, field) if raw else upright
        shown = shown if field is None else filled(shown, field)
        found = find(network, shown, camera)
        attenuation.append(display.to_stored(shown))
        detections.append(as_stored(found if field is None else within_field(found, field), display, camera))
    write_detections(out, images, attenuation, detections, as_shown)
    for path, detection in zip(images, detections, strict=True):
        count = int(detection.visible.sum())
        remarks = [
            *(["standing on its head"] if detection.turned else []),
            *(["grey values inverted"] if detection.inverted else []),
            *(
                [f"fewer than {MINIMUM}: a start pose then hangs on the outlines of the bones"]
                if count < MINIMUM
                else []
            ),
        ]
        console.print(", ".join([f"{path}: {count} of {len(detection.visible)} landmarks", *remarks]))


def _files(path: Path) -> list[Path]:
    """The file itself, or all files of a folder. Raises `InputError` for a folder without any."""
    from femoreg_torch.errors import InputError

    if not path.is_dir():
        return [path]
    files = sorted(entry for entry in path.iterdir() if entry.is_file() and not entry.name.startswith("."))
    if not files:
        raise InputError(f"{path}: a folder without files. Name images, or a folder of images.")
    return files
