"""Animation of a closed-loop run: the drawing of its world (simulated environment), a map, or signals.

The map shows the paths over the regions of the specification. It is drawn if there is no world. Signals are
drawn if there is neither a world nor a region.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from stlc.controller.stage import Stage, Staged
from stlc.diagnostics import StlcError
from stlc.escape import file_part
from stlc.rundir import RunDir
from stlc.source import Source
from stlc.trace import Trace
from stlc.trace.formats.npz import read_arrays
from stlc.view import bullet
from stlc.view.animation import (
    MAX_BYTES,
    MAX_FRAMES,
    Animation,
    VectorAnimation,
    save_animation,
    save_still,
)
from stlc.view.contents import archived, readable, simulation_of
from stlc.view.region_map import RegionMap, map_animation, map_of
from stlc.view.scene import LegendKey, Scene, SceneOptions, frames_of, keys_of, ratio_of, scene_animation
from stlc.view.signals import Strip, decisions_of, signal_animation
from stlc.view.style import picture
from stlc.view.verdicts import (
    Event,
    SceneVerdicts,
    events_of,
    judge_agents,
    marks,
    monitor_of,
    strip_of,
    trace_names,
    violating,
)

if TYPE_CHECKING:
    from stlc.controller.world import WorldType

STILL = "scene.png"
PANEL = 5.8
"""Width of one run on a page, in inches."""


def animation_of(run: RunDir, *, title: str | None = None) -> Animation | None:
    """Return the animation of the run's latest closed-loop simulation; None if nothing was recorded.

    The scene is drawn by the world (simulated environment), which is loaded from the run's folder. Without a
    world, or if drawing fails, the animation shows the paths of the trace over the regions of its
    specification. Without regions, it shows the signals. The default title consists of specification,
    scenario and run.
    """
    if title is None:
        spec = str(run.record().get("spec", ""))
        title = picture(" · ".join(part for part in (spec, _scenario(run), run.name) if part))
    return _scene_animation(run, title) or _signal_animation(run, title)


def animation_name(run: RunDir) -> str:
    """File name of the run's animation without suffix: the name of its specification."""
    return file_part(str(run.record().get("spec", "")), empty="deployment")


def animate(run: RunDir, *, max_frames: int = MAX_FRAMES, max_bytes: int = MAX_BYTES) -> Path | None:
    """Write the animation of the closed-loop run of `run` into its folder, with a still picture beside it.

    Args:
        run: a run with a closed-loop simulation.
        max_frames: maximum number of frames. If there are more instants, only every second, third, … instant
            is shown.
        max_bytes: maximum size of the GIF; the picture is made smaller to meet it.

    Returns:
        The path of the GIF, or None if nothing was recorded.

    Raises:
        MissingError: R301, matplotlib or Pillow is missing; R201, a file cannot be written.
    """
    animation = animation_of(run)
    if animation is None:
        return None
    gif = run.place(f"{animation_name(run)}.gif")
    save_still(animation, run.place(STILL))
    save_animation(animation, gif, max_frames=max_frames, max_bytes=max_bytes)
    return gif


def current(run: RunDir) -> bool:
    """True if the animation file in the run's folder is at least as new as the recorded closed-loop run."""
    gif = f"{animation_name(run)}.gif"
    recorded = [run.file(name, RunDir.MOST_ARRAYS) for name in (RunDir.SCENE, RunDir.TRACE) if run.has(name)]
    written = run.file(gif, RunDir.MOST_ARRAYS).stat().st_mtime if run.has(gif) else -math.inf
    return all(written >= record.stat().st_mtime for record in recorded)


@dataclass(frozen=True, slots=True)
class RecordedScene:
    """A recorded scene with the world (simulated environment) that draws it.

    Attributes:
        scene: name -> recorded values, (frames, …). If verdicts are known, `violated`, (frames, agents), is
            added: True where a violation is marked.
        world: draws the scene.
        dt: seconds between frames.
        judged: verdicts on the agents; None if they cannot be evaluated.
        events: violations of all requirements.
    """

    scene: Scene
    world: WorldType
    dt: float
    judged: SceneVerdicts | None = None
    events: tuple[Event, ...] = ()

    @property
    def stage(self) -> Stage | None:
        """Joint angles of the robots, and the balls around them, to be drawn by PyBullet.

        None if the world contains no such robots.
        """
        return self.world.stage(self.scene) if isinstance(self.world, Staged) else None

    @property
    def own_keys(self) -> Mapping[str, str]:
        """Legend entries that the world (simulated environment) adds: label -> colour."""
        return getattr(self.world, "KEYS", {})

    @property
    def frames(self) -> int:
        """Number of instants."""
        return frames_of(self.scene)

    @property
    def strip(self) -> Strip | None:
        """Strip charts below the scene; None if margins or decisions are unknown."""
        decisions = self.scene.get("decision")
        if self.judged is None or decisions is None:
            return None
        return strip_of(self.judged, decisions.astype(np.int64))


def recorded_scene(run: RunDir, *, guarded: bool = True) -> RecordedScene | None:
    """Return the recorded scene of the run's latest closed-loop simulation.

    If `guarded` is False, the scene of the simulation without the guard is returned, with the same seed.
    Returns None if the scene was not recorded, or if its world (simulated environment) cannot be loaded.
    """
    from stlc.controller.world import world_type
    from stlc.dynamics.load import load_system_decl
    from stlc.dynamics.scenario import under

    trace_name, scene_name = (RunDir.TRACE, RunDir.SCENE) if guarded else RunDir.UNGUARDED
    scene = archived(run, scene_name, read_arrays)
    if not scene or not all(values.ndim and len(values) for values in scene.values()):
        return None
    try:
        decl, scenario = load_system_decl(run.source(RunDir.SYSTEM)), _scenario(run)
        decl = decl if scenario is None else under(decl, scenario)
        if decl.test.world is None:
            return None
        world = world_type(decl)
    except StlcError:
        return None
    found = RecordedScene(scene, world, float(decl.dt))
    judged = readable(lambda: _judged(run, trace_name, scene))
    if judged is None:
        return found
    traces = judged.verdict.traces
    events = events_of(judged.verdict, traces)
    marked = marks(events, found.frames, traces, judged.marked)
    return replace(found, scene={**scene, "violated": marked}, judged=judged, events=tuple(events))


def _judged(run: RunDir, trace_name: str, scene: Scene) -> SceneVerdicts | None:
    """Verdicts on the agents of a scene; None if the trace does not belong to this scene."""
    decisions, trace = scene.get("decision"), archived(run, trace_name, Trace.load)
    if decisions is None or trace is None or trace.samples != frames_of(scene):
        return None
    if trace.traces < decisions.shape[1]:
        return None
    return judge_agents(trace, decisions.shape[1], system=run.source(RunDir.SYSTEM))


def _scene_animation(run: RunDir, title: str) -> Animation | None:
    found = recorded_scene(run)
    if found is None:
        return None
    try:
        stage = found.stage if bullet.available() else None
        draw = found.world.draw if stage is None else bullet.stage_drawing(stage)
        return scene_animation(found.scene, SceneOptions(draw, found.dt, title, found.own_keys, found.strip))
    except Exception:  # whatever a world's own code raises: there are other pictures
        return None


# ------------------------------------------------------------------------------ for a page


@dataclass(frozen=True, slots=True)
class RunPanel:
    """One closed-loop run as shown on a page.

    Attributes:
        title: words that say whether the run has a guard; "" if there is only one run.
        alt: description in words.
        frames: number of instants.
        dt: seconds between frames.
        t0: time of the first frame in seconds.
        keys: legend entries.
        strip: strip charts; None if there is nothing to show in them.
        events: violations.
        names: names of the agents.
        requirements: names of the evaluated requirements.
        vector_frames: function that returns the drawing commands of the given frames.
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
    vector_frames: Callable[[range], VectorAnimation]

    def time(self, sample: int) -> float:
        """Time of a sample in seconds."""
        return self.t0 + sample * self.dt


WITHOUT, WITH = "without the guard", "with the guard"


def run_panels(run: RunDir) -> list[RunPanel]:
    """Panels for a page on the latest closed-loop simulation: its first seed without and with the guard.

    If no simulation without the guard was recorded, there is only one panel. If there is no world (simulated
    environment) to draw the scene, the only panel shows the trace. If nothing was recorded, the list is
    empty.
    """
    found, other = recorded_scene(run), recorded_scene(run, guarded=False)
    try:
        if found is not None and other is not None and found.frames == other.frames:
            return [_scene_panel(other, WITHOUT), _scene_panel(found, WITH)]
        if found is not None:
            return [_scene_panel(found, "")]
    except Exception:  # whatever a world's own code raises: there are other pictures
        pass
    return _trace_panels(run)


def _scene_panel(found: RecordedScene, title: str) -> RunPanel:
    judged, agents = found.judged, found.scene["decision"].shape[1] if "decision" in found.scene else 0
    size = (PANEL, round(PANEL * ratio_of(found.world.draw, found.scene), 2))

    def record(shown: range) -> VectorAnimation:
        from stlc.view.vector import vector_frames

        return vector_frames(lambda axes, index: found.world.draw(axes, found.scene, index), shown, size)

    record(range(1))  # errors of a world's drawing code are raised here, not while the page is written
    return RunPanel(
        title=title,
        alt=f"{agents} agents drive {title}".strip(),
        frames=found.frames,
        dt=found.dt,
        t0=0.0 if judged is None else judged.trace.t0,
        keys=tuple(keys_of(found.scene, found.own_keys)),
        strip=found.strip,
        events=found.events,
        names=tuple(f"agent {agent}" for agent in range(agents)),
        requirements=() if judged is None else tuple(j.name for j in judged.verdict),
        vector_frames=record,
    )


def _trace_panels(run: RunDir) -> list[RunPanel]:
    animation = _signal_animation(run, "")
    if animation is None:
        return []
    trace = Trace.load(run.file(RunDir.TRACE, RunDir.MOST_ARRAYS))

    def record(shown: range) -> VectorAnimation:
        from stlc.view.vector import vector_animation

        return vector_animation(animation, shown)

    judged = readable(lambda: judge_agents(trace, trace.traces, system=run.source(RunDir.SYSTEM)))
    decided = decisions_of(trace)
    if decided is not None:  # one decision per step: the last one is shown at the last sample, too
        whole = decided.shape[1] == trace.samples - 1
        decided = np.concatenate((decided.T, decided.T[-1:])) if whole else None
    return [
        RunPanel(
            title="",
            alt=animation.alt,
            frames=animation.frames,
            dt=animation.dt,
            t0=trace.t0,
            keys=(),
            strip=None if judged is None else strip_of(judged, decided),
            events=() if judged is None else tuple(events_of(judged.verdict, trace.traces)),
            names=tuple(trace_names(trace)),
            requirements=() if judged is None else tuple(j.name for j in judged.verdict),
            vector_frames=record,
        )
    ]


def _scenario(run: RunDir) -> str | None:
    """Name of the scenario of the latest closed-loop simulation; None without one."""
    name: str | None = (simulation_of(run) or {}).get("scenario")
    return name


def _signal_animation(run: RunDir, title: str) -> Animation | None:
    trace = archived(run, RunDir.TRACE, Trace.load)
    if trace is None:
        return None
    region_map = readable(
        lambda: map_of_drives(trace, run.source(RunDir.SYSTEM) if run.has(RunDir.SYSTEM) else None)
    )
    return (
        signal_animation(trace, title=title) if region_map is None else map_animation(region_map, title=title)
    )


def map_of_drives(trace: Trace, system: Source | None, text: str = "") -> RegionMap | None:
    """Map of a trace over the regions that the specification of its plans names; None if it names none.

    Args:
        trace: the recorded trace.
        system: text of the system file, which supplies external functions.
        text: specification to use if the trace stores none.

    Raises:
        StlcError: the trace cannot be evaluated.
    """
    monitor = monitor_of(trace, text, system=system)
    verdict = monitor.check(trace)
    return map_of(monitor.spec, verdict, trace, violating(trace, verdict, system=system))
