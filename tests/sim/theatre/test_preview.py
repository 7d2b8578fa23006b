"""The preview of simulated images: what a shutter leaves sets its grey values."""

from pathlib import Path

import cv2
import torch

from femoreg_torch.geometry import centred_camera
from sim.theatre.images import ViewImages
from sim.theatre.preview import write_preview

SIZE = 512


def test_bone_is_seen_beside_the_shade_of_a_shutter(tmp_path: Path) -> None:
    """A bone that takes a fifth of the light, within a round field whose shade takes all but a hundredth."""
    camera = centred_camera(1000.0, (0.6, 0.6), (SIZE, SIZE))
    places = torch.arange(SIZE) - (SIZE - 1) / 2
    raw = torch.full((SIZE, SIZE), 20_000.0)
    raw[:, SIZE // 2 :] *= 0.8
    raw[torch.hypot(places[:, None], places[None]) > 0.42 * SIZE] *= 0.01
    image = raw.to(torch.uint16)
    write_preview(tmp_path / "preview.png", [ViewImages(image, image)], camera)
    shown = cv2.imread(str(tmp_path / "preview.png"), cv2.IMREAD_GRAYSCALE)
    assert shown is not None
    middle = shown[SIZE // 2 - 40 : SIZE // 2 + 40]
    assert middle[:, 150:240].mean() - middle[:, 272:360].mean() > 100
    assert shown[:20, :20].max() == 0
