"""Volumes of a CT and of devices, their attenuation, bones in label maps, and files of landmarks."""

from femoreg_torch.volume.attenuation import hu_to_attenuation, structure_attenuation
from femoreg_torch.volume.bones import BoneLabels, bone_labels
from femoreg_torch.volume.contradictions import (
    densities,
    misplaced_labels,
    shifted_labels,
    soft_bones,
    turned_labels,
)
from femoreg_torch.volume.device import label_share, labelled_device, scanned_device
from femoreg_torch.volume.dicom.series import patient_of
from femoreg_torch.volume.grid import Volume, axis_aligned, changes_in_place
from femoreg_torch.volume.guide_end import GuideEnd, guide_end
from femoreg_torch.volume.labels import label_box_centre, looked_up
from femoreg_torch.volume.landmarks import check_inside, read_landmarks, read_path_points, write_landmarks
from femoreg_torch.volume.mesh import check_closed, voxelise_mesh
from femoreg_torch.volume.mesh_files import body_names, bounds_of, is_in_ras, read_bodies, read_mesh
from femoreg_torch.volume.patient import NOBODY, Patient
from femoreg_torch.volume.reading import (
    read_ct,
    read_ct_told,
    read_label_map,
    read_labels,
    read_labels_told,
    read_volume,
    read_volume_told,
    write_volume,
)
from femoreg_torch.volume.resample import crop, halved, resample_isotropic, sharpened
from femoreg_torch.volume.segments import has_names, segment_names
from femoreg_torch.volume.sides import (
    landmarks_beside_bones,
    landmarks_without_bones,
    merged_bones,
    mostly_stray,
    stray_landmarks,
    swapped_sides,
)
from femoreg_torch.volume.solids import Solid, solid_volumes

__all__ = [
    "NOBODY",
    "BoneLabels",
    "GuideEnd",
    "Patient",
    "Solid",
    "Volume",
    "axis_aligned",
    "body_names",
    "bone_labels",
    "bounds_of",
    "changes_in_place",
    "check_closed",
    "check_inside",
    "crop",
    "densities",
    "guide_end",
    "halved",
    "has_names",
    "hu_to_attenuation",
    "is_in_ras",
    "label_box_centre",
    "label_share",
    "labelled_device",
    "landmarks_beside_bones",
    "landmarks_without_bones",
    "looked_up",
    "merged_bones",
    "misplaced_labels",
    "mostly_stray",
    "patient_of",
    "read_bodies",
    "read_ct",
    "read_ct_told",
    "read_label_map",
    "read_labels",
    "read_labels_told",
    "read_landmarks",
    "read_mesh",
    "read_path_points",
    "read_volume",
    "read_volume_told",
    "resample_isotropic",
    "scanned_device",
    "segment_names",
    "sharpened",
    "shifted_labels",
    "soft_bones",
    "solid_volumes",
    "stray_landmarks",
    "structure_attenuation",
    "swapped_sides",
    "turned_labels",
    "voxelise_mesh",
    "write_landmarks",
    "write_volume",
]
