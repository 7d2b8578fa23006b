"""From a case on disk to the scene that is registered."""

from femoreg_torch.registration.prepare.scene import prepare_scene

__all__ = ["prepare_scene"]
