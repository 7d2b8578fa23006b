"""Grad-NCC's Triton kernels: through the interpreter and compiled everywhere, and on a GPU where there is one."""

import os
import subprocess
import sys
from pathlib import Path

import pytest
import torch

from femoreg_torch.similarity import GradNcc
from femoreg_torch.similarity.quadratic import similarity_quadratic

on_gpu = pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device here")


def test_kernels_through_the_interpreter() -> None:
    pytest.importorskip("triton")
    file = Path(__file__).with_name("interpreted_grad_ncc.py")
    run = subprocess.run(
        [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", str(file)],
        env=os.environ | {"TRITON_INTERPRET": "1"},
        capture_output=True,
        text=True,
        check=False,
        encoding="utf-8",
    )
    assert run.returncode == 0, run.stdout + run.stderr


_KERNELS = [
    "derivatives",
    "transposed_derivatives",
    "correlate",
    "spread_back",
    "shares",
    "cover",
    "patch_factors",
    "tile_sums",
]


@pytest.mark.parametrize("name", _KERNELS)
def test_kernels_compile_for_a_gpu(name: str) -> None:
    """Compiling needs no GPU; it finds what the interpreter lets pass, such as types that change within a loop."""
    triton = pytest.importorskip("triton")
    from triton.backends.compiler import GPUTarget

    from femoreg_torch.similarity import triton_kernels

    function = getattr(triton_kernels, name)
    float32 = ["images", "taps", "maps", "fixed", "of_mean", "of_along", "root", "changes", "totals", "along", "slope"]
    types = dict.fromkeys(float32, "*fp32") | dict.fromkeys(("scale", "weights", "parts", "factors"), "*fp64")
    # the mean of patches is double precision where it is one of the fixed image
    types |= {"mean": "*fp64" if name == "correlate" else "*fp32"}
    types |= {"out": "*fp64" if name == "tile_sums" else "*fp32", "floor": "fp32"}
    given = {"count": 7, "block": 128, "keep": True}
    constants = {name: value for name, value in given.items() if name in function.arg_names}
    signature = {name: types.get(name, "i32") for name in function.arg_names} | dict.fromkeys(constants, "constexpr")
    source = triton.compiler.ASTSource(function, signature, constants)
    assert triton.compile(source, target=GPUTarget("cuda", 80, 32)).asm["cubin"]


@on_gpu
@pytest.mark.parametrize("shape", [(96, 110), (384, 384), (23, 40)])
@pytest.mark.parametrize("similarity", [GradNcc(), GradNcc(patch_radius=2, smoothing_px=0), GradNcc(patch_radius=9)])
def test_a_gpu_has_the_costs_and_derivatives_of_the_cpu(shape: tuple[int, int], similarity: GradNcc) -> None:
    generator = torch.Generator().manual_seed(1)
    fixed, weights = (torch.rand(shape, generator=generator) for _ in range(2))
    fixed[: shape[0] // 2, : shape[1] // 3] = 0.25
    images = fixed + 0.5 * torch.rand((3, *shape), generator=generator)
    changes = torch.randn((*shape, 7), generator=generator)
    here, there = (similarity.against(fixed.to(place), weights.to(place)) for place in ("cpu", "cuda"))
    torch.testing.assert_close(there(images.cuda()).cpu(), here(images), rtol=1e-5, atol=1e-6)
    slopes = []
    for against, place in ((here, "cpu"), (there, "cuda")):
        moving = images.to(place, copy=True).requires_grad_()
        against(moving).square().sum().backward()
        assert moving.grad is not None
        slopes.append(moving.grad.cpu())
    assert float((slopes[1] - slopes[0]).norm() / slopes[0].norm()) < 1e-4
    expected = similarity_quadratic(here, images[0], changes)
    found = similarity_quadratic(there, images[0].cuda(), changes.cuda())
    assert found[0] == pytest.approx(expected[0], rel=1e-5)
    for ours, theirs in zip(found[1:], expected[1:], strict=True):
        assert float((ours - theirs).norm() / theirs.norm()) < 1e-3


@on_gpu
def test_a_gpu_finds_the_same_twice() -> None:
    generator = torch.Generator().manual_seed(2)
    fixed, image = torch.rand((2, 192, 192), generator=generator).cuda()
    changes = torch.randn((192, 192, 6), generator=generator).cuda()
    against = GradNcc().against(fixed)
    first, second = (against.quadratic(image, changes) for _ in range(2))
    assert all(torch.equal(one, other) for one, other in zip(first, second, strict=True))
