"""`femoreg segment` and `femoreg landmarks`: bones and landmarks from a CT alone."""

from pathlib import Path
from typing import Literal


def segment(
    ct: Path,
    *,
    out: Path,
    series: str | None = None,
    way: Literal["network", "graph_cut"] = "network",
    weights: Path | None = None,
    unrefined: bool = False,
) -> None:
    """Label hip bones, sacrum, femora and vertebrae in a CT, left and right, without any download.

    Writes OUT, a label map on the grid of the CT with the ids of the table `femoreg` (left hip bone 1, right 2,
    vertebrae 3, sacrum 4, left femur 5, right 6), and beside it a picture of three planes (.png) and confidence,
    volumes and warnings (.json). Look at the picture: the network has learned on synthetic CTs alone, and the graph cut
    knows no shape.

    Args:
        ct: CT in HU: folder of a DICOM series, or a NIfTI, NRRD or MHA file.
        out: Label map to write (.nii.gz, .nrrd, .mha).
        series: Which of several DICOM series: its number, UID, or a part of its description.
        way: `network`, or `graph_cut`: bright sheets, minimum cuts and the heads' spheres, nothing learned.
        weights: Network weights (safetensors) that `femoreg train-segmentation` wrote; by default the shipped ones.
        unrefined: Keep the outlines of the network (voxels of 3 mm) or of the cuts (1.25 mm), not the CT's edges.
    """
    from rich.console import Console
    from rich.markup import escape

    from femoreg_torch.anatomy import HIP
    from femoreg_torch.commands.telling import tell
    from femoreg_torch.errors import InputError
    from femoreg_torch.files import check_files, temporary_files, write_json
    from femoreg_torch.intake.planes import planes_through_joints
    from femoreg_torch.pictures import write_picture
    from femoreg_torch.segment import load_bone_network, segment_bones, segment_bones_without_network
    from femoreg_torch.volume import read_ct_told
    from femoreg_torch.volume.reading import write_labels_like

    suffix = next((s for s in (".nii.gz", ".nii", ".nrrd", ".mha") if out.name.lower().endswith(s)), None)
    if suffix is None:
        raise InputError(f"{out}: the label map's name is to end in .nii.gz, .nrrd or .mha.")
    if way == "graph_cut" and weights is not None:
        raise InputError("--weights: are a network's, and `--way graph_cut` uses none. Leave one of the two out.")
    stem = out.name[: -len(suffix)]

    def beside(ending: str) -> Path:
        return out.with_name(stem + ending)

    check_files(out, beside(".json"), beside(".png"))
    if ct.exists() and out.exists() and out.samefile(ct):
        raise InputError(f"{out}: is the CT itself. Choose another name for the label map.")
    console = Console(soft_wrap=True)
    volume, told = read_ct_told(ct, series)
    with console.status("looking for bones"):
        if way == "graph_cut":
            found = segment_bones_without_network(volume, refine=not unrefined)
        else:
            found = segment_bones(volume, load_bone_network(weights), refine=not unrefined)
    about = {
        "labels": out.name,
        "table": "femoreg",
        "way": way,
        "confidence": {bone: round(share, 3) for bone, share in found.confidence.items()},
        "volume_ml": {bone: round(volume_ml, 1) for bone, volume_ml in found.volume_ml.items()},
        "head_radius_mm": {side: round(head.radius_mm, 1) for side, head in found.heads.items()},
        "warnings": list(found.warnings),
    }
    colours = {1 + n: bone.colour for n, bone in enumerate(HIP.bones)}
    heads = {side: head.centre for side, head in found.heads.items() if head.may_be_one}
    planes = planes_through_joints(
        volume, found.labels, colours, heads, {1 + n: b.name for n, b in enumerate(HIP.bones)}
    )
    with temporary_files(out, beside(".json"), beside(".png")) as (labels, text, picture):
        write_labels_like(labels, found.labels, ct)
        write_json(text, about)
        write_picture(picture, planes)
    for note in told:
        console.print(f"  {escape(note)}", highlight=False)
    for bone, volume_ml in found.volume_ml.items():
        sure = f", mean probability {found.confidence[bone]:.2f}" if bone in found.confidence else ""
        digits = 0 if volume_ml >= 1 else 2
        console.print(f"  {bone}: {volume_ml:.{digits}f} ml{sure}", highlight=False)
    for warning in found.warnings:
        tell(console, "Warning", warning)
    console.print(
        f"Label map: {escape(str(out))}; look at {escape(beside('.png').name)} before you use it.", highlight=False
    )


def landmarks(ct: Path, labels: Path, *, out: Path, bones: str | None = None, series: str | None = None) -> None:
    """Propose the 14 hip landmarks of a CT from its label map, by the rules that the landmark network was trained with.

    Writes OUT (.mrk.json: markups of 3D Slicer, to be corrected there; else plain JSON) and says the error to expect of
    each. Landmarks that lie outside of the CT, or on bone that is cut off, are left out.

    Args:
        ct: CT in HU: folder of a DICOM series, or a NIfTI, NRRD or MHA file.
        labels: Segmentation of hip bones and femora, as `femoreg new-case` takes it.
        out: File to write (.mrk.json or .json); one that is there already stays.
        bones: Label table of the map (totalsegmentator_v2, …, or a YAML file). By default the names of its parts say
            it, or else it is of `femoreg segment`.
        series: Which of several DICOM series: its number, UID, or a part of its description.
    """
    from rich.console import Console
    from rich.markup import escape

    from femoreg_torch.anatomy import HIP, label_table_names
    from femoreg_torch.commands.telling import tell
    from femoreg_torch.errors import InputError
    from femoreg_torch.intake.label_tables import table_of_map
    from femoreg_torch.segment import propose_landmarks
    from femoreg_torch.volume import (
        bone_labels,
        has_names,
        read_ct_told,
        read_labels_told,
        swapped_sides,
        write_landmarks,
    )

    if not out.name.lower().endswith(".json"):
        raise InputError(f"{out}: the name is to end in .mrk.json or .json.")
    if out.exists():
        raise InputError(f"{out}: is there already, and may be corrected by hand. Choose another name, or remove it.")
    console = Console(soft_wrap=True)
    volume, told = read_ct_told(ct, series)
    table, parts = table_of_map(labels, bones, usual="femoreg")
    found_labels, done, against = read_labels_told(labels, volume, {n for ids in table.values() for n in ids})
    known = bone_labels(found_labels, volume, table, HIP, {})
    with console.status("looking for landmarks"):
        found = propose_landmarks(volume, known)
    if not found.points:
        raise InputError(f"{labels}: no landmark could be found on its bones. Look at it with `femoreg inspect`.")
    swapped = swapped_sides(known, found.points, HIP)
    if swapped and bones is None and not has_names(labels):
        raise InputError(
            f"{labels}: read with the ids of `femoreg segment`, left and right are swapped, or its ids are of another "
            f"table. Say which: --bones {', '.join(label_table_names())}, or a YAML file."
        )
    write_landmarks(out, found.points)
    for note in (*told, *parts, *done, *against):
        console.print(f"  {escape(note)}", highlight=False)
    for name, error in found.expected_error_mm.items():
        console.print(f"  {name}: expected error {error:.1f} mm", highlight=False)
    for side, radius in found.head_radius_mm.items():
        residual = found.head_residual_mm[side]
        console.print(f"  {side} femoral head: radius {radius:.1f} mm, {residual:.2f} mm off a sphere", highlight=False)
    for name, why in found.left_out.items():
        console.print(f"[yellow]Left out:[/] {name}: {why}.", highlight=False)
    for warning in (*found.warnings, *swapped):
        tell(console, "Warning", warning)
    console.print(f"Landmarks: {escape(str(out))}. Look at them in 3D Slicer and correct them.", highlight=False)
