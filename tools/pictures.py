"""The pictures in docs/img: the animation of the README, a still of each world, traffic in motion.

    python tools/pictures.py --runs runs

deploys the newest run of every specification (seed 0, with the paper's backup policy, and without it for
comparison) and takes the instant with most interventions. The animation shows the ships of `ship_track.stl`
under its scenario `shifted`: four ships of each of the seeds 0 to 9 are simulated, and the first seed is
shown in which a ship violates safety without the guard while all starts are viable (a plan search succeeds).
It ends soon after the last ship ran aground. That last picture is also the first one, so that a still of the
animation shows its result.
"""

from __future__ import annotations

import argparse
import io
import json
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.patches import Circle, Rectangle
from numpy.typing import NDArray

from stlc.cli.framework.app import main as stlc
from stlc.controller.sketch import (
    BANK,
    DECIDED,
    NOTE,
    STONE,
    VIOLATED,
    WATER,
    Scene,
    deciders,
    outlines,
    plans,
    tails,
)
from stlc.files import File
from stlc.rundir import RunDir
from stlc.view.animation import Animation, clear_artists, save_animation, save_still
from stlc.view.run_animation import RecordedScene, animation_of, recorded_scene
from stlc.view.style import INK, MUTED

ROOT = Path(__file__).resolve().parent.parent
WORLDS = (
    ("traffic", None),
    ("reach_n_avoid", None),
    ("ship_safe", None),
    ("ship_track", None),
    ("ship_track", "shifted"),
    ("navigation", None),
    ("manipulation", None),
)
MOVING = "traffic"
MAX_BYTES = 700_000

SHIPS, SEEDS = 4, range(10)
SECONDS = 12.0
AFTER, HELD = 1.8, 2.5  # s of the animation after the last ship ran aground; s for which its result is shown
BEHIND, AHEAD = 2.0, 2.0  # m of the river behind the first and ahead of the last place of a ship
LARGE, BOLD, SMALL = 17, 14.5, 13  # font size in points: half as large on a telephone
LEAD_BYTES = 950_000


def draw(spec: str, scenario: str | None, runs: Path, folder: Path) -> Iterator[Path]:
    """Deploy the newest run of `spec` and draw it; yields the written files."""
    run = RunDir.open(spec, runs)
    _simulate(run, scenario, "--seeds", "0")
    animation = animation_of(run, title=" · ".join(part for part in (spec, scenario) if part))
    if animation is None:
        raise SystemExit(f"{run.shown} could not be drawn")
    name = "-".join(part for part in (spec, scenario) if part)
    yield save_still(animation, folder / f"{name}.webp")
    if name == MOVING:
        path = folder / f"{name}.gif"
        save_animation(animation, path, max_bytes=MAX_BYTES)
        yield path


def _simulate(run: RunDir, scenario: str | None, *more: str) -> None:
    under = [] if scenario is None else ["--scenario", scenario]
    if stlc(["simulate", str(run.path), "--backup", "--no-pictures", *under, *more]):
        raise SystemExit(f"{run.shown} could not be deployed")


# ------------------------------------------------------------------------------- the animation


@dataclass(frozen=True, slots=True)
class Unsafe:
    """Numbers of unsafe ships of a seed, without and with the guard, and of non-viable ones."""

    without: set[int]
    guarded: set[int]
    lost: set[int]


def lead(runs: Path, folder: Path, seed: int | None = None) -> Iterator[Path]:
    """The animation at the head of the README; its seed is chosen unless given. Yields the written files."""
    run = RunDir.open("ship_track", runs)
    size = ("--agents", str(SHIPS), "--steps", str(round(SECONDS / 0.15)))
    seed = _chosen(run, size) if seed is None else seed
    _simulate(run, "shifted", "--seeds", str(seed), *size)
    without, guarded = recorded_scene(run, guarded=False), recorded_scene(run)
    assert without is not None
    assert guarded is not None
    path = folder / "guard.webp"
    animation = lead_animation(without, guarded)
    last = animation.frames - 1
    pictures = list(animation.images([last, *range(last)], 100))
    durations = [round(1000 * HELD), *[round(1000 * without.dt)] * last]
    for quality in range(80, 20, -8):
        buffer = io.BytesIO()
        pictures[0].save(
            buffer,
            format="webp",
            save_all=True,
            append_images=pictures[1:],
            duration=durations,
            loop=0,
            quality=quality,
            method=5,
        )
        if len(buffer.getvalue()) <= LEAD_BYTES:
            break
    File(path).write(buffer.getvalue())
    yield path


def _chosen(run: RunDir, size: tuple[str, ...]) -> int:
    """The first seed in which a ship is unsafe without the guard, and every start is viable."""
    _simulate(run, "shifted", "--seeds", f"{SEEDS[0]}..{SEEDS[-1]}", *size)
    unsafe = unsafe_in(run)
    told = ", ".join(f"{sum(len(getattr(u, name)) for u in unsafe)} {word}" for name, word in _TOLD.items())
    print(f"of {SHIPS * len(SEEDS)} ships: {told}", file=sys.stderr)
    seed = next(seed for seed, found in zip(SEEDS, unsafe, strict=True) if found.without and not found.lost)
    print(f"shown is seed {seed}", file=sys.stderr)
    return seed


_TOLD = {"without": "unsafe without the guard", "guarded": "with it", "lost": "cannot be saved"}


def unsafe_in(run: RunDir) -> list[Unsafe]:
    """Unsafe ships of each seed in the newest deployment."""
    document = json.loads((run.path / RunDir.SIMULATION).read_text(encoding="utf-8"))
    found = []
    for seed in document["seeds"]:
        each = {
            guard: [ship for ship in measured["unsafe"] if ship["seed"] == seed]
            for guard, measured in document["guards"].items()
        }
        lost = {ship["agent"] for ships in each.values() for ship in ships if not ship["savable"]}
        without, guarded = ({ship["agent"] for ship in each[guard]} for guard in ("none", "paper"))
        found.append(Unsafe(without, guarded, lost))
    return found


def lead_animation(without: RecordedScene, guarded: RecordedScene) -> Animation:
    """Film of both runs, one above the other, until soon after the last ship ran aground."""
    hits = [first_hits(seen) for seen in (without, guarded)]
    counts = [sum(np.isfinite(hit)) for hit in hits]
    scenes = [_stopped(seen.scene, hit) for seen, hit in zip((without, guarded), hits, strict=True)]
    last_hit = max(int(hit[np.isfinite(hit)].max(initial=0)) for hit in hits)
    frames = min(without.frames, last_hit + round(AFTER / without.dt) + 1)
    places = np.concatenate([scene["ships"][:frames, :, 0] for scene in scenes])
    view = float(places.min()) - BEHIND, float(places.max()) + AHEAD
    words = f"{SHIPS} ships on a river the policy has not seen:\n{_sentence(*counts)}"

    hull = sys.modules[without.world.__module__].HULL  # in metres, as the world has it

    def begin(figure: Any) -> Any:
        figure.set_layout_engine("none")
        figure.text(0.02, 0.975, words, fontsize=LARGE, weight="bold", color=INK, va="top", linespacing=1.25)
        clock = figure.text(0.98, 0.94, "", fontsize=SMALL, color=INK, ha="right", va="center")
        panels, told = [], []
        for row, title in enumerate(("without the guard", "with the guard")):
            foot = 0.5 - 0.39 * row
            figure.text(0.02, foot + 0.335, title, fontsize=BOLD, weight="bold", color=INK, va="center")
            told.append(
                figure.text(0.98, foot + 0.335, "", fontsize=BOLD, weight="bold", ha="right", va="center")
            )
            panels.append(figure.add_axes((0, foot, 1, 0.3)))
        _legend(figure, view[1] - view[0])

        def turn(index: int) -> None:
            clock.set_text(f"{index * without.dt:.1f} s")
            for axes, scene, hit, text in zip(panels, scenes, hits, told, strict=True):
                clear_artists(axes)
                _river(axes, scene, hull, index, view, hit <= index)
                aground = int((hit <= index).sum())
                text.set_text(f"{aground or 'none'} of {SHIPS} aground")
                text.set_color(VIOLATED if aground else MUTED)

        return turn

    return Animation(frames, without.dt, (7.8, 5.6), begin, words.replace("\n", " "))


def _sentence(without: int, guarded: int) -> str:
    run = "runs" if without == 1 else "run"
    return f"{without} {run} aground without the guard, {guarded or 'none'} with it"


def first_hits(seen: RecordedScene) -> NDArray[np.float64]:
    """First frame in which each ship violates safety, (ships,); infinity for never."""
    assert seen.judged is not None
    hits = np.full(seen.scene["ships"].shape[1], np.inf)
    for event in seen.events:
        if event.requirement in seen.judged.marked:
            hits[event.agent] = min(hits[event.agent], event.sample)
    return hits


def _stopped(scene: Scene, hits: NDArray[np.float64]) -> Scene:
    """The scene with ships that stay where they ran aground, at frames `hits`, and plan no more.

    All plans in place of the policy's count as the guard's, of whichever of its stages they are.
    """
    found = {name: np.array(values) for name, values in scene.items()}
    found["decision"] = np.minimum(found["decision"], 1)
    for ship in np.flatnonzero(np.isfinite(hits)):
        hit = int(hits[ship])
        found["ships"][hit:, ship] = found["ships"][hit, ship]
        for name in {"rejected", "taken"} & found.keys():
            found[name][hit:, ship] = np.nan
    return found


def _river(
    axes: Any,
    scene: Scene,
    hull: NDArray[np.float64],
    index: int,
    view: tuple[float, float],
    aground: NDArray[np.bool_],
) -> None:
    """Draw a stretch of the river, in metres; a dot is the centre of a ship, which is what is judged."""
    (left, right), half = view, float(scene["half"][index])
    axes.add_patch(Rectangle((left, -half - 1), right - left, 2 * half + 2, color=BANK, lw=0))
    axes.add_patch(Rectangle((left, -half), right - left, 2 * half, color=WATER, lw=0))
    axes.plot((-100, 400), (0, 0), color="white", lw=1.2, ls=(0, (8, 8)), zorder=1.5)
    for x, y, r in scene["obstacles"][index]:
        if left - r < x < right + r:
            axes.add_patch(Circle((x, y), r, color=STONE, lw=0, zorder=2))
    ships = scene["ships"]
    tails(axes, ships[..., :2], scene, index, frames=16)
    plans(axes, scene, index)
    outlines(axes, hull, ships[index][~aground], deciders(scene, index, ships.shape[1])[~aground])
    outlines(axes, hull, ships[index][aground], np.zeros(0, dtype=np.int64), color=NOTE)
    axes.plot(*ships[index, :, :2].T, "o", ms=4, color="white", mew=0, zorder=3.4)
    axes.plot(*ships[index][aground, :2].T, "o", ms=24, mfc="none", mec=VIOLATED, mew=2.2, zorder=3.6)
    axes.set(xlim=(left, right), ylim=(-half - 0.35, half + 0.35), aspect="equal")
    axes.set_axis_off()


def _legend(figure: Any, metres: float) -> None:
    """Draw the legend, and a scale bar; the picture is `metres` wide."""
    from matplotlib.lines import Line2D

    handles = [
        Line2D([], [], marker="s", ls="", ms=9, mew=0, color=DECIDED[0], label="policy"),
        Line2D([], [], marker="s", ms=9, mew=0, color=DECIDED[1], lw=3, label="guard, its plan"),
        Line2D([], [], color=VIOLATED, lw=2.4, ls=(0, (2.5, 1.5)), label="rejected plan"),
        Line2D([], [], marker="o", ls="", ms=11, mew=2.2, mfc="none", mec=VIOLATED, label="aground"),
        Line2D([], [], marker="o", ls="", ms=6, mew=3, mfc="white", mec=NOTE, label="centre, judged"),
    ]
    figure.legend(
        handles=handles,
        loc="center left",
        bbox_to_anchor=(0.0, 0.05),
        ncols=5,
        fontsize=SMALL,
        handlelength=1.3,
        handletextpad=0.3,
        columnspacing=0.8,
        frameon=False,
        labelcolor=INK,
    )
    axes = figure.add_axes((0.4, 0.8, 0.2, 0.07))
    axes.set(xlim=(0, 0.2 * metres), ylim=(-0.5, 1), aspect="equal")
    axes.set_axis_off()
    axes.plot((0.4, 2.4), (0, 0), color=NOTE, lw=2)
    axes.text(2.6, 0, "2 m", fontsize=SMALL, color=NOTE, va="center")


def main() -> int:
    """Draw all pictures, or the named ones."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--runs", type=Path, default=Path("runs"))
    parser.add_argument("--output", type=Path, default=ROOT / "docs/img")
    parser.add_argument("--seed", type=int, help="of the animation, where it was chosen before")
    parser.add_argument(
        "names", nargs="*", help="specifications, or `guard` for the animation; by default all"
    )
    given = parser.parse_args()
    written = (
        [lead(given.runs, given.output, given.seed)] if not given.names or "guard" in given.names else []
    )
    for spec, scenario in WORLDS:
        if not given.names or spec in given.names:
            written.append(draw(spec, scenario, given.runs, given.output))
    for path in (path for some in written for path in some):
        print(f"{path.stat().st_size / 1000:6.0f} kB  {path}", file=sys.stderr)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
