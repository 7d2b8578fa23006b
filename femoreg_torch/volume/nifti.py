"""What the NIfTI reader of ITK hides: it turns values that are not finite into zero, which as HU would be water."""

import gzip
from pathlib import Path

import numpy as np

_HEADER_BYTES = 348
_FLOATS = {16: "f4", 64: "f8"}  # NIfTI-1 datatype codes (nifti1.h)


def holds_non_finite(path: Path) -> bool:
    """True if `path` is a NIfTI-1 file of floating-point values of which some are NaN or infinite."""
    if not path.name.lower().endswith((".nii", ".nii.gz")):
        return False
    opener = gzip.open if path.name.lower().endswith(".gz") else open
    with opener(path, "rb") as file:
        header = file.read(_HEADER_BYTES)
        order = "<" if header[:4] == _HEADER_BYTES.to_bytes(4, "little") else ">"
        kind = _FLOATS.get(int(np.frombuffer(header, order + "i2", 1, offset=70)[0]))
        if kind is None:
            return False
        file.seek(int(np.frombuffer(header, order + "f4", 1, offset=108)[0]))
        content = file.read()
    values = np.frombuffer(content, order + kind, len(content) // int(kind[1]))
    return not np.isfinite(values).all()
