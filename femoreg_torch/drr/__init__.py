"""Digitally reconstructed radiographs: line integrals of attenuation by one public operator, with several back ends."""

from femoreg_torch.drr.device import CPU, DeviceName, chosen_device
from femoreg_torch.drr.operator import project, project_with_jacobian

__all__ = ["CPU", "DeviceName", "chosen_device", "project", "project_with_jacobian"]
