"""A GPU that is none: tensors on the CPU that behave towards Python code as if they lay on a device.

All that Python code asks of torch passes through here. Tensors that were moved to the device, and what is computed of
them, are known by their storage. Tensors of two places do not meet, NumPy does not see those of the device, and every
call that would wait for a device is counted. The projector's kernels are stood in for by those of the CPU, or run
through Triton's interpreter.
"""

from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.multiprocessing.reductions import StorageWeakRef
from torch.overrides import TorchFunctionMode
from torch.utils._pytree import tree_leaves

from femoreg_torch.drr import cuda, operator
from femoreg_torch.geometry import Camera
from femoreg_torch.similarity import cuda as similarity_cuda
from femoreg_torch.similarity.grad_ncc import FixedGradNcc
from femoreg_torch.similarity.quadratic import tile_scores
from femoreg_torch.volume import Volume

Array = NDArray[np.float64]

# What looks at values, or at how many there are, and so waits until they are computed.
_WAITING = {
    "item",
    "tolist",
    "__bool__",
    "__float__",
    "__int__",
    "__index__",
    "nonzero",
    "argwhere",
    "masked_select",
    "unique",
    "equal",
    "allclose",
    "bincount",
    "linalg_eigh",
    "linalg_inv",
    "linalg_pinv",
    "linalg_solve",
    "linalg_cholesky",
}
_TO_PYTHON = {"item", "tolist", "__bool__", "__float__", "__int__", "__index__"}
_NUMPY = {"numpy", "__array__"}
DEVICE = torch.device("cuda", 0)


class PretendedGpu(TorchFunctionMode):
    """See above. `waits` counts by the name of what waited."""

    def __init__(self) -> None:
        super().__init__()
        self.waits: Counter[str] = Counter()
        self._there: dict[int, StorageWeakRef] = {}

    def holds(self, tensor: Tensor) -> bool:
        """Whether a tensor lies on the device."""
        with torch._C.DisableTorchFunction():
            known = self._there.get(_storage(tensor)._cdata)
        return known is not None and not known.expired()

    def take(self, found: Any) -> Any:
        """The same, with all its tensors on the device."""
        with torch._C.DisableTorchFunction():
            for tensor in tree_leaves(found):
                if isinstance(tensor, Tensor):
                    reference = StorageWeakRef(_storage(tensor))
                    self._there[reference.cdata] = reference
        return found

    def __torch_function__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        kwargs = dict(kwargs or {})
        name = getattr(func, "__name__", "")
        first = args[0] if args and isinstance(args[0], Tensor) else None
        if first is not None and name == "__get__":
            if func == Tensor.device.__get__:
                return DEVICE if self.holds(first) else func(*args, **kwargs)
            if func == Tensor.is_cuda.__get__:
                return self.holds(first)
        if first is not None and name in ("to", "cpu", "cuda"):
            return self._move(func, name, first, args[1:], kwargs)
        tensors = [leaf for leaf in tree_leaves((args, kwargs)) if isinstance(leaf, Tensor)]
        there = [tensor for tensor in tensors if self.holds(tensor)]
        target = kwargs.get("device")
        if target is not None:
            kwargs["device"] = "cpu"
        if there and name in _NUMPY:
            raise TypeError("can't convert cuda:0 device type tensor to numpy")
        if there and name not in ("__get__", "__set__", "_has_compatible_shallow_copy_type"):  # the last: `Module.to`
            apart = [tensor for tensor in tensors if tensor.ndim and not self.holds(tensor)]
            if apart:
                raise RuntimeError(f"{name}: tensors on two devices, {[tuple(t.shape) for t in tensors]}")
            if name in _WAITING or (name == "__getitem__" and _masked(args[1])):
                self.waits[name] += 1
        found = func(*args, **kwargs)
        on_device = bool(there) if target is None else torch.device(target).type == "cuda"
        if target is not None and on_device and name in ("tensor", "as_tensor", "new_tensor"):
            self.waits["upload"] += 1
        if name == "__get__" and first is not None and isinstance(found, Tensor):
            on_device = self.holds(first)
        return self.take(found) if on_device and name not in _TO_PYTHON else found

    def _move(self, func: Any, name: str, tensor: Tensor, args: Any, kwargs: dict[str, Any]) -> Tensor:
        before = self.holds(tensor)
        after = {"cpu": False, "cuda": True, "to": before}[name]
        others: list[Any] = []
        flags = [value for value in args if isinstance(value, bool)]  # non_blocking, copy
        args = [value for value in args if not isinstance(value, bool)]
        for value in (*args, *(kwargs.pop(key) for key in ("device", "other") if key in kwargs)):
            if isinstance(value, str | torch.device):
                after = torch.device(value).type == "cuda"
            elif isinstance(value, Tensor):
                after = self.holds(value)
                others.append(value.dtype)
            elif value is not None:
                others.append(value)
        waits = not kwargs.pop("non_blocking", any(flags[:1])) or before
        moved: Tensor = Tensor.to(tensor, *others, **kwargs) if others or kwargs else tensor
        if before == after:
            return self.take(moved) if after else moved
        if waits:
            self.waits["download" if before else "upload"] += 1
        moved = moved.clone() if _storage(moved)._cdata == _storage(tensor)._cdata else moved
        return self.take(moved) if after else moved


def _storage(tensor: Tensor) -> torch.UntypedStorage:
    """Where a tensor's values lie; of a sparse one, those that are no zeros."""
    return (tensor.values() if tensor.layout == torch.sparse_csr else tensor).untyped_storage()


def _masked(index: Any) -> bool:
    entries = index if isinstance(index, tuple) else (index,)
    return any(isinstance(entry, Tensor) and entry.dtype == torch.bool for entry in entries)


@contextmanager
def pretended_gpu(monkeypatch: pytest.MonkeyPatch, interpreted: bool = False) -> Iterator[PretendedGpu]:
    """A machine with a GPU whose kernels are the CPU's, or, `interpreted`, go through Triton's interpreter."""
    gpu = PretendedGpu()

    def through_the_interpreter(launch: Any) -> Any:
        def interpret(*arguments: Any, **constants: Any) -> None:
            with torch._C.DisableTorchFunction():
                launch(*arguments, **constants)

        return interpret

    def on_the_cpu(compiled: Any) -> Any:
        """A function of tensors on the device, done by one of the CPU."""

        def stand_in(*arguments: Any) -> Any:
            tensors = [leaf for leaf in tree_leaves(arguments) if isinstance(leaf, Tensor)]
            assert all(gpu.holds(tensor) for tensor in tensors)
            with torch._C.DisableTorchFunction():
                return gpu.take(compiled(*arguments))

        return stand_in

    def project(volume: Volume, affines: Tensor, camera: Camera, offsets: Tensor, step_mm: float) -> Tensor:
        assert gpu.holds(volume.data)
        assert gpu.holds(affines) == gpu.holds(offsets)
        with torch._C.DisableTorchFunction():
            image = operator._CpuProjection.apply(volume.data, affines, offsets, volume, camera, step_mm)
        return gpu.take(image)

    def jacobian(
        volume: Volume, affines: Array, changes: Array, rates: Array, camera: Camera, offsets: Array, step_mm: float
    ) -> tuple[Tensor, Tensor]:
        assert gpu.holds(volume.data)
        with torch._C.DisableTorchFunction():
            found = operator._with_derivatives(volume, affines, changes, rates, camera, offsets, step_mm)
        return gpu.take(found)

    def grad_ncc(images: Tensor, similarity: FixedGradNcc) -> Tensor:
        return 1 - similarity(images)

    def grad_ncc_and_gradient(images: Tensor, similarity: FixedGradNcc) -> tuple[Tensor, Tensor]:
        costs, slopes = zip(*(similarity._with_slope(image) for image in images), strict=True)
        return 1 - torch.stack(costs), -torch.cat(slopes)

    def curvature(image: Tensor, changes: Tensor, similarity: FixedGradNcc, stride: int) -> Tensor:
        return similarity.curvature(image, changes, stride)

    def tile_sums(changes: Tensor, slope: Tensor, tile: int) -> Tensor:
        return tile_scores(changes, slope[None], tile).T

    monkeypatch.setattr(cuda, "why_no_kernels", lambda device: None)
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    if interpreted:
        for module in (cuda, similarity_cuda):
            monkeypatch.setattr(module, "_launch", through_the_interpreter(module._launch))
    else:
        monkeypatch.setattr(cuda, "project", project)
        monkeypatch.setattr(cuda, "jacobian", jacobian)
        for stand_in in (grad_ncc, grad_ncc_and_gradient, curvature, tile_sums):
            monkeypatch.setattr(similarity_cuda, stand_in.__name__, on_the_cpu(stand_in))
    with gpu:
        yield gpu
