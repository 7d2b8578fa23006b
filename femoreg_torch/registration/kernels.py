"""Compiled kernels that are loaded beside something else, so that the first image does not wait for them."""

import functools

import numba
import torch

from femoreg_torch.drr import project, project_with_jacobian
from femoreg_torch.geometry import centred_camera
from femoreg_torch.similarity import GradNcc
from femoreg_torch.volume import Volume


@functools.cache
def load_kernels() -> None:
    """Once, draw a cube of two voxels and compare it with itself, by the kernels that a registration on the CPU uses.

    It is for a thread of its own, and uses one core.
    """
    numba.set_num_threads(1)
    camera = centred_camera(1000.0, (1.0, 1.0), (16, 16))
    cube = Volume(torch.ones(2, 2, 2), torch.eye(4, dtype=torch.float64))
    pose = torch.eye(4, dtype=torch.float64)
    pose[2, 3] = 900.0
    project(cube, pose[None], camera)
    images, jacobians = project_with_jacobian(cube, pose[None], camera, pose[:3, 3])
    similarity = GradNcc(patch_radius=1).against(images[0])
    similarity(images)
    similarity.quadratic(images[0], jacobians[0])
