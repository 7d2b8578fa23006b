"""Images of the formats that SimpleITK reads."""

import re
from pathlib import Path

import numpy as np
import SimpleITK as sitk

from femoreg_torch.arrays import check_claim, quiet
from femoreg_torch.errors import InputError
from femoreg_torch.volume.nifti import check_nifti

_HEADER = 2**16  # bytes of a file that hold its header, or the beginning of it
_NOWHERE = re.compile(
    rb"^(Offset|Position|Origin|ElementSpacing|TransformMatrix|Rotation|Orientation|space origin|space directions)"
    rb"\s*[=:].*?(?:nan|inf)",
    re.IGNORECASE | re.MULTILINE,
)
# Lists in the header of a MetaImage, with as many values as the power of its dimensions that is given.
_META_LISTS = {
    b"DimSize": 1, b"ElementSpacing": 1, b"ElementSize": 1, b"Offset": 1, b"Position": 1, b"Origin": 1,
    b"CenterOfRotation": 1, b"TransformMatrix": 2, b"Rotation": 2, b"Orientation": 2,
}  # fmt: skip
_DETACHED = (".mhd", ".nhdr", ".hdr", ".img")  # headers, or values, alone


def read_itk(path: Path) -> sitk.Image:
    """The image of a NIfTI, NRRD or MHA file, as it is stored.

    Raises `InputError` for what cannot be read, is cut off (NIfTI), claims more voxels than it can hold or than can be
    worked with, lies nowhere (an origin of NaN), or holds complex values or, in a NIfTI file, values that are not
    finite.
    """
    if not path.is_file():
        raise InputError(f"{path}: no such file.")
    check_nifti(path)
    try:
        with quiet():
            image = _read_file(path)
    except (RuntimeError, MemoryError, UnicodeDecodeError, OverflowError) as error:
        reason = (str(error).strip().splitlines() or [type(error).__name__])[-1].removeprefix("sitk::ERROR: ")
        raise InputError(
            f"{path}: cannot be read as NIfTI-1, NRRD, MHA or DICOM series ({reason[:200]}). Save it in one of these "
            "formats."
        ) from error
    if "complex" in image.GetPixelIDTypeAsString():
        raise InputError(f"{path}: holds complex values, but real ones were expected. Export their real part.")
    place = np.array([*image.GetOrigin(), *image.GetDirection(), *image.GetSpacing()])
    if not np.isfinite(place).all() or min(image.GetSpacing()) <= 0:
        raise InputError(f"{path}: origin, axes and spacing are not all finite numbers. Export it anew.")
    return image


def _check_place(path: Path) -> None:
    """Raises `InputError` for an origin, axes or spacing of NaN in a header of text, which ITK reads as zero."""
    with path.open("rb") as file:
        header = file.read(_HEADER).partition(b"ElementDataFile")[0].partition(b"\n\n")[0]
    if path.name.lower().endswith((".mha", ".mhd", ".nrrd", ".nhdr")) and (found := _NOWHERE.search(header)):
        key = found[1].decode()
        raise InputError(f"{path}: `{key}` in its header is not a finite number. Export it anew.")
    if path.name.lower().endswith((".mha", ".mhd")):
        _check_meta_image(header, path)


def _check_meta_image(header: bytes, path: Path) -> None:
    """Raises `InputError` for a MetaImage header whose lists are not as long as its dimensions say: MetaIO crashes."""
    lines = (line.partition(b"=") for line in header.splitlines())
    found = {key.strip(): value.split() for key, _, value in lines}
    given = found.get(b"NDims", [])
    dimensions = int(given[0]) if len(given) == 1 and given[0] in (b"2", b"3", b"4") else 0
    if not dimensions:
        raise InputError(f"{path}: `NDims` in its header is to be 2, 3 or 4. Export it anew.")
    for key, power in _META_LISTS.items():
        if key in found and len(found[key]) != dimensions**power:
            raise InputError(
                f"{path}: `{key.decode()}` in its header has {len(found[key])} values for {dimensions} dimensions. "
                "Export it anew."
            )


def _read_file(path: Path) -> sitk.Image:
    _check_place(path)
    reader = sitk.ImageFileReader()
    reader.SetFileName(str(path))
    reader.ReadImageInformation()
    detached = path.name.lower().endswith(_DETACHED)
    check_claim(path, reader.GetSize(), reader.GetNumberOfComponents(), None if detached else path.stat().st_size)
    return reader.Execute()
