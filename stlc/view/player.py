"""The animation at the head of the report: playback, scrubbing, and jumps to violations.

Without scripts the page shows a still. The animation is stored as drawing commands
(`stlc.view.vector`), not as pixels: it is sharp at every width and follows the reader's light or dark scheme;
`player.js` replays it.
"""

from __future__ import annotations

import base64
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from importlib.resources import files
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stlc.compile.semantics.semantics import TOLERANCE
from stlc.escape import script_json
from stlc.jsontext import dumps
from stlc.monitor.judgement import beside
from stlc.view.animation import VectorAnimation, dark_colors, speed_up, still_bytes
from stlc.view.contents import RunContents
from stlc.view.html import Child, Html, Section, classed, el, join, table
from stlc.view.run_animation import STILL, RunPanel, animation_name, animation_of, current, run_panels
from stlc.view.signals import Strip, finite, margin_limits, margin_text
from stlc.view.style import SCENES_ON_DARK
from stlc.view.verdicts import Event
from stlc.view.words import count, labelled

SCRIPT = "player.js"
MOST_FRAMES = 160
"""Maximum number of frames of the page's animation; others are subsampled evenly."""
MOST_ROWS = 60
"""Maximum number of listed events per requirement."""
_WIDE, _HIGH = 1000, 40  # of a track


@dataclass(frozen=True, slots=True)
class _Track:
    """A strip chart of the page: its name, its curve, and its value at every frame."""

    name: str
    curve: Html
    values: list[str | None]


def player_section(contents: RunContents) -> Section | None:
    """The animation of the newest deployment; None without a recording."""
    panels = run_panels(contents.run)
    if not panels:
        return None
    frames = min(panel.frames for panel in panels)
    shown = range(0, frames, -(-frames // MOST_FRAMES))
    animations = [panel.vector_frames(shown) for panel in panels]
    tracks = [_tracks(panel, shown) for panel in panels]
    head = el(
        "div",
        _keys(panels),
        _stage(panels, animations, contents),
        _data(panels, animations, tracks, shown),
        _controls(len(shown)),
        _columns(panels, tracks),
        attrs={"class": "player", "tabindex": "0"},
    )
    return Section("film", "", join(head, _files(contents), _events(panels)))


def script() -> Html:
    """Script of the page; it loads nothing else."""
    return Html((files("stlc.view") / SCRIPT).read_text(encoding="utf-8"))


# ------------------------------------------------------------------------------- stage


def _stage(panels: Sequence[RunPanel], animations: Sequence[VectorAnimation], contents: RunContents) -> Html:
    """A canvas for each run, and a still for readers without scripts."""
    figures = [
        el(
            "figure",
            el("figcaption", panel.title) if panel.title else None,
            el(
                "canvas",
                attrs={
                    "role": "img",
                    "aria-label": panel.alt,
                    "width": str(animation.width),
                    "height": str(animation.height),
                },
            ),
        )
        for panel, animation in zip(panels, animations, strict=True)
    ]
    wide = " wide" if len(panels) > 1 and animations[0].width > 2 * animations[0].height else ""
    kind = f"panels{wide}" if len(panels) > 1 else "panels one"
    return join(classed("div", kind, figures), el("noscript", _still(contents)))


def _still(contents: RunContents) -> Html | None:
    """The still of the animation, drawn if it is missing."""
    path = contents.run.path / STILL
    if current(contents.run) and path.is_file():
        kind, content = "png", path.read_bytes()
    else:
        animation = animation_of(contents.run)
        if animation is None:
            return None
        kind, content = "webp", still_bytes(animation)
    address = f"data:image/{kind};base64," + base64.b64encode(content).decode()
    return el("img", attrs={"src": address, "alt": "the deployment at its most telling instant"})


def _controls(frames: int) -> Html:
    slide = {
        "type": "range",
        "min": "0",
        "max": str(frames - 1),
        "step": "1",
        "value": "0",
        "aria-label": "time",
    }
    return classed(
        "div",
        "controls",
        el("button", "Play", attrs={"class": "play", "type": "button"}),
        el("button", "-1", attrs={"type": "button", "data-step": "-1", "aria-label": "one step back"}),
        el("button", "+1", attrs={"type": "button", "data-step": "1", "aria-label": "one step on"}),
        el("input", attrs=slide),
        el("output", "0 s"),
    )


def _keys(panels: Sequence[RunPanel]) -> Html:
    """The legend of all runs."""
    keys = {key.word: key for panel in panels for key in panel.keys}
    swatches = [
        classed(
            "span",
            "whole",
            el("span", attrs={"class": f"key {key.kind}", "style": _inks(key.color)}),
            key.word,
        )
        for key in keys.values()
    ]
    return classed("p", "keys", swatches)


def _inks(color: str) -> str:
    """Inline style of a colour in the light and in the dark scheme."""
    return f"--day:{color};--dusk:{SCENES_ON_DARK.get(color, color)}"


def _files(contents: RunContents) -> Html | None:
    """The animation as files beside the page."""
    name = animation_name(contents.run)
    there = [
        f"{name}{suffix}" for suffix in (".gif", ".mp4") if (contents.run.path / f"{name}{suffix}").exists()
    ]
    if not there:
        return None
    links = [join(el("a", path, attrs={"href": path}), " ") for path in there]
    return classed("p", "quiet", "The same as a file: ", links)


# ------------------------------------------------------------------------------ tracks


def _columns(panels: Sequence[RunPanel], tracks: Sequence[Sequence[_Track]]) -> Html:
    columns = []
    for panel, own in zip(panels, tracks, strict=True):
        if not own:
            continue
        rows = [
            classed(
                "div",
                "track",
                classed("span", "name", track.name),
                classed("div", "plot", track.curve, classed("div", "cursor")),
                classed("span", "value"),
            )
            for track in own
        ]
        times = panel.strip.times if panel.strip is not None else np.zeros(1)
        foot = classed("div", "track axis", el("span"), classed("div", "ends", _ends(times)), el("span"))
        words = f"{panel.strip.words}, red where violated" if panel.strip is not None else ""
        words = f"{panel.title}: {words}" if panel.title else words
        columns.append(classed("div", "tracks", classed("p", "quiet", words), rows, foot))
    return classed("div", "columns", columns)


def _ends(times: NDArray[np.float64]) -> list[Html]:
    return [el("span", f"{times[0]:g} s"), el("span", f"{times[-1]:g} s")]


def _tracks(panel: RunPanel, shown: range) -> list[_Track]:
    strip = panel.strip
    if strip is None:
        return []
    rows = [_acted(strip, shown)] if strip.acted.any() else []
    return rows + [_margin(strip, name, shown) for name in strip.rows]


def _acted(strip: Strip, shown: range) -> _Track:
    assert strip.decisions is not None
    agents = strip.decisions.shape[1]
    top = max(int(strip.acted.max()), 1)
    areas = [
        _path(_area(strip.times, _up(low, top), _up(high, top)), "acted", style=_inks(color))
        for color, low, high in strip.stacked()
    ]
    values: list[str | None] = [f"{int(strip.acted[index])} of {agents}" for index in shown]
    return _Track("guard acted", _svg(areas), values)


def _margin(strip: Strip, name: str, shown: range) -> _Track:
    rho, unit = finite(strip.margins[name]), strip.units.get(name, "")
    low, high = margin_limits(rho)
    fails = rho < -TOLERANCE

    def up(values: NDArray[np.float64]) -> NDArray[np.float64]:
        return _up(np.clip(values, low, high) - low, high - low)

    zero = up(np.zeros(len(rho)))
    good, bad = np.where(fails, np.nan, rho), np.where(fails, rho, np.nan)
    parts = [
        _path(f"M0 {zero[0]:.1f}H{_WIDE}", "zero"),
        _path(_area(strip.times, zero, up(good)), "spare"),
        _path(_area(strip.times, zero, up(bad)), "lost"),
        _path(_line(strip.times, up(rho)), "line"),
        _path(_line(strip.times, up(bad)), "line lost"),
    ]
    values = [margin_text(float(rho[index]), unit) or None for index in shown]
    return _Track(labelled(name, unit), _svg(parts), values)


def _path(outline: str, kind: str, **attrs: str) -> Html:
    return el("path", attrs={"d": outline, "class": kind, **attrs})


def _svg(parts: Iterable[Html]) -> Html:
    box = {"viewBox": f"0 0 {_WIDE} {_HIGH}", "preserveAspectRatio": "none", "aria-hidden": "true"}
    return el("svg", parts, attrs=box)


def _up(values: NDArray[np.float64], span: float) -> NDArray[np.float64]:
    """Vertical coordinates of values in a track, from its upper edge."""
    return np.asarray(_HIGH - _HIGH * values / (span or 1.0))


def _across(times: NDArray[np.float64]) -> NDArray[np.float64]:
    span = float(times[-1] - times[0]) or 1.0
    return np.asarray(_WIDE * (times - times[0]) / span)


def _line(times: NDArray[np.float64], heights: NDArray[np.float64]) -> str:
    """SVG path of a step function, with gaps at NaN."""
    words, last = list[str](), np.nan
    for x, y in zip(_across(times), heights, strict=True):
        if np.isnan(y):
            if not np.isnan(last):
                words.append(f"H{x:.1f}")
        elif np.isnan(last):
            words.append(f"M{x:.1f} {y:.1f}")
        elif y != last:
            words.append(f"H{x:.1f}V{y:.1f}")
        last = y
    if not np.isnan(last):
        words.append(f"H{_WIDE}")
    return "".join(words)


def _area(times: NDArray[np.float64], base: NDArray[np.float64], heights: NDArray[np.float64]) -> str:
    """SVG path of the area between two step functions."""
    x = np.append(_across(times), _WIDE)
    words, begin = list[str](), 0
    same = (heights[1:] == heights[:-1]) & (base[1:] == base[:-1])
    edges = [0, *(np.flatnonzero(~same) + 1).tolist(), len(heights)]
    for begin, end in pairwise(edges):
        if np.isfinite(heights[begin]) and heights[begin] != base[begin]:
            words.append(
                f"M{x[begin]:.1f} {base[begin]:.1f}V{heights[begin]:.1f}H{x[end]:.1f}V{base[begin]:.1f}z"
            )
    return "".join(words)


# ------------------------------------------------------------------------------ events


def _events(panels: Sequence[RunPanel]) -> Html | None:
    """List of violations by requirement; each line links to its instant."""
    names = list(dict.fromkeys(name for panel in panels for name in panel.requirements))
    if not names:
        return None
    blocks = []
    for name in names:
        rows = [(panel, event) for panel in panels for event in panel.events if event.requirement == name]
        rows.sort(key=lambda row: row[1].sample)
        counts = [sum(1 for own, _ in rows if own is panel) for panel in panels]
        told = ", ".join(
            f"{count(number, 'violation')} {panel.title}".strip()
            for number, panel in zip(counts, panels, strict=True)
        )
        summary = el("summary", name, " ", classed("span", "bad" if rows else "quiet", told))
        if rows:
            blocks.append(el("details", summary, _event_table(rows[:MOST_ROWS], len(rows))))
        else:
            blocks.append(classed("p", "none", el("strong", name), " ", classed("span", "quiet", told)))
    return classed("div", "events", el("h3", "Violations in this animation"), blocks)


def _event_table(rows: list[tuple[RunPanel, Event]], count_: int) -> Html:
    several = any(panel.title for panel, _ in rows)
    header = ["when", *(["drive"] if several else []), "who", "why"]
    cells: list[list[Child]] = []
    for panel, event in rows:
        moment, start = (f"t = {panel.time(sample):.10g} s" for sample in (event.sample, event.start))
        at = {"type": "button", "data-at": f"{panel.time(event.sample) - panel.time(0):.9g}"}
        button = el("button", f"{panel.time(event.sample):.4g} s", attrs=at)
        window = beside(moment, start).removeprefix(moment).strip()
        when: Child = join(button, el("small", window) if window else None)
        drive: list[Child] = [panel.title] if several else []
        cells.append([when, *drive, panel.names[event.agent], event.because])
    more = el("p", f"and {count_ - len(rows):,} more") if count_ > len(rows) else None
    return join(table(header, cells, kind="jump"), more)


# -------------------------------------------------------------------------------- data


def _data(
    panels: Sequence[RunPanel],
    animations: Sequence[VectorAnimation],
    tracks: Sequence[Sequence[_Track]],
    shown: range,
) -> Html:
    """The replayed data as JSON, escaped for a `<script>` element."""
    dt = panels[0].dt
    document: dict[str, Any] = {
        "times": [round(index * dt, 9) for index in shown],
        "digits": 1 if dt >= 0.1 else 2,
        "pace": speed_up(panels[0].frames, dt),
        "dark": dict(dark_colors(animations, SCENES_ON_DARK)),
        "panels": [animation.as_json() for animation in animations],
        "rows": [track.values for own in tracks for track in own],
    }
    text = script_json(dumps(document))
    return el("script", Html(text), attrs={"type": "application/json", "id": "animation-data"})
