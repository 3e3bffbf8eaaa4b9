"""The report's last sections: where plans fail, how to repeat the run, and what it was made from."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from stlc.escape import operand, shell
from stlc.view.failures import draw_failures
from stlc.view.held_out import unsolved_text
from stlc.view.highlight import spec_html, yaml_html
from stlc.view.html import classed, el, figure, join
from stlc.view.material import Material
from stlc.view.page import Section

USUAL_LIMIT = 0.1
"""Seconds of a decision of the full guard, where nothing else was said."""
_TITLES = {
    "spec.stl": "The specification",
    "system.yaml": "The system",
    "compiled.txt": "The specification as compiled",
    "config.resolved.yaml": "Every option, resolved",
}


def failures_section(material: Material) -> Section | None:
    """Where in the initial set the policy's plans fail."""
    if material.held_out is None:
        return None
    picture = draw_failures(material.held_out, material.signature, material.units)
    if picture is None:
        text = f"None of the plans from {len(material.held_out.x0):,} held-out starts fails a requirement."
        return Section("failures", "Where plans fail", el("p", text))
    boxed = "; the dashed box is the region named above" if picture.figure.axes[0].patches else ""
    caption = (
        f"Held-out starts over the two columns that tell most about failing{boxed}. "
        "Right: how far the plans are from failing (counts on a logarithmic scale)."
    )
    body = figure(picture.data_uri(), picture.alt, caption)
    left = el("p", f"Unsolved: {unsolved_text(material.held_out)}.")
    return Section("failures", "Where plans fail", join(left, el("p", picture.alt), body), picture)


def repeat_section(material: Material) -> Section:
    """The commands that lead here again."""
    intro = el(
        "p",
        "The same seed and steps give the same weights on the same machine. The folder of the run "
        "holds the specification and the system as they were.",
    )
    lines = "\n".join(_commands(material))
    return Section("repeat", "How to repeat it", join(intro, el("pre", lines)))


def _commands(material: Material) -> list[str]:
    record, run = material.record, operand(material.run.shown)
    spec = str(record.get("spec_path") or f"{material.run.shown}/spec.stl")
    system = str(record.get("system_path") or f"{material.run.shown}/system.yaml")
    train = ["stlc", "train", spec, "--system", system]
    steps = record.get("schedule") or record.get("steps")
    for option, value in (("seed", record.get("seed")), ("steps", steps)):
        if value is not None:
            train += [f"--{option}", str(value)]
    options = record.get("options") or {}
    for option in ("method", "plans", "lr", "batch", "threads"):
        if options.get(option) not in (None, "guided"):
            train += [f"--{option}", str(options[option])]
    train += _set(record)
    commands = [shell(train), shell([*_simulate(material), *_set(material.simulation or {})])]
    if material.trace is not None:
        check = ["stlc", "check", f"{material.run.shown}/trace.npz"]
        if material.outside:
            check += ["--system", f"{material.run.shown}/system.yaml"]
        commands.append(shell(check))
    return [*commands, shell(("stlc", "report", run))]


def _set(record: Mapping[str, Any]) -> list[str]:
    """The options for what was changed in specification and system."""
    changed = record.get("overrides") or {}
    return [word for name, value in changed.items() for word in ("--set", f"{name}={value}")]


def _simulate(material: Material) -> list[str]:
    """The command of the newest deployment; with the backup where there was none."""
    done = material.simulation or {}
    guard = list(done.get("guards") or {"paper": {}})[-1]
    words = ["stlc", "simulate", material.run.shown, *_GUARDS.get(str(guard), ("--guard", str(guard)))]
    if done.get("scenario"):
        words += ["--scenario", str(done["scenario"])]
    seeds = done.get("seeds") or range(10)
    if list(seeds) != list(range(10)):
        words += ["--seeds", _seeds(seeds)]
    for name, usual in (("agents", material.usual.get("agents")), ("steps", material.usual.get("steps"))):
        if done.get(name) not in (None, usual):
            words += [f"--{name}", str(done[name])]
    return words + _limits(done)


def _seeds(seeds: Sequence[int]) -> str:
    """As `--seeds` takes them: `0..9`, or `0,3`."""
    whole = len(seeds) > 1 and list(seeds) == list(range(seeds[0], seeds[-1] + 1))
    return f"{seeds[0]}..{seeds[-1]}" if whole else ",".join(map(str, seeds))


def _limits(done: Mapping[str, Any]) -> list[str]:
    """What a guard was told, where that is not the usual."""
    words = []
    hurried = done.get("paper_time_limit") is not None
    if hurried or ("time_limit" in done and done["time_limit"] != USUAL_LIMIT):
        limit = done["time_limit"]
        words += ["--time-limit", "none" if limit is None else f"{1000 * float(limit):g}ms"]
    words += ["--ceiling", str(done["ceiling"])] if done.get("ceiling") else []
    asked = done.get("margin") or {}
    return words + [word for name in asked for word in ("--margin", f"{name}={asked[name]:.6g}")]


_GUARDS = {"none": (), "paper": ("--backup",)}


def texts_section(material: Material) -> Section | None:
    """The specification and the system word by word; what was derived from them can be unfolded."""
    if not material.texts:
        return None
    blocks = []
    for name, text in material.texts.items():
        shown = (
            spec_html(text) if name.endswith(".stl") else yaml_html(text) if name.endswith(".yaml") else text
        )
        attrs = {"open": ""} if name == "spec.stl" else {}
        summary = el("summary", _TITLES[name], " ", classed("span", "quiet", name))
        blocks.append(el("details", summary, el("pre", shown), attrs=attrs))
    return Section("texts", "What it was made from", join(blocks))
