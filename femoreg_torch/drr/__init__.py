"""Digitally reconstructed radiographs: line integrals of attenuation by one public operator, with several back ends."""

from femoreg_torch.drr.operator import project, project_with_jacobian

__all__ = ["project", "project_with_jacobian"]
