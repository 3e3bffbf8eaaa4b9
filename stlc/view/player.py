"""The film at the head of the report: playback, scrubbing, and jumps to violations.

Without scripts the page shows a still. The film is stored as drawing commands (`stlc.view.tape`), not as
pixels: it is sharp at every width and follows the reader's light or dark scheme; `player.js` replays it.
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
from stlc.monitor.prepared import beside
from stlc.view.animate import STILL, Shot, current, film_name, film_of, shots_of
from stlc.view.film import Taped, in_the_dark, speed_of, still_bytes
from stlc.view.html import Child, Html, Section, classed, el, join, table
from stlc.view.judged import Event
from stlc.view.material import Material
from stlc.view.signals import Strip, finite, margin_limits, margin_text
from stlc.view.style import SCENES_ON_DARK
from stlc.view.words import count, labelled

SCRIPT = "player.js"
MOST_FRAMES = 160
"""Maximum number of frames of the page's film; others are subsampled evenly."""
MOST_ROWS = 60
"""Maximum number of listed events per requirement."""
_WIDE, _HIGH = 1000, 40  # of a track


@dataclass(frozen=True, slots=True)
class _Track:
    """A strip chart of the page: its name, its curve, and its value at every frame."""

    name: str
    curve: Html
    values: list[str | None]


def player_section(material: Material) -> Section | None:
    """The film of the newest deployment; None without a recording."""
    shots = shots_of(material.run)
    if not shots:
        return None
    frames = min(shot.frames for shot in shots)
    shown = range(0, frames, -(-frames // MOST_FRAMES))
    tapes = [shot.taped(shown) for shot in shots]
    tracks = [_tracks(shot, shown) for shot in shots]
    head = el(
        "div",
        _keys(shots),
        _stage(shots, tapes, material),
        _data(shots, tapes, tracks, shown),
        _controls(len(shown)),
        _columns(shots, tracks),
        attrs={"class": "player", "tabindex": "0"},
    )
    return Section("film", "", join(head, _files(material), _events(shots)))


def script() -> Html:
    """Script of the page; it loads nothing else."""
    return Html((files("stlc.view") / SCRIPT).read_text(encoding="utf-8"))


# ------------------------------------------------------------------------------- stage


def _stage(shots: Sequence[Shot], tapes: Sequence[Taped], material: Material) -> Html:
    """A canvas for each run, and a still for readers without scripts."""
    panels = [
        el(
            "figure",
            el("figcaption", shot.title) if shot.title else None,
            el(
                "canvas",
                attrs={
                    "role": "img",
                    "aria-label": shot.alt,
                    "width": str(tape.width),
                    "height": str(tape.height),
                },
            ),
        )
        for shot, tape in zip(shots, tapes, strict=True)
    ]
    wide = " wide" if len(shots) > 1 and tapes[0].width > 2 * tapes[0].height else ""
    kind = f"panels{wide}" if len(shots) > 1 else "panels one"
    return join(classed("div", kind, panels), el("noscript", _still(material)))


def _still(material: Material) -> Html | None:
    """The still of the animation, drawn if it is missing."""
    path = material.run.path / STILL
    if current(material.run) and path.is_file():
        kind, content = "png", path.read_bytes()
    else:
        film = film_of(material.run)
        if film is None:
            return None
        kind, content = "webp", still_bytes(film)
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


def _keys(shots: Sequence[Shot]) -> Html:
    """The legend of all runs."""
    keys = {key.word: key for shot in shots for key in shot.keys}
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


def _files(material: Material) -> Html | None:
    """The animation as files beside the page."""
    name = film_name(material.run)
    there = [
        f"{name}{suffix}" for suffix in (".gif", ".mp4") if (material.run.path / f"{name}{suffix}").exists()
    ]
    if not there:
        return None
    links = [join(el("a", path, attrs={"href": path}), " ") for path in there]
    return classed("p", "quiet", "The same as a file: ", links)


# ------------------------------------------------------------------------------ tracks


def _columns(shots: Sequence[Shot], tracks: Sequence[Sequence[_Track]]) -> Html:
    columns = []
    for shot, own in zip(shots, tracks, strict=True):
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
        times = shot.strip.times if shot.strip is not None else np.zeros(1)
        foot = classed("div", "track axis", el("span"), classed("div", "ends", _ends(times)), el("span"))
        words = f"{shot.strip.words}, red where violated" if shot.strip is not None else ""
        words = f"{shot.title}: {words}" if shot.title else words
        columns.append(classed("div", "tracks", classed("p", "quiet", words), rows, foot))
    return classed("div", "columns", columns)


def _ends(times: NDArray[np.float64]) -> list[Html]:
    return [el("span", f"{times[0]:g} s"), el("span", f"{times[-1]:g} s")]


def _tracks(shot: Shot, shown: range) -> list[_Track]:
    strip = shot.strip
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


def _events(shots: Sequence[Shot]) -> Html | None:
    """List of violations by requirement; each line links to its instant."""
    names = list(dict.fromkeys(name for shot in shots for name in shot.requirements))
    if not names:
        return None
    blocks = []
    for name in names:
        rows = [(shot, event) for shot in shots for event in shot.events if event.requirement == name]
        rows.sort(key=lambda row: row[1].sample)
        counts = [sum(1 for own, _ in rows if own is shot) for shot in shots]
        told = ", ".join(
            f"{count(number, 'violation')} {shot.title}".strip()
            for number, shot in zip(counts, shots, strict=True)
        )
        summary = el("summary", name, " ", classed("span", "bad" if rows else "quiet", told))
        if rows:
            blocks.append(el("details", summary, _event_table(rows[:MOST_ROWS], len(rows))))
        else:
            blocks.append(classed("p", "none", el("strong", name), " ", classed("span", "quiet", told)))
    return classed("div", "events", el("h3", "Violations in this film"), blocks)


def _event_table(rows: list[tuple[Shot, Event]], count_: int) -> Html:
    several = any(shot.title for shot, _ in rows)
    header = ["when", *(["drive"] if several else []), "who", "why"]
    cells: list[list[Child]] = []
    for shot, event in rows:
        moment, start = (f"t = {shot.time(sample):.10g} s" for sample in (event.sample, event.start))
        at = {"type": "button", "data-at": f"{shot.time(event.sample) - shot.time(0):.9g}"}
        button = el("button", f"{shot.time(event.sample):.4g} s", attrs=at)
        window = beside(moment, start).removeprefix(moment).strip()
        when: Child = join(button, el("small", window) if window else None)
        drive: list[Child] = [shot.title] if several else []
        cells.append([when, *drive, shot.names[event.agent], event.because])
    more = el("p", f"and {count_ - len(rows):,} more") if count_ > len(rows) else None
    return join(table(header, cells, kind="jump"), more)


# -------------------------------------------------------------------------------- data


def _data(
    shots: Sequence[Shot], tapes: Sequence[Taped], tracks: Sequence[Sequence[_Track]], shown: range
) -> Html:
    """The replayed data as JSON, escaped for a `<script>` element."""
    dt = shots[0].dt
    document: dict[str, Any] = {
        "times": [round(index * dt, 9) for index in shown],
        "digits": 1 if dt >= 0.1 else 2,
        "pace": speed_of(shots[0].frames, dt),
        "dark": dict(in_the_dark(tapes, SCENES_ON_DARK)),
        "panels": [tape.as_json() for tape in tapes],
        "rows": [track.values for own in tracks for track in own],
    }
    text = script_json(dumps(document))
    return el("script", Html(text), attrs={"type": "application/json", "id": "film-data"})
