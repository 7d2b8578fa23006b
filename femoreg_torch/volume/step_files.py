"""STEP files (ISO 10303-21), the exchange format of CAD programs: solids with names become triangles."""

import subprocess
import sys
import tempfile
from importlib.util import find_spec
from pathlib import Path

from femoreg_torch.errors import InputError
from femoreg_torch.extras import extra_of

STEP_SUFFIXES = (".step", ".stp")
_TOLERANCE_MM, _TOLERANCE_RAD = 0.01, 0.1  # of triangles from a curved surface: far below what an image can tell
_LONGEST_S = 120.0  # a sleeve with a handle takes a second
_CONVERT = (  # runs by itself: OpenCASCADE ends the whole process on many a damaged file
    "import sys; from pathlib import Path; import cascadio; "
    "found = cascadio.load(Path(sys.argv[1]).read_bytes(), 'step', "
    "tol_linear=float(sys.argv[3]), tol_angular=float(sys.argv[4])); "
    "Path(sys.argv[2]).write_bytes(found)"
)


def glb_of_step(path: Path) -> bytes:
    """The solids of a STEP file as a GLB file in metres, each under the name that it has in its assembly.

    The unit that the file names is heeded. Raises `InputError` if the package that reads STEP is missing, or the file
    cannot be read.
    """
    if find_spec("cascadio") is None:
        raise InputError(
            f"{path}: STEP files need the package cascadio: pip install 'femoreg-torch[{extra_of('cascadio')}]'. "
            "Or export it as STL, or as 3MF if it has several bodies."
        )
    with tempfile.TemporaryDirectory() as folder:
        made = Path(folder) / "made.glb"
        command = [sys.executable, "-c", _CONVERT, str(path), str(made), str(_TOLERANCE_MM), str(_TOLERANCE_RAD)]
        try:
            ended = subprocess.run(command, capture_output=True, timeout=_LONGEST_S, check=False).returncode
        except subprocess.TimeoutExpired as error:
            raise InputError(
                f"{path}: took more than {_LONGEST_S:g} s to read. Export it as STL, or less of it."
            ) from error
        glb = made.read_bytes() if ended == 0 and made.exists() else b""
    if not glb:
        raise InputError(f"{path}: cannot be read as STEP: it is damaged, cut off, or holds no solid. Export it anew.")
    return glb
