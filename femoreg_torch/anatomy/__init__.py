"""Bones, landmarks, sides, classes of the network, and label tables of a body part, as data (`configs/anatomy/`)."""

from femoreg_torch.anatomy.body import HIP, Anatomy, Bone, Landmark, load_anatomy
from femoreg_torch.anatomy.tables import LabelTable, bone_of_name, fitting_tables, label_table, label_table_names

__all__ = [
    "HIP",
    "Anatomy",
    "Bone",
    "LabelTable",
    "Landmark",
    "bone_of_name",
    "fitting_tables",
    "label_table",
    "label_table_names",
    "load_anatomy",
]
