"""The page of a review: verdict and decision, the images to work on, and the report."""

from typing import Any

from femoreg_torch.case.review import read_review
from femoreg_torch.evaluation.colours import GUIDE, PATH, hexadecimal, object_colours
from femoreg_torch.evaluation.report.card import card
from femoreg_torch.evaluation.report.page import script_hashes, source_of, templates_of
from femoreg_torch.navigation.report import NOTICE
from femoreg_torch.review.desk import Desk
from femoreg_torch.review.placing import ALL


def review_page(desk: Desk, message: str = "") -> tuple[str, str]:
    """The page as text, and its Content-Security-Policy: its own script by its hash, and this server alone."""
    templates = templates_of("femoreg_torch.review")
    script = source_of(templates, "review.js")
    reviewed, case, scene = desk.reviewed, desk.case, desk.scene
    digest = "" if reviewed is None else reviewed.digest
    colours = object_colours(scene.objects)
    text = templates.get_template("review.html").render(
        name=desk.run.resolve().name,
        case=case.folder.resolve().name,
        card=None if reviewed is None else card(case, reviewed.result),
        digest=digest,
        review=None if reviewed is None else read_review(desk.run),
        changed=desk.changed,
        message=message,
        notice=NOTICE,
        panels=_panels(desk),
        objects={name: hexadecimal(colours[name]) for name in desk.placed_objects},
        all_objects=ALL,
        landmarks=list(case.landmarks),
        by_landmarks=scene.needs_landmarks,
        network=case.anatomy is not None and bool(case.landmarks),
        settings={
            "path": hexadecimal(PATH),
            "guide": hexadecimal(GUIDE),
            "all": ALL,
            "digest": digest,
            "pixel_mm": case.carm.camera.mean_pixel_mm,
        },
        style=source_of(templates, "review.css"),
        script=script,
    )
    policy = (
        f"default-src 'none'; img-src data:; style-src 'unsafe-inline'; script-src {script_hashes([script])}; "
        "connect-src 'self'; frame-src 'self'; form-action 'self'; frame-ancestors 'none'; base-uri 'none'"
    )
    return text, policy


def _panels(desk: Desk) -> list[dict[str, Any]]:
    """Every image: its title and place, its picture, and the objects that it shows."""
    scene = desk.scene
    rows, columns = scene.carm.camera.shape
    return [
        {
            "title": f"View {view + 1}, {kind}" if len(scene.images) > 1 else f"View {view + 1}",
            "kind": kind,
            "view": view + 1,
            "first": kind == scene.first_kind and view == 0,
            "width": columns,
            "height": rows,
            "picture": picture,
            "objects": scene.shown(desk.placed_objects, kind),
        }
        for (kind, view), picture in desk.pictures.items()
    ]
