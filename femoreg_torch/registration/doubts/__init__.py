"""What speaks against a result besides the quality of its objects, in words, with the limits that decide it."""

from femoreg_torch.registration.doubts.ask import doubts

__all__ = ["doubts"]
