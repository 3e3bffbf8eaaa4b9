"""Animation of a deployment: its world's scene, else a map of the specification's regions, else signals."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING
from zipfile import BadZipFile

import numpy as np
from numpy.typing import NDArray

from stlc.controller.stage import Stage, Staged
from stlc.diagnostics import StlcError
from stlc.escape import file_part, picture
from stlc.rundir import RunDir
from stlc.trace import Trace, load_trace
from stlc.view import bullet
from stlc.view.chart import Chart, chart_film, chart_of
from stlc.view.film import MAX_BYTES, MAX_FRAMES, Film, Taped, encoder, save_film, save_still
from stlc.view.judged import Event, Judged, events_of, judged_in, marks, monitor_of, strip_of, trace_names
from stlc.view.scene import LegendKey, Scene, Staging, frames_of, keys_of, ratio_of, scene_film
from stlc.view.signals import Strip, decisions_of, signal_film

if TYPE_CHECKING:
    from stlc.controller.world import WorldType

SCENE = "scene.npz"
TRACE = "trace.npz"
SYSTEM = "system.yaml"
RESULT = "eval/simulate.json"
STILL = "scene.png"
UNGUARDED = ("eval/unguarded_trace.npz", "eval/unguarded_scene.npz")
"""Trace and scene of the same seed without the guard."""
PANEL = 5.8
"""Width of one run on a page, in inches."""


@dataclass(frozen=True, slots=True)
class Animation:
    """The files of an animation; without ffmpeg there is no video."""

    gif: Path
    mp4: Path | None


def film_of(run: RunDir, *, title: str | None = None) -> Film | None:
    """Film of the run's deployment; None where nothing was recorded.

    The default title names specification, scenario and run.

    The scene is drawn by its world, loaded from the folder. Without a world, or if it fails, the film shows
    the paths of the trace over the regions of its specification, else the signals.
    """
    title = _title(run) if title is None else title
    return _scene_film(run, title) or _signal_film(run, title)


def film_name(run: RunDir) -> str:
    """File name of the run's animation, without a suffix: that of its specification."""
    return file_part(str(run.record().get("spec", "")), empty="deployment")


def animate(run: RunDir, *, max_frames: int = MAX_FRAMES, max_bytes: int = MAX_BYTES) -> Animation | None:
    """Animate the deployment of `run` into its folder, with a still beside it.

    Args:
        run: a simulated run.
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


def current(run: RunDir) -> bool:
    """True if the animation in the folder shows the newest deployment."""
    gif = run.path / f"{film_name(run)}.gif"
    recorded = [run.path / name for name in (SCENE, TRACE) if (run.path / name).exists()]
    return gif.exists() and all(gif.stat().st_mtime >= record.stat().st_mtime for record in recorded)


@dataclass(frozen=True, slots=True)
class Seen:
    """A recorded scene with its world.

    Attributes:
        scene: snapshots stacked to (frames, …), and `violated` (frames, agents) if verdicts are known.
        world: draws them.
        dt: seconds between them.
        judged: verdict on the agents; None if they cannot be judged.
        events: violations of all requirements.
    """

    scene: Scene
    world: WorldType
    dt: float
    judged: Judged | None = None
    events: tuple[Event, ...] = ()

    @property
    def stage(self) -> Stage | None:
        """The 3D stage of the robots; None if the world has none."""
        return self.world.stage(self.scene) if isinstance(self.world, Staged) else None

    @property
    def own_keys(self) -> Mapping[str, str]:
        """Legend entries of the world."""
        return getattr(self.world, "KEYS", {})

    @property
    def frames(self) -> int:
        """Number of instants."""
        return frames_of(self.scene)

    @property
    def strip(self) -> Strip | None:
        """Strip charts; None if margins or decisions are unknown."""
        decisions = self.scene.get("decision")
        if self.judged is None or decisions is None:
            return None
        return strip_of(self.judged, decisions.astype(np.int64))


def seen_in(run: RunDir, *, guarded: bool = True) -> Seen | None:
    """The scene of the run's deployment; None without one, or if its world cannot be loaded.

    With `guarded` false: the same seed simulated without the guard, if recorded.
    """
    from stlc.controller.world import world_type
    from stlc.dynamics.declaration.load import load_system_decl
    from stlc.dynamics.scenarios.scenario import under

    trace_name, scene_name = (TRACE, SCENE) if guarded else UNGUARDED
    scene = _load_scene(run.path / scene_name)
    if scene is None:
        return None
    try:
        decl = load_system_decl(run.path / SYSTEM)
        scenario = _scenario(run)
        decl = decl if scenario is None else under(decl, scenario)
        world = None if decl.test.world is None else world_type(decl)
    except StlcError:
        return None
    if world is None:
        return None
    judged = _judged(run, trace_name, scene)
    if judged is None:
        return Seen(scene, world, float(decl.dt))
    events = events_of(judged.drove, judged.drove.traces)
    marked = marks(events, frames_of(scene), judged.drove.traces, judged.marked)
    return Seen({**scene, "violated": marked}, world, float(decl.dt), judged, tuple(events))


def _judged(run: RunDir, trace_name: str, scene: Scene) -> Judged | None:
    """Verdict on a scene's agents; None if the trace is of another deployment or cannot be judged."""
    decisions = scene.get("decision")
    if decisions is None:
        return None
    try:
        trace = load_trace(run.path / trace_name)
        if trace.samples != frames_of(scene) or trace.traces < decisions.shape[1]:
            return None
        return judged_in(trace, decisions.shape[1], system=run.path / SYSTEM)
    except StlcError:
        return None


def _scene_film(run: RunDir, title: str) -> Film | None:
    seen = seen_in(run)
    if seen is None:
        return None
    try:
        stage = seen.stage if bullet.available() else None
        draw = seen.world.draw if stage is None else bullet.stage_drawing(stage)
        return scene_film(seen.scene, Staging(draw, seen.dt, title, seen.own_keys, seen.strip))
    except Exception:  # whatever a world's own code raises: there are other pictures
        return None


# ------------------------------------------------------------------------------ for a page


@dataclass(frozen=True, slots=True)
class Shot:
    """One closed-loop run as shown on a page.

    Attributes:
        title: name of the guard; empty for a single run.
        alt: description in words.
        frames: number of instants.
        dt: seconds between them.
        t0: time of the first frame, s.
        keys: legend entries.
        strip: strip charts.
        events: violations.
        names: of the agents.
        requirements: names of the requirements judged.
        taped: records the drawing of given frames.
    """

    title: str
    alt: str
    frames: int
    dt: float
    t0: float
    keys: tuple[LegendKey, ...]
    strip: Strip | None
    events: tuple[Event, ...]
    names: tuple[str, ...]
    requirements: tuple[str, ...]
    taped: Callable[[range], Taped]

    def time(self, sample: int) -> float:
        """Time of a sample, seconds."""
        return self.t0 + sample * self.dt


WITHOUT, WITH = "without the guard", "with the guard"


def shots_of(run: RunDir) -> list[Shot]:
    """Shots of the newest deployment for a page: the first seed without and with the guard.

    One shot without a comparison; signals of the trace if there is no world; empty without a recording.
    """
    shots = []
    for guarded, title in ((False, WITHOUT), (True, WITH)):
        seen = seen_in(run, guarded=guarded)
        if seen is not None:
            shots.append((seen, title))
    if shots and shots[-1][1] == WITH:
        same = len(shots) > 1 and shots[0][0].frames == shots[1][0].frames
        chosen = shots if same else shots[-1:]
        try:
            return [_scene_shot(seen, title if same else "") for seen, title in chosen]
        except Exception:  # whatever a world's own code raises: there are other pictures
            pass
    return _trace_shots(run)


def _scene_shot(seen: Seen, title: str) -> Shot:
    judged, agents = seen.judged, seen.scene["decision"].shape[1] if "decision" in seen.scene else 0
    ratio = ratio_of(seen.world.draw, seen.scene)
    size = (PANEL, round(PANEL * ratio, 2))

    def record(shown: range) -> Taped:
        from stlc.view.tape import taped

        return taped(lambda axes, index: seen.world.draw(axes, seen.scene, index), shown, size)

    record(range(1))  # errors of a world's drawing code are raised here, not while the page is written
    return Shot(
        title=title,
        alt=f"{agents} agents drive {title}".strip(),
        frames=seen.frames,
        dt=seen.dt,
        t0=0.0 if judged is None else judged.trace.t0,
        keys=tuple(keys_of(seen.scene, seen.own_keys)),
        strip=seen.strip,
        events=seen.events,
        names=tuple(f"agent {agent}" for agent in range(agents)),
        requirements=() if judged is None else tuple(j.name for j in judged.drove),
        taped=record,
    )


def _trace_shots(run: RunDir) -> list[Shot]:
    """One shot of the trace: its paths over regions, or its signals."""
    film = _signal_film(run, "")
    if film is None:
        return []
    trace = load_trace(run.path / TRACE)

    def record(shown: range) -> Taped:
        from stlc.view.tape import taped_film

        return taped_film(film, shown)

    try:
        judged = judged_in(trace, trace.traces, system=run.path / SYSTEM)
    except StlcError:
        judged = None
    return [
        Shot(
            title="",
            alt=film.alt,
            frames=film.frames,
            dt=film.dt,
            t0=trace.t0,
            keys=(),
            strip=None if judged is None else strip_of(judged, _decisions_shown(trace)),
            events=() if judged is None else tuple(events_of(judged.drove, trace.traces)),
            names=tuple(trace_names(trace)),
            requirements=() if judged is None else tuple(j.name for j in judged.drove),
            taped=record,
        )
    ]


def _decisions_shown(trace: Trace) -> NDArray[np.int64] | None:
    """Source of the decision at every sample, (samples, traces); None if not recorded."""
    decided = decisions_of(trace)
    if decided is None or decided.shape[1] != trace.samples - 1:
        return None
    return np.concatenate((decided.T, decided.T[-1:]))


def _scenario(run: RunDir) -> str | None:
    """The scenario of the newest deployment, if any."""
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
    """The map of a trace; None if its specification names no regions."""
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
