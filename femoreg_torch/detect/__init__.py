"""Finding bones and landmarks in a fluoroscopic image."""

from femoreg_torch.detect.decode import decode_heatmaps
from femoreg_torch.detect.field import as_stored, filled, within_field
from femoreg_torch.detect.grid import image_from_network, network_camera, to_network_grid
from femoreg_torch.detect.network import Detection, detect
from femoreg_torch.detect.normalise import normalise
from femoreg_torch.detect.weights import LandmarkNetwork, load_network, weights_file

__all__ = [
    "Detection",
    "LandmarkNetwork",
    "as_stored",
    "decode_heatmaps",
    "detect",
    "filled",
    "image_from_network",
    "load_network",
    "network_camera",
    "normalise",
    "to_network_grid",
    "weights_file",
    "within_field",
]
