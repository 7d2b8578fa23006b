"""Fiducial-free 2D/3D registration of femur and drilling device for robot-assisted femoroplasty."""

__version__ = "0.1.0"
