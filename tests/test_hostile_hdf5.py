"""HDF5 files that are not what they say: one line that names file and entry, nothing large is allocated, no hang."""

import os
import signal
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from femoreg_torch.commands.main import main
from femoreg_torch.errors import InputError
from femoreg_torch.geometry import centred_camera
from femoreg_torch.hdf5 import open_hdf5
from femoreg_torch.neighbours.deepfluoro import is_full_resolution, read_preprocessed

DETECTOR = centred_camera(1020.0, (0.4, 0.4), (820, 820))


def preprocessed(path: Path) -> Path:
    """A file in the layout of the preprocessed DeepFluoro data, with two pictures and a landmark."""
    with h5py.File(path, "w") as file:
        file["land-names/num-lands"], file["land-names/land-00"] = 1, "FH-l"
        file["01/projs"] = np.ones((2, 45, 45), np.float32)
        file["01/segs"], file["01/lands"] = np.zeros((2, 45, 45), np.uint8), np.full((2, 2, 1), np.inf)
    return path


def put(name: str, **what: Any) -> Callable[[h5py.File], None]:
    """Another data set in the place of `name`."""

    def change(file: h5py.File) -> None:
        del file[name]
        file.create_dataset(name, **what)

    return change


def loop(file: h5py.File) -> None:
    del file["01/segs"]
    file["01/segs"] = h5py.SoftLink("/01/segs")


def group(file: h5py.File) -> None:
    del file["01/projs"]
    file.create_group("01/projs")


def cases() -> Iterator[tuple[str, Callable[[h5py.File], None], str]]:
    yield "a link to itself", loop, "01/segs"
    yield "a group for a data set", group, "01/projs"
    yield "a word", put("01/projs", data="x"), "01/projs"
    yield "an empty one", put("01/projs", data=h5py.Empty("f")), "is empty"
    yield "records", put("01/projs", data=np.zeros((1, 1, 1), [("a", "i4")])), "numbers with 3 axes"
    yield "no picture", put("01/projs", data=np.zeros((0, 45, 45))), "numbers with 3 axes"
    yield "two axes", put("01/projs", data=np.zeros((45, 45))), "numbers with 3 axes"
    yield "larger than the detector", put("01/projs", data=np.zeros((2, 45, 99))), "shape of"
    yield "nan", put("01/projs", data=np.full((2, 45, 45), np.nan)), "finite numbers"
    yield "claims 2**60 values", put("01/projs", shape=(2, 2**29, 2**30), dtype="f4", chunks=True), "shape of"
    yield "in another file", put("01/projs", shape=(2, 45, 45), dtype="f4", external=[("x", 0, 16200)]), "other files"
    yield "labels of another shape", put("01/segs", data=np.zeros((2, 44, 45), np.uint8)), "01/segs"
    yield "landmarks of another number", put("01/lands", data=np.zeros((2, 2, 7))), "01/lands"
    yield "half a landmark", put("land-names/num-lands", data=0.5), "whole number"
    yield "2**62 landmarks", put("land-names/num-lands", data=2**62), "whole number from 0 to 99"
    yield "a name that is no text", put("land-names/land-00", data=b"\xff\xfe"), "land-names/land-00"


@pytest.mark.parametrize(("change", "says"), [pytest.param(c, s, id=name) for name, c, s in cases()])
def test_what_is_not_there_or_another_thing(change: Callable[[h5py.File], None], says: str, tmp_path: Path) -> None:
    path = preprocessed(tmp_path / "ds.h5")
    assert len(list(read_preprocessed(path, DETECTOR))) == 2
    with h5py.File(path, "a") as file:
        change(file)
    with pytest.raises(InputError, match=str(path)) as raised:
        list(read_preprocessed(path, DETECTOR))
    assert says in str(raised.value)
    assert "\n" not in str(raised.value)


def test_pictures_that_are_no_grid_on_the_detector(tmp_path: Path) -> None:
    path = preprocessed(tmp_path / "ds.h5")
    with pytest.raises(InputError, match="no coarser grid on 20 × 20"):
        list(read_preprocessed(path, centred_camera(1020.0, (0.4, 0.4), (120, 120))))


def test_a_claim_is_compared_with_the_file_before_it_is_read(tmp_path: Path) -> None:
    path = tmp_path / "a.h5"
    with h5py.File(path, "w") as file:
        file.create_dataset("vast", (2**20, 2**20), "f4", chunks=True)
        file.create_dataset("long", (2**27,), "f8", chunks=True)
    with open_hdf5(path) as file:
        for name, axes in (("vast", 2), ("long", 1)):
            with pytest.raises(InputError, match=r"voxels are more than|cannot hold"):
                file.numbers(name, axes)


def test_numbers_come_as_they_are_stored(tmp_path: Path) -> None:
    path = tmp_path / "a.h5"
    stored = {
        "big": np.arange(12, dtype=">i2").reshape(3, 4),
        "half": np.array([[0.5, -2.0]], np.float16),
        "truth": np.array([[True, False]]),
        "packed": np.arange(10_000.0).reshape(100, 100),
    }
    with h5py.File(path, "w") as file:
        for name, values in stored.items():
            file.create_dataset(name, data=values, compression="gzip" if name == "packed" else None)
    with open_hdf5(path) as read:
        for name, values in stored.items():
            found = read.numbers(name, 2)
            assert found.dtype == values.dtype
            assert (found == values).all()
            assert (read.numbers(name, 2, at=0) == values[0]).all()


def test_a_text_that_the_library_follows_for_ever(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    """The heap of texts says that its free space has the size 0, so that the library looks there for ever."""
    path = preprocessed(tmp_path / "ds.h5")
    content = path.read_bytes()
    heap = content.index(b"GCOL")
    path.write_bytes(content[: heap + 32] + bytes(24) + content[heap + 56 :])
    began = time.perf_counter()
    assert main(["measure", str(path), "--out", str(tmp_path / "out")]) == 2
    assert time.perf_counter() - began < 20  # 3 s of the processor's
    told = capfd.readouterr().err
    assert "comes to no end" in told
    assert told.count("\n") == 1


def test_a_reader_that_dies_is_a_refused_file(tmp_path: Path) -> None:
    """As it would by a crash of the library."""

    def children() -> set[str]:
        return set(Path(f"/proc/self/task/{os.getpid()}/children").read_text(encoding="utf-8").split())

    others = children()  # of tests before
    with open_hdf5(preprocessed(tmp_path / "ds.h5")) as file:
        assert file.names("/") == ["01", "land-names"]
        (child,) = children() - others
        os.kill(int(child), signal.SIGSEGV)
        with pytest.raises(InputError, match="crashes on it"):
            file.names("/")


@pytest.mark.parametrize("cut", [0, 8, 100, 1000, -100])
def test_a_file_cut_off(cut: int, tmp_path: Path) -> None:
    path = preprocessed(tmp_path / "ds.h5")
    path.write_bytes(path.read_bytes()[:cut])
    with pytest.raises(InputError, match=r"ds\.h5"):
        is_full_resolution(path)


def test_a_data_set_without_a_picture_is_one_line(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    path = preprocessed(tmp_path / "ds.h5")
    with h5py.File(path, "a") as file:
        del file["01"]
    assert main(["measure", str(path), "--out", str(tmp_path / "out")]) == 2
    told = capfd.readouterr().err
    assert "no image" in told
    assert told.count("\n") == 1
    assert not (tmp_path / "out").exists()
