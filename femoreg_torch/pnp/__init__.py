"""Robust pose of an object from its landmarks in one image."""

from femoreg_torch.pnp.solve import MINIMUM, PnpResult, solve_pnp

__all__ = ["MINIMUM", "PnpResult", "solve_pnp"]
