"""The report of one registration as a page."""

from femoreg_torch.evaluation.report.page import report_page

__all__ = ["report_page"]
