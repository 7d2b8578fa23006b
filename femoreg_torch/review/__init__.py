"""Review of a registration by a person, on a page that only this machine serves to itself."""

from femoreg_torch.review.server import review_app, serve

__all__ = ["review_app", "serve"]
