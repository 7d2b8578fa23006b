"""What a report holds below its card: sections, each made by a function of `SECTIONS`."""

import math
from collections.abc import Callable, Iterable

from femoreg_torch.case import ObjectQuality, Result
from femoreg_torch.case.quality import largest
from femoreg_torch.evaluation.colours import GUIDE, PATH, hexadecimal, object_colours
from femoreg_torch.evaluation.report.parts import Material, Section, Table
from femoreg_torch.evaluation.report.pictures import panels
from femoreg_torch.evaluation.report.planning import planning
from femoreg_torch.evaluation.report.surfaces import theatre
from femoreg_torch.evaluation.report.words import number, sentence
from femoreg_torch.evaluation.table import METRIC_COLUMNS, POSE_COLUMNS, metric_rows, pose_rows


def images(material: Material) -> Section:
    """The fluoroscopic images, large, with what was registered drawn over them."""
    case, scene, poses = material.case, material.scene, material.result.poses
    content = {
        "panels": panels(case, scene, poses, material.drawn),
        "objects": {n: hexadecimal(c) for n, c in object_colours(scene.objects).items() if n in poses.camera1_from},
        "path_colour": hexadecimal(PATH),
        "guide_colour": hexadecimal(GUIDE),
        "has_path": case.plan is not None and case.plan.object in poses.camera1_from,
        "has_guide": case.plan is not None and case.plan.tool in poses.camera1_from,
        "has_landmarks": bool(case.landmarks),
    }
    return Section("images", "Images", template="images.html", content=content)


def space(material: Material) -> Section:
    """The 3-D scene."""
    content = {"theatre": theatre(material.case, material.scene, material.result, material.drawn)}
    return Section("space", "In space", template="space.html", content=content)


def quality(material: Material) -> Section:
    """How good the registration is, by its own checks."""
    result = material.result
    paragraphs = [] if result.quality else ["The result does not say how good it is, so it is not trusted."]
    explained = (
        "Likeness of an image and its rendering: 1 if they are the same, 0 if they have nothing in common (mean patch "
        "Grad-NCC). Pull: where one view alone would move the object in its own image plane."
    )
    tables = [_quality_table(name, found) for name, found in result.quality.items()]
    if result.cameras:
        tables.append(Table(_CAMERA_COLUMNS, list(_cameras(result)), "C-arm, refined with the poses"))
    content = {
        "objects": [(n, q.trusted is True, list(_in_words(q))) for n, q in result.quality.items()],
        "explained": explained,
    }
    return Section("quality", "Quality", paragraphs, tables, template="quality.html", content=content)


def errors(material: Material) -> Section | None:
    """Errors against the truth; nothing where there is none."""
    case, found = material.case, material.errors
    if found is None or case.truth is None:
        return None
    origin = _ORIGINS[case.truth_source]
    paragraphs = [origin, _BESIDE_THE_PAPER]
    tables = [
        Table(METRIC_COLUMNS, list(metric_rows(found)), "What steers the drill"),
        Table(POSE_COLUMNS, list(pose_rows(found)), "Poses, along and about the axes of view 1"),
    ]
    return Section("errors", "Errors against the truth", paragraphs, [table for table in tables if table.rows])


def course(material: Material) -> Section:
    """Where the registration started, its stages, and the time that they took."""
    result = material.result
    start = result.start
    paragraphs = ["The result does not tell where it started."] if start is None else [f"Started from {start.source}."]
    if start is not None and start.landmarks:
        used = sum(mark.used for mark in start.landmarks.values())
        seen = sum(mark.visible for mark in start.landmarks.values())
        paragraphs.append(f"{seen} of {len(start.landmarks)} landmarks were seen, {used} of them used.")
        if start.reprojection_rms_px is not None:
            mm = start.reprojection_rms_px * material.case.carm.camera.mean_pixel_mm
            paragraphs.append(f"These lay {mm:.1f} mm on the detector from where the start pose puts them (RMS).")
    if start is not None and start.silhouette_overlap is not None:
        paragraphs.append(f"The outlines drawn and seen overlapped by {100 * start.silhouette_overlap:.0f} % (Dice).")
    rows = [
        [
            stage.name if stage.view is None else f"{stage.name}, view {stage.view}",
            str(stage.evaluations),
            number(stage.seconds, 1),
            stage.stop,
        ]
        for stage in result.stages
    ]
    tables = [Table(("stage", "evaluations", "seconds", "stopped because"), rows, "Stages")] if rows else []
    times = [[name, number(seconds, 1)] for name, seconds in result.timings_s.items()]
    tables += [Table(("part", "seconds"), times, "Time")] if times else []
    return Section("course", "Stages and times", paragraphs, tables, folded=True)


def configuration(material: Material) -> Section:
    """What was registered by which settings and versions, and where things lie."""
    case, result = material.case, material.result
    camera = case.carm.camera
    rows = [
        ["case", case.folder.resolve().name],
        ["preset", result.preset or "unknown"],
        ["seed", str(result.seed)],
        ["objects", ", ".join(result.poses.camera1_from)],
        ["source to detector", f"{camera.sdd_mm:.1f} mm"],
        ["detector", f"{camera.shape[1]} × {camera.shape[0]} pixels of {camera.mean_pixel_mm:.3f} mm"],
        *([name, version] for name, version in result.versions.items()),
    ]
    tables = [Table(("setting", "value"), rows)]
    places = [
        [name.replace("_", " "), *(f"{value:.{digits}f}" for value in vector.tolist()), unit]
        for vectors, digits, unit in ((result.points_camera1, 2, "mm"), (result.directions_camera1, 4, "unit vector"))
        for name, vector in vectors.items()
    ]
    if places:
        tables.append(Table(("", "x", "y", "z", "unit"), places, "Points and directions in the camera of view 1"))
    return Section("configuration", "Configuration and versions", (), tables, folded=True)


# The sections of a report, in this order. A function gets all there is and gives its section, or None for none.
SECTIONS: tuple[Callable[[Material], Section | None], ...] = (
    images,
    space,
    planning,
    quality,
    errors,
    course,
    configuration,
)

_ORIGINS = {
    "simulation": "The images of this case are simulated, and so is the truth that the errors are measured against.",
    "beads": (
        "The truth that the errors are measured against was itself measured, by beads, and has an error of its own."
    ),
    None: "The truth that the errors are measured against came with the case, which does not say how it was found.",
}
_BESIDE_THE_PAPER = (
    "Absolute errors of this one registration. Beside them the means of the paper's 1,000 simulations (Tables I and "
    "II), made on another anatomy with another simulator."
)
_CAMERA_COLUMNS = ("", "source distance mm", "± mm", "column px", "± px", "row px", "± px")
_VIEW_COLUMNS = ("", "likeness", "without it", "pull mm")


def _in_words(quality: ObjectQuality) -> Iterable[str]:
    """What was measured of one object, in sentences with units."""
    yield sentence(quality.reason or "no reason given")
    mm = number(largest(quality.translation_deviation_mm), 2)
    degrees = number(largest(quality.rotation_deviation_deg), 2)
    yield f"Known to ± {mm} mm and ± {degrees}°: standard deviations along and about the least certain axis."
    with_carm = quality.translation_deviation_with_carm_mm
    if with_carm != quality.translation_deviation_mm and all(map(math.isfinite, with_carm)):
        mm, degrees = (number(largest(of), 2) for of in (with_carm, quality.rotation_deviation_with_carm_deg))
        yield (
            "That takes the C-arm's file at its word. With a source distance and principal points that nobody has "
            f"calibrated: ± {mm} mm and ± {degrees}°, all objects together."
        )
    pull_deg, pull_mm = (number(value, 2) for value in quality.common_pull)
    yield f"All images together would move it by {pull_mm} mm and {pull_deg}°, were everything else free."
    if quality.displacement is not None:
        degrees, mm = (number(value, 1) for value in quality.displacement)
        yield f"It lies {mm} mm and {degrees}° from where it was expected before."


def _quality_table(name: str, quality: ObjectQuality) -> Table:
    rows = [
        [
            f"view {view.view}",
            number(view.similarity, 2),
            number(view.similarity - view.gain, 2),
            number(math.hypot(*view.pull_mm), 2),
        ]
        for view in quality.views
    ]
    return Table(_VIEW_COLUMNS, rows, f"The {name} in each view")


def _cameras(result: Result) -> Iterable[list[str]]:
    """A row for every view."""
    for view, camera in enumerate(result.cameras, 1):
        column, row = camera.principal_point_px
        column_deviation, row_deviation = camera.principal_point_deviation_px
        values = (camera.sdd_mm, camera.sdd_deviation_mm, column, column_deviation, row, row_deviation)
        yield [f"view {view}", *(number(value, 1) for value in values)]
