"""What SimpleITK's reader of NIfTI passes over: values that are not finite, damage, and two places in one header.

It turns values that are not finite into zero, which as HU would be water, and fills up with zeros what is cut off. Of
places that contradict one another it takes one, other programs the other.
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
_SAME_PLACE_MM = 0.5  # of any voxel, by what stands twice in a header
_BEYOND = 2**20  # bytes that are decompressed after the last voxel, to come to the end of the file
_GZIP = b"\x1f\x8b"  # RFC 1952
_HEADER_SIZES = ((348).to_bytes(4, "little"), (348).to_bytes(4, "big"))  # what a NIfTI-1 header begins with
NIFTI_SUFFIXES = (".nii", ".nii.gz", ".hdr", ".img", ".img.gz")


def check_nifti(path: Path) -> None:
    """Raises `InputError` for a NIfTI file (by its name) that is damaged or holds values that are not finite.

    NIfTI-1 in one file or two; NIfTI-2 and Analyze are refused. Files of other names are passed.
    """
    if not path.name.lower().endswith(NIFTI_SUFFIXES):
        return
    _check_name(path)
    import nibabel  # takes a tenth of a second, beside the reading of images

    try:
        with quiet():
            image: Any = nibabel.load(path)  # its declared type is that of all formats, without voxels
            _check_kind(path, image)
            kind = image.get_data_dtype()
            there = None if path.name.lower().endswith((".hdr", ".img", ".img.gz")) else path.stat().st_size
            if not np.isfinite(image.affine).all():
                raise InputError(f"{path}: its origin or its axes are not finite. Export it anew.")
            stored = _as_stored(path, image)
            _check_sizes(path, image, stored)
            _check_places(path, image)
            _check_scale(path, stored)
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
        reason = " ".join(str(error).replace(str(path), path.name).split()).rstrip(".")[:200]
        raise InputError(f"{path}: cannot be read as NIfTI ({reason}). Export or download it anew.") from error
    if values.dtype.kind in "fc" and not np.isfinite(values).all():
        raise InputError(f"{path}: holds values that are not finite (NaN or infinite). Repair or export it anew.")


def _check_name(path: Path) -> None:
    """Raises `InputError` for a file that is compressed and whose name does not say so, or the other way round."""
    with opened(path) as file:
        head = file.read(4)
    named = path.suffix.lower() == ".gz"
    if head[:2] == _GZIP and not named:
        raise InputError(f"{path}: is compressed, and its name does not say so. Rename it to {path.name}.gz.")
    if named and head in _HEADER_SIZES:
        raise InputError(f"{path}: is not compressed, and its name says so. Rename it to {path.stem}.")


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


def _as_stored(path: Path, image: Any) -> Any:
    """The header (nibabel's) as it stands in the file: nibabel mends what it finds wrong, ITK takes it as it is."""
    kind = type(image.header)
    source = path.with_name(path.name[: -len(".img.gz")] + ".hdr.gz") if path.name.lower().endswith(".img.gz") else path
    source = source.with_suffix(".hdr") if source.suffix.lower() == ".img" else source
    with gzip.open(source) if source.suffix.lower() == ".gz" else opened(source) as file:
        return kind(file.read(kind.template_dtype.itemsize), endianness=image.header.endianness, check=False)


def _check_sizes(path: Path, image: Any, stored: Any) -> None:
    """Raises `InputError` where voxels have another size by `pixdim` than by the axes; programs differ in choice."""
    sized = [n for n, count in enumerate(image.shape[:3]) if count > 1]
    told = np.array(stored["pixdim"][1:4], float)[sized]
    if (told < 0).any():
        raise InputError(
            f"{path}: its header tells a negative size of voxels (pixdim {told.min():.4g}); programs differ in what "
            "they make of it. Export it anew."
        )
    axes = np.linalg.norm(image.affine[:3, :3], axis=0)[sized]
    apart = np.abs(told - axes) * np.array(image.shape)[sized]
    if not np.allclose(told, axes, rtol=_SAME_SIZE) or np.linalg.norm(apart) > _SAME_PLACE_MM:
        by = " and ".join(" × ".join(f"{mm:.4g}" for mm in sizes) for sizes in (told, axes))
        raise InputError(f"{path}: its header tells voxels of {by} mm, by pixdim and by its axes. Export it anew.")


def _check_places(path: Path, image: Any) -> None:
    """Raises `InputError` where sform and qform put the voxels to different places; programs differ in choice."""
    header = image.header
    if not (int(header["sform_code"]) and int(header["qform_code"])):
        return
    try:
        between = header.get_sform() - header.get_qform()
    except ValueError:  # a quaternion that is none, so that the sform counts
        return
    size = np.array([*image.shape[:3], 2]) - 1
    corners = np.array([[size[k] * (n >> k & 1) for k in range(3)] + [1] for n in range(8)])
    apart = float(np.linalg.norm((corners @ between.T)[:, :3], axis=1).max())
    if not apart <= _SAME_PLACE_MM:
        raise InputError(
            f"{path}: sform and qform of its header disagree by up to {apart:.1f} mm, and programs differ in which "
            "they take. Keep the one that landmarks, labels and plan were made with; in Python: x = nibabel.load(…); "
            "x.set_qform(x.get_sform(), 1), or x.set_sform(x.get_qform(), 1); nibabel.save(x, …)."
        )


def _check_scale(path: Path, stored: Any) -> None:
    """Raises `InputError` for an offset of values whose factor is zero: by the standard there is none, ITK adds it."""
    factor, offset = float(stored["scl_slope"]), float(stored["scl_inter"])
    if factor == 0 and np.isfinite(offset) and offset != 0:
        raise InputError(
            f"{path}: its header tells values to be scaled by 0 and {offset:g} to be added (scl_slope, scl_inter); "
            "programs differ in whether they add it. Export it anew."
        )


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
