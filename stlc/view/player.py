"""Interactive animation at the head of the report: playback, a time slider, and links to violations.

Without scripts the page shows a still picture. The animation is stored as drawing commands
(`stlc.view.vector`), which `player.js` executes: the picture is sharp at every width and follows the reader's
light or dark scheme.
"""

from __future__ import annotations

import base64
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from importlib.resources import files
from typing import Any

import numpy as np

from stlc.compile.semantics.tolerance import TOLERANCE
from stlc.jsontext import dumps
from stlc.monitor.judgement import beside
from stlc.rundir import RunDir
from stlc.view.animation import VectorAnimation, dark_colors, speed_up, still_bytes
from stlc.view.contents import RunContents
from stlc.view.html import Child, Html, Section, classed, el, join, table
from stlc.view.run_animation import STILL, RunPanel, animation_name, animation_of, current, run_panels
from stlc.view.signals import MARGINS, Floats, Strip, constant_ranges, finite, margin_limits, margin_text
from stlc.view.style import SCENES_ON_DARK
from stlc.view.verdicts import Event
from stlc.view.words import count, labelled

SCRIPT = "player.js"
MOST_FRAMES = 160
"""Maximum number of frames of the page's animation; of more frames, an even selection is shown."""
MOST_ROWS = 60
"""Maximum number of listed events per requirement."""
_WIDE, _HIGH = 1000, 40  # of a track


@dataclass(frozen=True, slots=True)
class _Track:
    """A strip chart on the page: its name, its curve, and its value at every frame."""

    name: str
    curve: Html
    values: list[str | None]


def player_section(contents: RunContents) -> Section | None:
    """Section with the animation of the latest closed-loop run; None if no run was recorded."""
    panels = run_panels(contents.run)
    if not panels:
        return None
    frames = min(panel.frames for panel in panels)
    shown = range(0, frames, -(-frames // MOST_FRAMES))
    animations = [panel.vector_frames(shown) for panel in panels]
    tracks = [_tracks(panel, shown) for panel in panels]
    keys = {key.word: key for panel in panels for key in panel.keys}
    swatches = {
        word: el("span", attrs={"class": f"key {key.kind}", "style": _inks(key.color)})
        for word, key in keys.items()
    }
    head = el(
        "div",
        classed("p", "keys", [classed("span", "whole", swatch, word) for word, swatch in swatches.items()]),
        _stage(panels, animations, contents),
        _data(panels, animations, tracks, shown),
        _controls(len(shown)),
        _columns(panels, tracks),
        attrs={"class": "player", "tabindex": "0"},
    )
    name = f"{animation_name(contents.run)}.gif"
    link = classed("p", "quiet", "The same as a file: ", el("a", name, attrs={"href": name}))
    return Section("film", "", join(head, link if contents.run.has(name) else None, _events(panels)))


def script() -> Html:
    """JavaScript of the page (`player.js`) as markup; it loads no other file."""
    return Html((files("stlc.view") / SCRIPT).read_text(encoding="utf-8"))


# ------------------------------------------------------------------------------- stage


def _stage(panels: Sequence[RunPanel], animations: Sequence[VectorAnimation], contents: RunContents) -> Html:
    """HTML with a drawing area (canvas) per run, and a still picture for readers without scripts."""
    figures = [
        el(
            "figure",
            el("figcaption", panel.title) if panel.title else None,
            el(
                "canvas",
                attrs={
                    "role": "img",
                    "aria-label": panel.alt,
                    "width": f"{one.width}",
                    "height": f"{one.height}",
                },
            ),
        )
        for panel, one in zip(panels, animations, strict=True)
    ]
    wide = " wide" if len(panels) > 1 and animations[0].width > 2 * animations[0].height else ""
    kind = f"panels{wide}" if len(panels) > 1 else "panels one"
    return join(classed("div", kind, figures), el("noscript", _still(contents)))


def _still(contents: RunContents) -> Html | None:
    """The still picture of the animation; None if no run was recorded.

    The picture is drawn anew if its file is missing or out of date.
    """
    run = contents.run
    if current(run) and run.has(STILL):
        kind, content = "png", run.read(STILL, RunDir.MOST_JSON)
    else:
        animation = animation_of(run)
        if animation is None:
            return None
        kind, content = "webp", still_bytes(animation)
    address = f"data:image/{kind};base64," + base64.b64encode(content).decode()
    return el("img", attrs={"src": address, "alt": "the deployment at its most telling instant"})


def _controls(frames: int) -> Html:
    slide = {"type": "range", "min": "0", "max": str(frames - 1), "step": "1", "value": "0"}
    return classed(
        "div",
        "controls",
        el("button", "Play", attrs={"class": "play", "type": "button"}),
        el("button", "-1", attrs={"type": "button", "data-step": "-1", "aria-label": "one step back"}),
        el("button", "+1", attrs={"type": "button", "data-step": "1", "aria-label": "one step on"}),
        el("input", attrs={**slide, "aria-label": "time"}),
        el("output", "0 s"),
    )


def _inks(color: str) -> str:
    """CSS that sets one colour in the light scheme, and its replacement in the dark scheme."""
    return f"--day:{color};--dusk:{SCENES_ON_DARK.get(color, color)}"


# ------------------------------------------------------------------------------ tracks


def _columns(panels: Sequence[RunPanel], tracks: Sequence[Sequence[_Track]]) -> Html:
    columns = []
    for panel, own in zip(panels, tracks, strict=True):
        if panel.strip is None or not own:
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
        ends = [el("span", f"{time:g} s") for time in panel.strip.times[[0, -1]]]
        foot = classed("div", "track axis", el("span"), classed("div", "ends", ends), el("span"))
        words = f"{panel.title}: " if panel.title else ""
        heading = classed("p", "quiet", f"{words}{MARGINS}, red where violated")
        columns.append(classed("div", "tracks", heading, rows, foot))
    return classed("div", "columns", columns)


def _tracks(panel: RunPanel, shown: range) -> list[_Track]:
    strip = panel.strip
    if strip is None:
        return []
    rows = [_interventions(strip, shown)] if strip.acted.any() else []
    return rows + [_margin(strip, name, shown) for name in strip.rows]


def _interventions(strip: Strip, shown: range) -> _Track:
    assert strip.decisions is not None
    areas = [
        _path(_area(strip.times, low, high, (0, strip.acted.max())), "acted", style=_inks(color))
        for color, low, high in strip.stacked()
    ]
    agents = strip.decisions.shape[1]
    values: list[str | None] = [f"{int(strip.acted[index])} of {agents}" for index in shown]
    return _Track("guard acted", _svg(areas), values)


def _margin(strip: Strip, name: str, shown: range) -> _Track:
    rho, unit = finite(strip.margins[name]), strip.units.get(name, "")
    limits, fails, zero = margin_limits(rho), TOLERANCE.violated(rho), np.zeros(len(rho))
    good, bad = np.where(fails, np.nan, rho), np.where(fails, rho, np.nan)
    parts = [
        _path(f"M0 {_up(zero, limits)[0]:.1f}H{_WIDE}", "zero"),
        _path(_area(strip.times, zero, good, limits), "spare"),
        _path(_area(strip.times, zero, bad, limits), "lost"),
        _path(_line(strip.times, rho, limits), "line"),
        _path(_line(strip.times, bad, limits), "line lost"),
    ]
    values = [margin_text(float(rho[index]), unit) or None for index in shown]
    return _Track(labelled(name, unit), _svg(parts), values)


def _path(outline: str, kind: str, **attrs: str) -> Html:
    return el("path", attrs={"d": outline, "class": kind, **attrs})


def _svg(parts: Iterable[Html]) -> Html:
    box = {"viewBox": f"0 0 {_WIDE} {_HIGH}", "preserveAspectRatio": "none", "aria-hidden": "true"}
    return el("svg", parts, attrs=box)


def _up(values: Floats, limits: tuple[float, float]) -> Floats:
    """Vertical coordinates of values in a strip chart, measured from its upper edge.

    `limits` are the values at the lower and upper edge. A value beyond the limits is drawn at the edge.
    """
    low, high = limits
    return np.asarray(_HIGH - _HIGH * (np.clip(values, low, high) - low) / ((high - low) or 1.0))


def _across(times: Floats) -> Floats:
    """Horizontal coordinates in a strip chart: one per sample, and finally that of the right edge."""
    span = float(times[-1] - times[0]) or 1.0
    return np.append(_WIDE * (times - times[0]) / span, _WIDE)


def _line(times: Floats, values: Floats, limits: tuple[float, float]) -> str:
    """SVG path of the line of a step function, with gaps at NaN."""
    x, words, joined = _across(times), [], False
    for begin, end, y in constant_ranges(_up(values, limits)):
        if np.isfinite(y):
            words.append(f"V{y:.1f}H{x[end]:.1f}" if joined else f"M{x[begin]:.1f} {y:.1f}H{x[end]:.1f}")
        joined = bool(np.isfinite(y))
    return "".join(words)


def _area(times: Floats, base: Floats, values: Floats, limits: tuple[float, float]) -> str:
    """SVG path of the area between two step functions, with gaps at NaN."""
    x, low, high, words = _across(times), _up(base, limits), _up(values, limits), []
    for begin, end, _ in constant_ranges(low + 1j * high):
        y0, y1 = low[begin], high[begin]
        if np.isfinite(y1) and y0 != y1:
            words.append(f"M{x[begin]:.1f} {y0:.1f}V{y1:.1f}H{x[end]:.1f}V{y0:.1f}z")
    return "".join(words)


# ------------------------------------------------------------------------------ events


def _events(panels: Sequence[RunPanel]) -> Html | None:
    """List of violations by requirement; each entry links to its instant.

    None if no requirement was evaluated.
    """
    names = list(dict.fromkeys(name for panel in panels for name in panel.requirements))
    if not names:
        return None
    blocks = []
    for name in names:
        rows = [(panel, event) for panel in panels for event in panel.events if event.requirement == name]
        rows.sort(key=lambda row: row[1].sample)
        counts = ", ".join(
            f"{count(sum(own is panel for own, _ in rows), 'violation')} {panel.title}".strip()
            for panel in panels
        )
        total = classed("span", "bad" if rows else "quiet", counts)
        if rows:
            events = _event_table(rows[:MOST_ROWS], len(rows))
            blocks.append(el("details", el("summary", name, " ", total), events))
        else:
            blocks.append(classed("p", "none", el("strong", name), " ", total))
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
        when = join(button, el("small", window) if window else None)
        cells.append([when, *([panel.title] if several else []), panel.names[event.agent], event.because])
    more = el("p", f"and {count_ - len(rows):,} more") if count_ > len(rows) else None
    return join(table(header, cells, kind="jump"), more)


# -------------------------------------------------------------------------------- data


def _data(
    panels: Sequence[RunPanel],
    animations: Sequence[VectorAnimation],
    tracks: Sequence[Sequence[_Track]],
    shown: range,
) -> Html:
    """Data of the animations at the frames `shown` as JSON, escaped for a `<script>` element."""
    dt = panels[0].dt
    document: dict[str, Any] = {
        "times": [round(index * dt, 9) for index in shown],
        "digits": 1 if dt >= 0.1 else 2,
        "pace": speed_up(panels[0].frames, dt),
        "dark": dict(dark_colors(animations, SCENES_ON_DARK)),
        "panels": [animation.as_json() for animation in animations],
        "rows": [track.values for own in tracks for track in own],
    }
    text = Html(script_json(dumps(document)))
    return el("script", text, attrs={"type": "application/json", "id": "animation-data"})


_IN_SCRIPT = str.maketrans({char: f"\\u{ord(char):04x}" for char in "<>&\u2028\u2029"})


def script_json(text: str) -> str:
    """Escape a JSON text for a `<script>` element, so that it cannot end the element or open a comment."""
    return text.translate(_IN_SCRIPT)
