"""From a configuration to the network it describes."""

from models.reference import ReferenceUNet
from models.unet import UNet, UNetConfig

_ARCHITECTURES: dict[str, type[UNet] | type[ReferenceUNet]] = {"compact": UNet, "grupp2020": ReferenceUNet}


def make_network(config: UNetConfig) -> UNet | ReferenceUNet:
    """A new network with random weights. Raises `KeyError` for an architecture that is not one of ours."""
    return _ARCHITECTURES[config.architecture](config)
