"""Rigid transforms, cameras and the C-arm's orbit. Conventions: docs/conventions.md."""

from femoreg_torch.geometry.camera import Camera, CameraChange, centred_camera, project_points
from femoreg_torch.geometry.carm import CArm, Uncertainty, carm_from_dict, load_carm, orbit_angles
from femoreg_torch.geometry.circle import circle_through
from femoreg_torch.geometry.itk_files import read_itk_transform
from femoreg_torch.geometry.poses import Poses, first_view_only, poses_by_object
from femoreg_torch.geometry.rigid import (
    about_point,
    check_rigid,
    euler_xyz_deg,
    exp_se3,
    exp_so3,
    invert_rigid,
    log_se3,
    log_so3,
    pose_difference,
    rigid,
    rotation_angle,
    transform_points,
    twist_rates,
)

__all__ = [
    "CArm",
    "Camera",
    "CameraChange",
    "Poses",
    "Uncertainty",
    "about_point",
    "carm_from_dict",
    "centred_camera",
    "check_rigid",
    "circle_through",
    "euler_xyz_deg",
    "exp_se3",
    "exp_so3",
    "first_view_only",
    "invert_rigid",
    "load_carm",
    "log_se3",
    "log_so3",
    "orbit_angles",
    "pose_difference",
    "poses_by_object",
    "project_points",
    "read_itk_transform",
    "rigid",
    "rotation_angle",
    "transform_points",
    "twist_rates",
]
