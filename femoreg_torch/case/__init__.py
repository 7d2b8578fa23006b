"""Case folders and results: one directory describes one procedure, and every command reads and writes it."""

from femoreg_torch.case.model import DEVICE_POINTS, STRUCTURES, Case, Device, Truth, View
from femoreg_torch.case.reading import read_case
from femoreg_torch.case.result import RESULT_NAME, read_result
from femoreg_torch.case.writing import write_case
from femoreg_torch.files import new_folder, write_json, write_text

__all__ = [
    "DEVICE_POINTS",
    "RESULT_NAME",
    "STRUCTURES",
    "Case",
    "Device",
    "Truth",
    "View",
    "new_folder",
    "read_case",
    "read_result",
    "write_case",
    "write_json",
    "write_text",
]
