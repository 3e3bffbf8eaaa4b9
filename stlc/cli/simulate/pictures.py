"""What `stlc simulate` shows: the animation, the report, and robots in a window."""

from __future__ import annotations

from typing import TYPE_CHECKING

from stlc.diagnostics import Diagnostic, UsageError

if TYPE_CHECKING:
    from stlc.controller.training.run import Run


def draw(run: Run) -> dict[str, str]:
    """The animation and the report, where matplotlib is there; what was drawn, by kind."""
    from stlc.cli.framework.output import PULSE, say
    from stlc.view import available

    if not available():
        say("no pictures: they need matplotlib and pillow (pip install 'stlc[plot]')")
        return {}
    from stlc.view.animate import animate, seen_in
    from stlc.view.bullet import ADVICE as BODIES
    from stlc.view.bullet import available as in_space
    from stlc.view.film import ADVICE as VIDEO
    from stlc.view.report import write_report

    seen = seen_in(run.dir)
    if seen is not None and seen.stage is not None and not in_space():
        say(f"robots are drawn as lines: bodies need pybullet ({BODIES})")
    with PULSE.doing("drawing the animation"):
        film = animate(run.dir)
    with PULSE.doing("drawing the report"):
        write_report(run.dir)
    drawn = {"report": f"{run.dir.shown}/report.html"}
    if film is None:
        return drawn
    if film.mp4 is None:
        say(f"the animation is a GIF alone: an MP4 needs ffmpeg ({VIDEO})")
    else:
        drawn = {"video": f"{run.dir.shown}/{film.mp4.name}", **drawn}
    return {"animation": f"{run.dir.shown}/{film.gif.name}", **drawn}


def require_robots(run: Run) -> None:
    """Said before anything is driven: that a window can be opened, and that there is something for it.

    Raises:
        UsageError: U101, the run's world has no robots.
        MissingError: R301, PyBullet is not installed; R302, there is no display.
    """
    from stlc.controller.stage import Staged
    from stlc.controller.world import world_type
    from stlc.view.bullet import require_window

    if not isinstance(world_type(run.task.system.decl), Staged):
        message = f"`--window` shows robots, and `{run.task.system.name}` has none"
        raise UsageError(Diagnostic("U101", message))
    require_window()


def show(run: Run) -> None:
    """Play the newest deployment in PyBullet's window."""
    from stlc.cli.framework.output import PULSE
    from stlc.view import bullet
    from stlc.view.animate import seen_in

    seen = seen_in(run.dir)
    stage = None if seen is None else seen.stage
    if seen is not None and stage is not None:
        with PULSE.doing(""):
            bullet.show(stage, seen.scene, seen.dt)
