"""The report of one registration: a single HTML file that needs nothing beside it and loads nothing."""

import base64
import hashlib
from collections.abc import Sequence
from functools import cache
from typing import Any

import jinja2
from markupsafe import Markup

from femoreg_torch.case import Case, Result
from femoreg_torch.evaluation.overlay import Drawn
from femoreg_torch.evaluation.report.card import card
from femoreg_torch.evaluation.report.parts import Material
from femoreg_torch.evaluation.report.sections import SECTIONS
from femoreg_torch.navigation.report import NOTICE
from femoreg_torch.registration import Scene

_SCRIPTS = ("images.js", "theatre.js")


def report_page(case: Case, scene: Scene, result: Result, errors: dict[str, Any] | None, drawn: Drawn) -> str:
    """The report of a registration as the text of one HTML file.

    `errors` are those against the truth, None if there is none; `drawn` is the scene at the result's poses. Whatever
    comes from files is escaped, and the page's policy lets the browser run its own scripts, show pictures that stand
    within it, and load nothing.
    """
    templates = templates_of("femoreg_torch.evaluation.report")
    material = Material(case, scene, result, errors, drawn)
    made = (make(material) for make in SECTIONS)
    scripts = [source_of(templates, name) for name in _SCRIPTS]
    return templates.get_template("report.html").render(
        title=case.folder.resolve().name,
        side=case.side,
        views=len(case.views),
        simulated=case.truth_source == "simulation",
        notice=NOTICE,
        card=card(case, result),
        sections=[section for section in made if section is not None],
        style=source_of(templates, "report.css"),
        scripts=scripts,
        policy=f"default-src 'none'; img-src data:; style-src 'unsafe-inline'; script-src {script_hashes(scripts)}",
    )


@cache
def templates_of(package: str) -> jinja2.Environment:
    """The folder `templates` of a package. Whatever is put into them is escaped."""
    return jinja2.Environment(
        loader=jinja2.PackageLoader(package),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )


def source_of(templates: jinja2.Environment, name: str) -> Markup:
    """The text of a file in the folder of the templates, as it stands there."""
    assert templates.loader is not None
    return Markup(templates.loader.get_source(templates, name)[0])


def script_hashes(scripts: Sequence[str]) -> str:
    """These scripts as sources of a Content-Security-Policy, by their hashes, so that the browser runs no others."""
    digests = (hashlib.sha256(script.encode()).digest() for script in scripts)
    return " ".join(f"'sha256-{base64.b64encode(digest).decode('ascii')}'" for digest in digests)
