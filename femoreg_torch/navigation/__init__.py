"""What a registration means for the robot: where the guide is against the plan, and the motion that corrects it."""

from femoreg_torch.navigation.guidance import Guidance, guide, untold_turn
from femoreg_torch.navigation.report import NAVIGATION_NAME, navigation_content, summary
from femoreg_torch.navigation.robot import Robot, read_robot
from femoreg_torch.navigation.writing import NAVIGATION_NAMES, transform_text, write_navigation

__all__ = [
    "NAVIGATION_NAME",
    "NAVIGATION_NAMES",
    "Guidance",
    "Robot",
    "guide",
    "navigation_content",
    "read_robot",
    "summary",
    "transform_text",
    "untold_turn",
    "write_navigation",
]
