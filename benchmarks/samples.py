"""How many samples the projector takes: counted where the kernels would take them, without a change to the kernels."""

import tempfile
from collections import Counter
from pathlib import Path
from threading import Lock
from typing import Any

import numba as nb
import numpy as np

from femoreg_torch.drr import cpu
from femoreg_torch.drr.bricks import BrickedVolume
from femoreg_torch.geometry.camera import Camera


@nb.njit(cache=True)
def _count(leap, shape, affines, detector, offsets, step, edges, rows, columns):  # type: ignore[no-untyped-def]
    """Samples of all rays of all poses, walked in packets as `femoreg_torch.drr.cpu` does."""
    starts, ends = np.empty(cpu._MOST_RUNS, np.int64), np.empty(cpu._MOST_RUNS, np.int64)
    total = 0
    for pose in range(len(affines)):
        affine, edge = affines[pose], edges[pose]
        first_top = cpu._first_packet(detector[4], edge)
        first_left = cpu._first_packet(detector[3], edge)
        for top in range(first_top, rows, edge):
            for left in range(first_left, columns, edge):
                middle_row, middle_column = top + (edge - 1) / 2, left + (edge - 1) / 2
                _, _, _, dx, dy, dz = cpu._ray(affine, detector, middle_row, middle_column)
                n = cpu._runs(leap, shape, offsets[pose], step, affine[:, 3], dx, dy, dz, starts, ends)
                along = 0
                for i in range(n):
                    along += ends[i] - starts[i]
                rays = (min(top + edge, rows) - max(top, 0)) * (min(left + edge, columns) - max(left, 0))
                total += along * rays
    return total


def samples(volume: BrickedVolume, affines: cpu.Array, camera: Camera, offsets: cpu.Array, step_mm: float) -> int:
    """Samples that `cpu.projection` takes of a volume."""
    edges, padded = cpu._packet_edges(volume, affines, camera), cpu._padded_affines(affines)
    shape = volume.padded.shape
    return int(_count(volume.leap, shape, padded, cpu._detector(camera), offsets, step_mm, edges, *camera.shape))


def samples_of_a_registration(case: Path) -> dict[str, int]:
    """Samples of `femoreg register` by what it reports, in a process that is used for nothing else."""
    from femoreg_torch.case import read_case
    from femoreg_torch.commands.register import register_into

    found: Counter[str] = Counter()
    part, one_at_a_time = "before", Lock()

    def report(step: str, share: float) -> None:
        nonlocal part
        part = "quality" if step == "done" else step

    def counting(kernel: Any) -> Any:
        def counted(*arguments: Any) -> Any:
            taken = samples(*arguments)
            with one_at_a_time:
                found[part] += taken
            return kernel(*arguments)

        return counted

    cpu.projection, cpu.projection_with_moments = counting(cpu.projection), counting(cpu.projection_with_moments)
    with tempfile.TemporaryDirectory() as folder:
        register_into(Path(folder) / "run", read_case(case), "fast", 0, report=report)
    return dict(found)
