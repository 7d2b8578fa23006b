"""Robust pose of an object from its landmarks in one image."""

from femoreg_torch.pnp.solve import PnpResult, solve_pnp

__all__ = ["PnpResult", "solve_pnp"]
