"""What a person has placed, kept beside the run until it is registered: files that `femoreg register` takes, too.

`RUN.landmarks.csv` is for `--landmarks`, `RUN.start.json` for `--start`. So nothing is lost when the review is stopped.
One review at a time keeps them.
"""

import csv
import fcntl
import io
import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from femoreg_torch.case import Case
from femoreg_torch.case.start_files import COLUMNS, read_pixels, read_start_poses
from femoreg_torch.errors import InputError
from femoreg_torch.files import write_json, write_text
from femoreg_torch.registration import Scene
from femoreg_torch.review.placing import Placed, as_stored, at_given, in_camera


@contextmanager
def only_review(run: Path) -> Iterator[None]:
    """Raises `InputError` while another process reviews the same run.

    The system takes the lock from a process that ends, however it ends. A file system without locks lets all in.
    """
    run = run.resolve()
    run.parent.mkdir(parents=True, exist_ok=True)
    path = run.with_name(f".{run.name}.review")
    while True:
        lock = os.open(path, os.O_RDWR | os.O_CREAT, 0o600)
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            os.close(lock)
            raise InputError(
                f"{run}: is being reviewed by another `femoreg review`. Go on there, or end it."
            ) from error
        except OSError:  # no locks here
            break
        with suppress(FileNotFoundError):
            if os.path.samestat(path.stat(), os.fstat(lock)):
                break
        os.close(lock)  # of one that ended just now and took its file away
    try:
        yield
    finally:
        path.unlink(missing_ok=True)
        os.close(lock)


def landmarks_path(run: Path) -> Path:
    """The file of the landmarks, for `--landmarks`."""
    return run.with_name(f"{run.name}.landmarks.csv")


def start_path(run: Path) -> Path:
    """The file of the objects' poses, for `--start`."""
    return run.with_name(f"{run.name}.start.json")


def keep_landmarks(run: Path, case: Case, placed: Placed) -> None:
    """Write the landmarks, in pixels of the image as stored; no file where there are none."""
    if not placed.landmarks:
        landmarks_path(run).unlink(missing_ok=True)
        return
    text = io.StringIO()
    rows = csv.writer(text, lineterminator="\n")
    rows.writerow(COLUMNS)
    for name, (column, row) in as_stored(case, placed.landmarks).items():
        rows.writerow([name, f"{column:.3f}", f"{row:.3f}"])
    run.parent.mkdir(parents=True, exist_ok=True)
    write_text(landmarks_path(run), text.getvalue())


def keep_poses(run: Path, placed: Placed) -> None:
    """Write the poses of all objects."""
    run.parent.mkdir(parents=True, exist_ok=True)
    write_json(start_path(run), {f"camera1_from_{n}": pose for n, pose in placed.poses.camera1_from.items()})


def with_kept(run: Path, case: Case, scene: Scene, placed: Placed) -> Placed:
    """With what an earlier review kept, if it did. Raises `InputError` for a file that is something else."""
    if start_path(run).exists():
        placed = at_given(scene, placed, read_start_poses(start_path(run)), str(start_path(run)))
    if landmarks_path(run).exists():
        pixels = {name: (float(p[0]), float(p[1])) for name, p in read_pixels(landmarks_path(run)).items()}
        known = {name: pixel for name, pixel in pixels.items() if name in case.landmarks}
        placed = Placed(in_camera(case, known), placed.poses, placed.views)
    return placed


def forget(run: Path) -> None:
    """Remove what was kept."""
    landmarks_path(run).unlink(missing_ok=True)
    start_path(run).unlink(missing_ok=True)
