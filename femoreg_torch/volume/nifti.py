"""What SimpleITK's reader of NIfTI passes over: values that are not finite, files that are cut off or not compressed.

It turns the first into zero, which as HU would be water, and fills the second up with zeros.
"""

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from femoreg_torch.arrays import check_claim, quiet
from femoreg_torch.errors import InputError

if TYPE_CHECKING:
    import nibabel

_SAME_SIZE = 0.01  # voxels, of what rounding may make of them
NIFTI_SUFFIXES = (".nii", ".nii.gz", ".hdr", ".img", ".img.gz")


def check_nifti(path: Path) -> None:
    """Raises `InputError` for a NIfTI file (by its name) that is damaged or holds values that are not finite.

    NIfTI-1 and NIfTI-2, in one file or two. Files of other names are passed.
    """
    if not path.name.lower().endswith(NIFTI_SUFFIXES):
        return
    import nibabel  # takes a tenth of a second, beside the reading of images

    try:
        with quiet():
            image: Any = nibabel.load(path)  # its declared type is that of all formats, without voxels
            kind = image.get_data_dtype()
            there = None if path.name.lower().endswith((".hdr", ".img", ".img.gz")) else path.stat().st_size
            if not np.isfinite(image.affine).all():
                raise InputError(f"{path}: its origin or its axes are not finite. Export it anew.")
            _check_sizes(path, image)
            check_claim(path, image.shape, kind.itemsize, there)
            # Integers are all finite. To decompress them only to see that none is missing would double the time to
            # read.
            if kind.kind not in "fc" and path.suffix.lower() == ".gz" and _whole(path, image.dataobj):
                return
            values = np.asanyarray(image.dataobj.get_unscaled())
    except InputError:
        raise
    except Exception as error:  # nibabel's readers raise whatever their parsing runs into
        reason = " ".join(str(error).replace(str(path), "it").split()).rstrip(".")[:200]
        raise InputError(f"{path}: cannot be read as NIfTI ({reason}). Export or download it anew.") from error
    if values.dtype.kind in "fc" and not np.isfinite(values).all():
        raise InputError(f"{path}: holds values that are not finite (NaN or infinite). Repair or export it anew.")


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
    expected = data.offset + int(np.prod(data.shape)) * data.dtype.itemsize
    with path.open("rb") as file:
        file.seek(-4, 2)
        return int.from_bytes(file.read(), "little") == expected % 2**32
