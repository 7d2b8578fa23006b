"""Finding bones and landmarks in a fluoroscopic image."""

from femoreg_torch.detect.decode import decode_heatmaps
from femoreg_torch.detect.grid import image_from_network, network_camera, to_network_grid
from femoreg_torch.detect.looks import MIRRORED_LABELS, MIRRORED_LANDMARKS
from femoreg_torch.detect.network import Detection, detect, load_network
from femoreg_torch.detect.normalise import normalise

__all__ = [
    "MIRRORED_LABELS",
    "MIRRORED_LANDMARKS",
    "Detection",
    "decode_heatmaps",
    "detect",
    "image_from_network",
    "load_network",
    "network_camera",
    "normalise",
    "to_network_grid",
]
