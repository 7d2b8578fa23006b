"""The public names of `import femoreg_torch`."""

import subprocess
import sys

import pytest

import femoreg_torch as femoreg


def test_every_public_name_is_there_and_listed() -> None:
    names = [name for name in dir(femoreg) if not name.startswith("_")]
    assert {"read_case", "register", "project", "Volume", "Camera", "CArm", "load_carm", "evaluate", "Stage"} <= set(
        names
    )
    for name in names:
        assert getattr(femoreg, name) is not None, name


def test_another_name_is_none_of_them() -> None:
    with pytest.raises(AttributeError, match="no attribute 'registre'"):
        femoreg.registre  # noqa: B018


def test_importing_the_package_loads_nothing_heavy() -> None:
    code = (
        "import sys, femoreg_torch; print(sorted({'torch', 'numba', 'SimpleITK', 'cv2', 'scipy'} & set(sys.modules)))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, encoding="utf-8", check=True)
    assert done.stdout.strip() == "[]"
