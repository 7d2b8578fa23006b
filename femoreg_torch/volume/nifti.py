"""What SimpleITK's reader of NIfTI passes over: values that are not finite, files that are cut off or not compressed.

It turns the first into zero, which as HU would be water, and fills the second up with zeros.
"""

import gzip
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from femoreg_torch.arrays import check_claim, opened, quiet
from femoreg_torch.errors import InputError

if TYPE_CHECKING:
    import nibabel

_SAME_SIZE = 0.01  # voxels, of what rounding may make of them
_BEYOND = 2**20  # bytes that are decompressed after the last voxel, to come to the end of the file
NIFTI_SUFFIXES = (".nii", ".nii.gz", ".hdr", ".img", ".img.gz")


def check_nifti(path: Path) -> None:
    """Raises `InputError` for a NIfTI file (by its name) that is damaged or holds values that are not finite.

    NIfTI-1 in one file or two; NIfTI-2 and Analyze are refused. Files of other names are passed.
    """
    if not path.name.lower().endswith(NIFTI_SUFFIXES):
        return
    import nibabel  # takes a tenth of a second, beside the reading of images

    try:
        with quiet():
            image: Any = nibabel.load(path)  # its declared type is that of all formats, without voxels
            _check_kind(path, image)
            kind = image.get_data_dtype()
            there = None if path.name.lower().endswith((".hdr", ".img", ".img.gz")) else path.stat().st_size
            if not np.isfinite(image.affine).all():
                raise InputError(f"{path}: its origin or its axes are not finite. Export it anew.")
            _check_sizes(path, image)
            check_claim(path, image.shape, kind.itemsize, there)
            # Integers are all finite. To decompress them only to see that none is missing would double the time to
            # read.
            whole = path.suffix.lower() != ".gz" or _whole(path, image.dataobj)
            if kind.kind not in "fc" and path.suffix.lower() == ".gz" and whole:
                return
            if not whole:
                _read_to_the_end(path, _size(image.dataobj))
            values = np.asanyarray(image.dataobj.get_unscaled())
    except InputError:
        raise
    except Exception as error:  # nibabel's readers raise whatever their parsing runs into
        reason = " ".join(str(error).replace(str(path), "it").split()).rstrip(".")[:200]
        raise InputError(f"{path}: cannot be read as NIfTI ({reason}). Export or download it anew.") from error
    if values.dtype.kind in "fc" and not np.isfinite(values).all():
        raise InputError(f"{path}: holds values that are not finite (NaN or infinite). Repair or export it anew.")


def _check_kind(path: Path, image: Any) -> None:
    """Raises `InputError` for relatives of NIfTI-1 that the reader does not know, or that leave left and right open."""
    import nibabel

    if isinstance(image.header, nibabel.nifti2.Nifti2Header):
        raise InputError(
            f"{path}: is a NIfTI-2 file. Save it as NIfTI-1, with 3D Slicer, say, or in Python: x = nibabel.load(…); "
            "nibabel.save(nibabel.Nifti1Image(x.dataobj, x.affine), …)."
        )
    if not isinstance(image, nibabel.nifti1.Nifti1Pair):
        raise InputError(
            f"{path}: is an Analyze file, which does not say where left is. Convert it to NIfTI with a program that "
            "knows where it came from, or export the CT anew."
        )


def _check_sizes(path: Path, image: Any) -> None:
    """Raises `InputError` where voxels have another size by `pixdim` than by the axes; programs differ in choice."""
    sized = [n for n, count in enumerate(image.shape[:3]) if count > 1]
    told = np.abs(np.array(image.header.get_zooms(), float)[sized])
    axes = np.linalg.norm(image.affine[:3, :3], axis=0)[sized]
    if not np.allclose(told, axes, rtol=_SAME_SIZE):
        by = " and ".join(" × ".join(f"{mm:.4g}" for mm in sizes) for sizes in (told, axes))
        raise InputError(f"{path}: its header tells voxels of {by} mm, by pixdim and by its axes. Export it anew.")


def _whole(path: Path, data: "nibabel.arrayproxy.ArrayProxy") -> bool:
    """Whether the last four bytes of a gzip file, its uncompressed size modulo 2³² (RFC 1952), are as `data` demands.

    False does not mean that the file is damaged: one of several gzip members tells the size of the last.
    """
    with opened(path) as file:
        file.seek(-4, 2)
        return int.from_bytes(file.read(), "little") == _size(data) % 2**32


def _size(data: "nibabel.arrayproxy.ArrayProxy") -> int:
    """Bytes of a file, uncompressed, up to its last voxel."""
    return int(data.offset) + int(np.prod(data.shape)) * int(data.dtype.itemsize)


def _read_to_the_end(path: Path, size: int) -> None:
    """Raises `EOFError` or `OSError` for a gzip file whose last bytes are missing or whose sum is another one."""
    with gzip.open(path) as file:
        for start in range(0, size + _BEYOND, _BEYOND):
            if not file.read(min(_BEYOND, size + _BEYOND - start)):
                return
