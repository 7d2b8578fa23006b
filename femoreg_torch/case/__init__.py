"""Case folders and results: one directory describes one procedure, and every command reads and writes it."""

from femoreg_torch.case.model import Case, CaseObject, Model, Part, PlannedPath, Side, Start, View, anchor_of
from femoreg_torch.case.quality import CameraQuality, ObjectQuality, ViewQuality
from femoreg_torch.case.reading import case_folder, read_case
from femoreg_torch.case.result import LandmarkRecord, Result, StartRecord
from femoreg_torch.case.result_file import RESULT_NAME, read_result, result_content
from femoreg_torch.case.trace import StageRecord
from femoreg_torch.case.verdict import Verdict
from femoreg_torch.case.writing import write_case
from femoreg_torch.files import new_folder, write_json, write_text

__all__ = [
    "RESULT_NAME",
    "CameraQuality",
    "Case",
    "CaseObject",
    "LandmarkRecord",
    "Model",
    "ObjectQuality",
    "Part",
    "PlannedPath",
    "Result",
    "Side",
    "StageRecord",
    "Start",
    "StartRecord",
    "Verdict",
    "View",
    "ViewQuality",
    "anchor_of",
    "case_folder",
    "new_folder",
    "read_case",
    "read_result",
    "result_content",
    "write_case",
    "write_json",
    "write_text",
]
