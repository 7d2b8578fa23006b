"""Where a command computes: on the CPU, or on the first GPU, as `--device` says."""

from typing import Literal

import torch

from femoreg_torch.drr import cuda
from femoreg_torch.errors import InputError

CPU = torch.device("cpu")
DeviceName = Literal["cpu", "cuda", "auto"]


def chosen_device(name: DeviceName) -> torch.device:
    """The device of a name; `auto` takes a GPU where there is one that the projector's kernels run on, else the CPU.

    Raises `InputError` for `cuda` where that is not so, with the reason.
    """
    reason = None if name == "cpu" else why_no_gpu()
    if name == "cuda" and reason is not None:
        raise InputError(f"--device cuda: {reason}. Take --device cpu, or see what `femoreg doctor` says.")
    return CPU if name == "cpu" or reason is not None else torch.device("cuda")


def why_no_gpu() -> str | None:
    """Why this machine cannot compute on a GPU, in one line; None if it can."""
    if not torch.cuda.is_available():
        found = (("CUDA", torch.version.cuda), ("ROCm", torch.version.hip))
        built = [f"{name} {version}" for name, version in found if version]
        return f"torch is built for {built[0]}, but sees no GPU" if built else "this torch is built for the CPU alone"
    return cuda.why_no_kernels(torch.device("cuda"))


def told(device: torch.device) -> str:
    """The device in words."""
    if device.type == "cpu":
        return f"the CPU, {torch.get_num_threads()} threads"
    return torch.cuda.get_device_name(device)
