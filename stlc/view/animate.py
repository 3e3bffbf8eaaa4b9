"""A deployment in motion: drawn by its world, over the places of the specification, else its signals."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING
from zipfile import BadZipFile

import numpy as np

from stlc.controller.stage import Stage, Staged
from stlc.diagnostics import StlcError
from stlc.escape import file_part, picture
from stlc.rundir import RunDir
from stlc.trace import Trace, load_trace
from stlc.view import bullet
from stlc.view.chart import Chart, chart_film, chart_of
from stlc.view.driven import monitor_of
from stlc.view.film import MAX_BYTES, MAX_FRAMES, Film, save_film, save_still
from stlc.view.margins import strip_of
from stlc.view.scene import Scene, Staging, scene_film
from stlc.view.signal_film import signal_film
from stlc.view.strip import Strip
from stlc.view.video import encoder

if TYPE_CHECKING:
    from stlc.controller.world import WorldType

SCENE = "scene.npz"
TRACE = "trace.npz"
SYSTEM = "system.yaml"
RESULT = "eval/simulate.json"
STILL = "scene.png"


@dataclass(frozen=True, slots=True)
class Animation:
    """The files of an animation; no video where there is no ffmpeg."""

    gif: Path
    mp4: Path | None


def film_of(run: RunDir, *, title: str | None = None) -> Film | None:
    """What there is to see of the run's deployment; None where nothing was recorded.

    Its title names specification, scenario and run where no other is given.

    A world draws its own scene and is loaded from the folder. Without one, or where it cannot be loaded or
    fails to draw, the paths of the trace are shown over the places that its specification names, else its
    signals.
    """
    title = _title(run) if title is None else title
    return _scene_film(run, title) or _signal_film(run, title)


def film_name(run: RunDir) -> str:
    """File name of the run's animation, without a suffix: that of its specification."""
    return file_part(str(run.record().get("spec", "")), empty="deployment")


def animate(run: RunDir, *, max_frames: int = MAX_FRAMES, max_bytes: int = MAX_BYTES) -> Animation | None:
    """Animate the deployment of `run` into its folder, with a still beside it.

    Args:
        run: a run that was simulated.
        max_frames: of the animation; instants are left out evenly beyond that.
        max_bytes: of the GIF; the picture gets smaller where it would be larger.

    Returns:
        The files, or None where nothing was recorded.

    Raises:
        MissingError: R301, matplotlib or Pillow is missing; R201, a file cannot be written.
    """
    film = film_of(run)
    if film is None:
        return None
    gif = run.path / f"{film_name(run)}.gif"
    mp4 = gif.with_suffix(".mp4") if encoder() is not None else None
    save_still(film, run.path / STILL)
    save_film(film, gif, mp4, max_frames=max_frames, max_bytes=max_bytes)
    if mp4 is None:
        gif.with_suffix(".mp4").unlink(missing_ok=True)  # of an older deployment
    return Animation(gif, mp4)


def current(run: RunDir) -> Animation | None:
    """The animation of the newest deployment, drawn now if it is not there yet."""
    gif = run.path / f"{film_name(run)}.gif"
    recorded = [run.path / name for name in (SCENE, TRACE) if (run.path / name).exists()]
    if gif.exists() and all(gif.stat().st_mtime >= record.stat().st_mtime for record in recorded):
        mp4 = gif.with_suffix(".mp4")
        return Animation(gif, mp4 if mp4.exists() else None)
    return animate(run)


@dataclass(frozen=True, slots=True)
class Seen:
    """A recorded scene with its world.

    Attributes:
        scene: snapshots stacked to (frames, …).
        world: what draws them.
        dt: seconds between them.
    """

    scene: Scene
    world: WorldType
    dt: float

    @property
    def stage(self) -> Stage | None:
        """The robots in space; None where the world has none."""
        return self.world.stage(self.scene) if isinstance(self.world, Staged) else None


def seen_in(run: RunDir) -> Seen | None:
    """The scene of the run's deployment; None without one, or where its world cannot be loaded."""
    from stlc.controller.world import world_type
    from stlc.dynamics.scenario import under
    from stlc.dynamics.schema import load_system_decl

    scene = _load_scene(run.path / SCENE)
    if scene is None:
        return None
    try:
        decl = load_system_decl(run.path / SYSTEM)
        scenario = _scenario(run)
        decl = decl if scenario is None else under(decl, scenario)
        world = None if decl.test.world is None else world_type(decl)
    except StlcError:
        return None
    return None if world is None else Seen(scene, world, float(decl.dt))


def _scene_film(run: RunDir, title: str) -> Film | None:
    seen = seen_in(run)
    if seen is None:
        return None
    keys: Mapping[str, str] = getattr(seen.world, "KEYS", {})
    strip = _strip(run, seen)
    try:
        stage = seen.stage if bullet.available() else None
        draw = seen.world.draw if stage is None else bullet.stage_drawing(stage)
        return scene_film(seen.scene, Staging(draw, seen.dt, title, keys, strip))
    except Exception:  # whatever a world's own code raises: there are other pictures
        return None


def _strip(run: RunDir, seen: Seen) -> Strip | None:
    """What is shown over time; None where it is not known."""
    try:
        trace = load_trace(run.path / TRACE)
        return strip_of(seen.scene, trace, seen.dt, system=run.path / SYSTEM)
    except StlcError:
        return None


def _scenario(run: RunDir) -> str | None:
    """The scenario of the newest deployment, if there was one."""
    try:
        name = run.read_json(RESULT).get("scenario")
    except (StlcError, AttributeError):
        return None
    return None if name is None else str(name)


def _signal_film(run: RunDir, title: str) -> Film | None:
    try:
        trace = load_trace(run.path / TRACE)
    except StlcError:
        return None
    chart = _chart(trace)
    return signal_film(trace, title=title) if chart is None else chart_film(chart, title=title)


def _chart(trace: Trace) -> Chart | None:
    """The map of a trace; None where it carries no specification that names places."""
    try:
        monitor = monitor_of(trace)
        return chart_of(monitor.spec, monitor.check(trace), trace)
    except StlcError:
        return None


def _load_scene(path: Path) -> Scene | None:
    try:
        with np.load(path, allow_pickle=False) as file:
            scene = {name: file[name] for name in file.files}
    except (OSError, ValueError, BadZipFile):
        return None
    whole = scene and all(values.ndim and len(values) for values in scene.values())
    return scene if whole else None


def _title(run: RunDir) -> str:
    spec = str(run.record().get("spec", ""))
    return picture(" · ".join(part for part in (spec, _scenario(run), run.name) if part))
