"""Digitally reconstructed radiographs: one public operator, back ends behind it."""

from femoreg_torch.drr.operator import project, project_with_jacobian

__all__ = ["project", "project_with_jacobian"]
