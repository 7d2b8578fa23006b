"""Files of tensors follow the umask, and a full disk is told once."""

import errno
import os
import resource
from pathlib import Path

import pytest
import torch

from femoreg_torch.files import temporary_file, write_text
from femoreg_torch.tensors import read_tensors, write_tensors


@pytest.mark.parametrize("umask", [0o022, 0o027, 0o077, 0o002])
def test_who_may_read_it_is_as_for_all_other_files(tmp_path: Path, umask: int) -> None:
    before = os.umask(umask)
    try:
        with temporary_file(tmp_path / "a.safetensors") as part:
            write_tensors(part, {"a": torch.ones(3)}, {})
        write_text(tmp_path / "a.txt", "a")
    finally:
        os.umask(before)
    modes = [(tmp_path / name).stat().st_mode & 0o777 for name in ("a.safetensors", "a.txt")]
    assert modes == [0o666 & ~umask] * 2
    assert read_tensors(tmp_path / "a.safetensors")[1]["a"].equal(torch.ones(3))


def test_a_disk_without_room_is_told_by_number_and_name(tmp_path: Path) -> None:
    path = tmp_path / "a.safetensors"
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (4096, limits[1]))
    try:
        with pytest.raises(OSError, match="File too large") as caught, temporary_file(path) as part:
            write_tensors(part, {"a": torch.ones(100_000)}, {})
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert (caught.value.errno, caught.value.filename) == (errno.EFBIG, str(path))
    assert list(tmp_path.iterdir()) == []


def test_other_errors_pass(tmp_path: Path) -> None:
    with pytest.raises(OSError, match="no number in it"), temporary_file(tmp_path / "a.safetensors"):
        raise OSError("no number in it")
