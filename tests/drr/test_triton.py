"""The CUDA back end: its kernels through Triton's interpreter anywhere, for real where there is a GPU."""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from drr_scenes import DEVIATING_CAMERA, centred, float64, random_poses, relative_error, smooth, sparse
from torch import Tensor

from femoreg_torch.drr import cuda, device_bricks, project, project_with_jacobian
from femoreg_torch.drr.bricks import bricked
from femoreg_torch.drr.device_bricks import bricked_on_device
from femoreg_torch.errors import InputError
from femoreg_torch.geometry import Camera
from femoreg_torch.volume.grid import Volume

on_gpu = pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device here")


def test_kernels_through_the_interpreter():
    pytest.importorskip("triton")
    scenes = Path(__file__).with_name("interpreted_kernels.py")
    run = subprocess.run(
        [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", str(scenes)],
        env=os.environ | {"TRITON_INTERPRET": "1"},
        capture_output=True,
        text=True,
        check=False,
        encoding="utf-8",
    )
    assert run.returncode == 0, run.stdout + run.stderr


@pytest.mark.parametrize("kernel", ["forward", "pose_gradient", "jacobian", "volume_gradient"])
def test_kernels_compile_for_a_gpu(kernel):
    """Compiling needs no GPU; it finds what the interpreter lets pass, such as types that change within a loop."""
    triton = pytest.importorskip("triton")
    from triton.backends.compiler import GPUTarget

    from femoreg_torch.drr import triton_kernels

    function = getattr(triton_kernels, kernel)
    pointers = dict.fromkeys(("affines", "geometry", "offsets", "parts", "changes", "rates"), "*fp64")
    pointers |= dict.fromkeys(("image", "upstream", "out", "gradient"), "*fp32")
    pointers |= {"volume": "*fp16", "leap": "*u8", "tile": "constexpr"}
    signature = {name: pointers.get(name, "i32") for name in function.arg_names}
    source = triton.compiler.ASTSource(function, signature, {"tile": cuda.TILE})
    options = {"num_warps": cuda.WARPS, "enable_fp_fusion": True}
    compiled = triton.compile(source, target=GPUTarget("cuda", 80, 32), options=options)
    assert compiled.asm["cubin"]


@pytest.mark.parametrize("shape", [(1, 1, 1), (17, 40, 23), (30, 8, 64)])
@pytest.mark.parametrize("share", [0.0002, 0.01])
def test_the_map_made_by_torch_is_the_one_made_by_scipy(shape, share):
    data = sparse(shape, torch.Generator().manual_seed(0), share)
    data[0, 0, -1] = 1.0
    ours, theirs = bricked_on_device(centred(data)), bricked(centred(data))
    np.testing.assert_array_equal(ours.padded.numpy(), theirs.padded)
    np.testing.assert_array_equal(ours.leap.numpy(), theirs.leap)


def test_a_volume_is_bricked_once_and_again_when_its_data_change():
    volume = centred(torch.ones(4, 4, 4))
    first = bricked_on_device(volume)
    assert bricked_on_device(volume) is first
    volume.data.mul_(2)
    assert bricked_on_device(volume).padded.max() == 2


def test_data_made_under_inference_mode_are_refused():
    with torch.inference_mode():
        volume = centred(torch.ones(4, 4, 4))
        with pytest.raises(InputError, match="no_grad"):
            bricked_on_device(volume)


def test_an_empty_volume_is_leapt_over_from_wherever_a_ray_enters():
    leap = bricked_on_device(centred(torch.zeros(20, 30, 40))).leap
    assert (leap >= min(max(leap.shape), device_bricks._FARTHEST)).all()


def test_why_not_names_the_reason(monkeypatch):
    assert "cpu" in cuda.why_not(centred(torch.ones(2, 2, 2)))
    cuda._no_triton.cache_clear()
    with monkeypatch.context() as patch:
        patch.setitem(sys.modules, "triton", None)
        assert cuda._no_triton() == "Triton is not installed"
    cuda._no_triton.cache_clear()
    assert "voxels" in cuda._too_large(centred(torch.empty(1, 1, 1).expand(1300, 1300, 1300)))


# On a GPU ------------------------------------------------------------------------------------------------------------
def on_cuda(volume: Volume, dtype: torch.dtype = torch.float32) -> Volume:
    return volume.with_data(volume.data.to("cuda", dtype))


def scene(seed: int = 0) -> tuple[list[Volume], Tensor, Camera]:
    """A sparse and a dense volume of 120 voxels and more along an edge, four poses, a detector of 96 × 110."""
    generator = torch.Generator().manual_seed(seed)
    volumes = [
        centred(sparse((120, 130, 140), generator, 0.0005), (1.1, 0.9, 1.5), (0.3, 0.1, -0.2)),
        centred(smooth((300, 60, 50), generator), (0.6, 1.0, 1.0)),
    ]
    return volumes, random_poses(4, 2, generator, z_mm=600), Camera(1020.0, (2.5, 2.2), (96, 110), (50.2, 51.7))


@on_gpu
def test_cuda_agrees_with_the_cpu_on_images_and_gradients():
    volumes, poses, camera = scene()
    weights = torch.randn(4, *camera.shape, generator=torch.Generator().manual_seed(1))
    results = []
    for move, device in ((lambda volume: volume, "cpu"), (on_cuda, "cuda")):
        moving = poses.to(device, copy=True).requires_grad_()
        moved = [move(volume) for volume in volumes]
        moved = [volume.with_data(volume.data.clone().requires_grad_()) for volume in moved]
        image = project(moved, moving, camera)
        (image * weights.to(device)).sum().backward()
        results.append([t.detach().cpu().double() for t in (image, moving.grad, *(v.data.grad for v in moved))])
    # The slope jumps from voxel to voxel, and random weights leave little of its sum: on the CPU, poses 1e-5 mm aside
    # have gradients by these that are 1 % off, as one sample lies on the other side of a plane of the grid.
    tolerances = [1e-4, 0.03, 1e-4, 1e-4]
    for ours, theirs, tolerance in zip(results[1], results[0], tolerances, strict=True):
        assert relative_error(ours, theirs) < tolerance


@on_gpu
def test_cuda_agrees_with_the_cpu_on_the_jacobian_image():
    volumes, poses, camera = scene()
    centre = float64(3.0, -8.0, 610.0)
    expected = project_with_jacobian(volumes[1], poses[:, 1], camera, centre)
    found = project_with_jacobian(on_cuda(volumes[1]), poses[:, 1].cuda(), camera, centre.cuda())
    for ours, theirs in zip(found, expected, strict=True):
        assert relative_error(ours.cpu().flatten(0, 2).T, theirs.double().flatten(0, 2).T) < 3e-4


@on_gpu
@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float16, 5e-4), (torch.bfloat16, 4e-3)])
def test_cuda_in_half_precision(dtype, tolerance):
    volumes, poses, camera = scene()
    expected = project(volumes, poses, camera).double()
    found = project([on_cuda(volume, dtype) for volume in volumes], poses.cuda(), camera)
    assert found.dtype == torch.float32
    assert relative_error(found.cpu(), expected) < tolerance


@on_gpu
def test_cuda_pose_gradients_agree_bit_for_bit():
    volumes, poses, camera = scene()
    moved = [on_cuda(volume) for volume in volumes]
    gradients = []
    for _ in range(2):
        moving = poses.cuda().requires_grad_()
        project(moved, moving, camera).square().sum().backward()
        gradients.append(moving.grad)
    assert torch.equal(*gradients)


@on_gpu
def test_cuda_never_waits_for_the_device():
    volumes, poses, camera = scene()
    moved, moving = [on_cuda(volume) for volume in volumes], poses.cuda().requires_grad_()
    weights = torch.rand(4, *camera.shape, device="cuda")
    torch.cuda.set_sync_debug_mode("error")
    try:
        project(moved, moving, camera).backward(weights)
        project(moved, poses, camera)
        project_with_jacobian(moved[0], poses[:, 0], camera, float64(0, 0, 600))
    finally:
        torch.cuda.set_sync_debug_mode("default")


@on_gpu
def test_cuda_without_triton_warns_and_marches(monkeypatch):
    monkeypatch.setattr(cuda, "why_not", lambda volume: "no Triton in this test")
    volume, pose, camera = (
        on_cuda(centred(torch.ones(9, 9, 9))),
        random_poses(1, 1, torch.Generator()),
        DEVIATING_CAMERA,
    )
    with pytest.warns(UserWarning, match="no Triton in this test"):
        image = project([volume], pose.cuda(), camera)
    expected = project([centred(torch.ones(9, 9, 9))], pose, camera)
    assert relative_error(image.cpu(), expected.double()) < 1e-3
    with pytest.raises(InputError, match="no Triton in this test"):
        project_with_jacobian(volume, pose[:, 0].cuda(), camera, float64(0, 0, 600))
