"""Review of a registration by a person, on a page that only this machine serves to itself."""

from femoreg_torch.review.desk import Desk
from femoreg_torch.review.kept import only_review
from femoreg_torch.review.running import Order
from femoreg_torch.review.server import LOOPBACK, review_app, serve

__all__ = ["LOOPBACK", "Desk", "Order", "only_review", "review_app", "serve"]
