"""Files of detections: a table, 3D Slicer markups and pictures."""

import csv
from collections.abc import Sequence
from pathlib import Path

import cv2
import torch
from torch import Tensor

from femoreg_torch.detect.network import Detection
from femoreg_torch.detect.overlay import draw_overlay
from femoreg_torch.files import new_folder
from femoreg_torch.geometry import Camera
from femoreg_torch.pictures import write_picture
from femoreg_torch.volume import write_landmarks

COLUMNS = ("image", "landmark", "column_px", "row_px", "confidence", "visible")


def write_detections(
    out: Path, paths: Sequence[Path], attenuation: Sequence[Tensor], detections: Sequence[Detection], camera: Camera
) -> None:
    """Write `landmarks.csv` and, per image, `<name>.mrk.json` and `<name>.png` into `out`, all of them or none."""
    with new_folder(out) as folder:
        with (folder / "landmarks.csv").open("w", newline="", encoding="utf-8") as file:
            rows = csv.writer(file)
            rows.writerow(COLUMNS)
            for path, detection in zip(paths, detections, strict=True):
                rows.writerows(_rows(path, detection))
        for path, image, detection in zip(paths, attenuation, detections, strict=True):
            write_landmarks(folder / f"{path.stem}.mrk.json", _in_image_plane(detection))
            picture = draw_overlay(image, detection, camera)
            write_picture(folder / f"{path.stem}.png", cv2.cvtColor(picture, cv2.COLOR_RGB2BGR))


def _rows(path: Path, detection: Detection) -> list[list[object]]:
    names = detection.anatomy.landmark_names
    values = zip(names, detection.pixels.tolist(), detection.confidence.tolist(), detection.visible, strict=True)
    return [
        [path, name, f"{column:.2f}", f"{row:.2f}", f"{confidence:.4f}", int(visible)]
        for name, (column, row), confidence, visible in values
    ]


def _in_image_plane(detection: Detection) -> dict[str, Tensor]:
    """Visible landmarks as points (column, row, 0)."""
    seen = zip(detection.anatomy.landmark_names, detection.pixels, detection.visible, strict=True)
    return {name: torch.cat([pixel, pixel.new_zeros(1)]) for name, pixel, visible in seen if visible}
