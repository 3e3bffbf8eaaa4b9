"""A deployment in motion: drawn by its world, over the places of the specification, else its signals."""

from __future__ import annotations

import re
from pathlib import Path
from zipfile import BadZipFile

import numpy as np

from stlc.diagnostics import StlcError
from stlc.rundir import RunDir
from stlc.trace import Trace, load_trace
from stlc.view.chart import Chart, chart_film, chart_of
from stlc.view.driven import monitor_of
from stlc.view.film import MAX_BYTES, MAX_FRAMES, Film, Scene, save_gif, save_still, scene_film, signal_film

SCENE = "scene.npz"
TRACE = "trace.npz"
RESULT = "eval/simulate.json"
STILL = "scene.png"


def film_of(run: RunDir) -> Film | None:
    """What there is to see of the run's deployment; None where nothing was recorded.

    A world draws its own scene and is loaded from the folder. Without one, or where it cannot be loaded,
    the paths of the trace are shown over the places that its specification names, else its signals.
    """
    return _scene_film(run) or _signal_film(run)


def gif_name(run: RunDir) -> str:
    """File name of the run's animation: that of its specification."""
    return re.sub(r"[^\w-]+", "-", str(run.record().get("spec", "deployment"))).strip("-") + ".gif"


def write_gif(run: RunDir, *, max_frames: int = MAX_FRAMES, max_bytes: int = MAX_BYTES) -> Path | None:
    """Animate the deployment of `run` into its folder, with a still beside it.

    Args:
        run: a run that was simulated.
        max_frames: of the animation; instants are left out evenly beyond that.
        max_bytes: of the file; the picture gets smaller where it would be larger.

    Returns:
        The path of the GIF, or None where nothing was recorded.

    Raises:
        MissingError: R301, matplotlib or Pillow is missing; R201, the file cannot be written.
    """
    film = film_of(run)
    if film is None:
        return None
    save_still(film, run.path / STILL)
    return save_gif(film, run.path / gif_name(run), max_frames=max_frames, max_bytes=max_bytes)


def current_gif(run: RunDir) -> Path | None:
    """The animation of the newest deployment, drawn now if it is not there yet."""
    path = run.path / gif_name(run)
    recorded = [run.path / name for name in (SCENE, TRACE) if (run.path / name).exists()]
    if path.exists() and all(path.stat().st_mtime >= record.stat().st_mtime for record in recorded):
        return path
    return write_gif(run)


def _scene_film(run: RunDir) -> Film | None:
    scene = _load_scene(run.path / SCENE)
    if scene is None:
        return None
    from stlc.controller.world import world_type
    from stlc.dynamics.scenario import under
    from stlc.dynamics.schema import load_system_decl

    try:
        decl = load_system_decl(run.path / "system.yaml")
        scenario = _scenario(run)
        decl = decl if scenario is None else under(decl, scenario)
        if decl.test.world is None:
            return None
        world = world_type(decl)
    except StlcError:
        return None
    return scene_film(scene, world.draw, float(decl.dt), title=_title(run))


def _scenario(run: RunDir) -> str | None:
    """The scenario of the newest deployment, if there was one."""
    try:
        name = run.read_json(RESULT).get("scenario")
    except (StlcError, AttributeError):
        return None
    return None if name is None else str(name)


def _signal_film(run: RunDir) -> Film | None:
    try:
        trace = load_trace(run.path / TRACE)
    except StlcError:
        return None
    chart = _chart(trace)
    return signal_film(trace, title=_title(run)) if chart is None else chart_film(chart, title=_title(run))


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
    return f"{run.record().get('spec', '')} · {run.name}"
