"""A user's own data: what a file or folder holds, what is wrong with a case, and a case made of files."""

from femoreg_torch.intake.check import Checked, check_case
from femoreg_torch.intake.given import NewCase
from femoreg_torch.intake.inspect import Findings, inspect_path
from femoreg_torch.intake.new_case import make_case

__all__ = ["Checked", "Findings", "NewCase", "check_case", "inspect_path", "make_case"]
