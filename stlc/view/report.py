"""`report.html`: one page that says what a run achieved, how, where it fails and how to repeat it.

It begins with a film of the newest deployment that can be scrubbed through. The page is whole by itself:
style, pictures and the one script stand inside it, it needs no network, shows a still where scripts do not
run, and follows the reader's light or dark scheme. What a run does not have (a deployment, say) is left out.
"""

from __future__ import annotations

from pathlib import Path

from stlc.files import write_atomic
from stlc.rundir import RunDir
from stlc.version import __version__
from stlc.view import require_drawing
from stlc.view.closing import failures_section, repeat_section, texts_section
from stlc.view.deployment import deployment_section, deployment_tiles
from stlc.view.driven import driven_section, map_section
from stlc.view.html import join
from stlc.view.material import Material, gather
from stlc.view.opening import headline, numbers, requirements_section, training_section
from stlc.view.page import Section, page
from stlc.view.player import player_section, script

REPORT = "report.html"


def write_report(run: RunDir) -> Path:
    """Write the report of `run` into its folder, its pictures beside it as PNG; returns the report's path.

    Raises:
        MissingError: R301, matplotlib or Pillow is missing; R201, a file cannot be written.
        RunError: R101, the folder is no run.
    """
    require_drawing()
    material = gather(run)
    sections = sections_of(material)
    path = run.path / REPORT
    write_atomic(path, render_report(material, sections))
    for part in sections:
        if part.picture is not None:
            part.picture.save_png(run.path / f"{part.anchor}.png")
    return path


def sections_of(material: Material) -> list[Section]:
    """What there is to say, in order."""
    parts = (
        requirements_section(material),
        deployment_section(material),
        map_section(material),
        driven_section(material),
        failures_section(material),
        training_section(material),
        repeat_section(material),
        texts_section(material),
    )
    return [part for part in parts if part is not None]


def render_report(material: Material, sections: list[Section]) -> str:
    """The page of `material`."""
    film = player_section(material)
    head = join(
        headline(material),
        film.html if film is not None else None,
        numbers(material, deployment_tiles(material)),
    )
    return page(
        f"{material.spec} · {material.run.name}",
        head,
        sections,
        f"Written by stlc {__version__} from {material.run.shown}",
        script() if film is not None else None,
    )
