"""The report's first screen, and how the policy came to be."""

from __future__ import annotations

import shlex
from collections.abc import Mapping
from typing import Any

from stlc.view.curves import draw_curves
from stlc.view.highlight import spec_html
from stlc.view.html import Child, Html, classed, el, facts, figure, join, table
from stlc.view.learning import Commands, clause, driven_lines, learning_on_record, recommended
from stlc.view.material import Material, untagged
from stlc.view.page import Section
from stlc.view.words import count, interval, number, obeyed_sentence, seconds, share, viable_sentence


def headline(material: Material) -> Html:
    """What came out, in one sentence.

    A run that was deployed is judged by its drives, one that was not by its plans.
    """
    record, result, simulation = material.record, material.result, material.simulation or {}
    driven, lost = obeyed_sentence(simulation), viable_sentence(simulation)
    trial = [] if driven else driven_lines(result or {})
    head = f"{trial[0][:1].upper()}{trial[0][1:]}" if trial else _verdict(material)
    names = dict.fromkeys((material.spec, str(record.get("system", "")), f"run {material.run.name}"))
    return join(
        classed("p", "eyebrow", " · ".join(name for name in names if name)),
        el("h1", driven or head),
        el("p", *_spoken(". ".join((*trial[1:], _verdict(material))))) if trial else None,
        el("p", f"{lost}.") if lost else None,
        el("p", f"{_verdict(material)}. {_beside(result)}" if driven else _beside(result))
        if result
        else None,
        _advice(material),
    )


def numbers(material: Material, tiles: list[tuple[str, str]]) -> Html | None:
    """The same in a few numbers; `tiles` adds those of the deployment."""
    return _tiles([*_training_tiles(material.result), *tiles])


def _verdict(material: Material) -> str:
    accuracy = material.result.get("accuracy")
    if accuracy is None:
        return f"Training of {material.spec} is {material.record.get('status', 'not finished')}"
    held_out = material.result.get("held_out")
    starts = f"{held_out:,} held-out starts" if held_out else "held-out starts"
    return f"The policy's plan satisfies {material.spec} from {share(accuracy)} of {starts}"


def _beside(result: Mapping[str, Any]) -> str:
    accuracy, feasible, ends = result.get("accuracy"), result.get("feasible"), result.get("interval")
    parts = [f"The 95 % interval is {interval(ends)}." if ends else ""]
    if feasible and accuracy is not None:
        parts.append(
            f"Some satisfying plan is known for {share(feasible)} of them{_sampled(result)}; the policy "
            f"finds {share(accuracy / feasible)} of what is known to be feasible."
        )
    return " ".join(part for part in parts if part)


def _sampled(result: Mapping[str, Any]) -> str:
    """That not all starts were searched, where it is so."""
    searched, held_out = result.get("searched"), result.get("held_out")
    if not searched or not held_out or searched >= held_out:
        return ""
    return f" (an estimate: {searched:,} were searched or solved)"


def _advice(material: Material) -> Html | None:
    """How far the training came, and what would help, where the policy falls short."""
    where = clause(material.held_out, material.signature)
    commands = Commands.of(shlex.quote(material.run.shown), guard=recommended(material.record))
    learning = learning_on_record(material.record, material.rows, commands, where)
    if learning is None or not learning.advice:
        return None
    level = f"{learning.level[0].upper()}{learning.level[1:]}."
    told = (*learning.advice[:1], *filter(None, [learning.worst]), *learning.advice[1:])
    items = [el("li", *_spoken(advice)) for advice in told]
    return join(el("p", el("strong", level), " What helps:"), el("ul", items))


def _spoken(advice: str) -> list[Child]:
    """A sentence whose commands are set apart, and that begins and ends as sentences do."""
    sentence = f"{advice[0].upper()}{advice[1:]}."
    return [el("code", part) if i % 2 else part for i, part in enumerate(sentence.split("`"))]


def _training_tiles(result: Mapping[str, Any]) -> list[tuple[str, str]]:
    accuracy, feasible = result.get("accuracy"), result.get("feasible")
    driven = result.get("closed_loop")
    closed = driven.get("share") if isinstance(driven, Mapping) else None
    tiles = [(share(closed), "of drives satisfied")] if closed is not None else []
    tiles.append((share(accuracy), "plan accuracy"))
    if accuracy is not None and feasible:
        tiles.append((share(accuracy / feasible), "of what is known feasible"))
    tiles.append((seconds(result.get("seconds")), "of training and verdict"))
    return [(value, name) for value, name in tiles if value]


def _tiles(tiles: list[tuple[str, str]]) -> Html | None:
    if not tiles:
        return None
    return classed(
        "div", "tiles", [classed("div", "tile", el("b", value), el("span", name)) for value, name in tiles]
    )


def requirements_section(material: Material) -> Section | None:
    """Every requirement with its text and how often the policy's plans meet it."""
    shares: Mapping[str, float] = material.result.get("requirements") or {}
    names = list(shares) or list(material.requirements)
    if not names:
        return None
    held_out = material.result.get("held_out")
    worst = min(shares, key=shares.__getitem__) if shares else None
    rows: list[tuple[Child, ...]] = []
    for name in names:
        value = shares.get(name)
        fails = "" if value is None or not held_out else f"{round((1 - value) * held_out):,}"
        kind = "bad" if name == worst and value is not None and value < 1 else "plain"
        rows.append((_described(material, name), classed("span", kind, share(value)), fails))
    header = ("requirement", "satisfied", f"fails of {held_out:,}" if held_out else "fails")
    intro = el("p", "Each is judged alone, on the plans from the held-out starts; all must hold together.")
    body = join(intro, table(header, rows, numeric=(1, 2)))
    return Section("requirements", "Requirements", body)


def _described(material: Material, name: str) -> Html:
    declared = material.requirements.get(name)
    if declared is None:
        return el("strong", name)
    tags = " ".join(" ".join(tag.span.text.split()) for tag in declared.tags)
    return join(
        el("strong", name),
        classed("span", "quiet", f" {tags}") if tags else None,
        el("small", declared.doc) if declared.doc else None,
        el("pre", spec_html(untagged(declared).text)),
    )


def training_section(material: Material) -> Section:
    """Curves, options, machine and versions."""
    curves = draw_curves(material.rows)
    shown = figure(curves.data_uri(), curves.alt, _CURVES) if curves else None
    last = material.rows[-1] if material.rows else {}
    search = None
    if last.get("failing") is not None:
        search = el(
            "p",
            f"In the last round the search repaired {last.get('repaired', 0)} of "
            f"{count(int(last['failing']), 'failing start')}.",
        )
    body = join(shown, search, facts(_facts(material)))
    return Section("training", "How it was trained", body, curves)


_CURVES = (
    "Plan accuracy while training, with the share of starts for which some satisfying plan is known; "
    "each requirement alone; the loss over the learning rate (shaded). Faint what was measured, on a few "
    "fresh starts each time; strong its running mean, with its last value."
)


def _facts(material: Material) -> list[tuple[str, Child]]:
    record = material.record
    hardware, git = record.get("hardware") or {}, record.get("git") or {}
    versions = record.get("versions") or {}
    budget = record.get("budget")
    steps = record.get("steps")
    taken = f"{steps:,} steps" if isinstance(steps, int) else ""
    if budget:
        taken += (
            f" (a budget of {budget if isinstance(budget, str) else seconds(float(budget))}{_clock(record)})"
        )
    machine = (
        str(hardware.get("processor") or hardware.get("machine") or ""),
        count(int(hardware["cores"]), "core") if hardware.get("cores") else "",
        f"{number(hardware['memory_gib'], 'GiB')}" if hardware.get("memory_gib") else "",
        str(hardware.get("system", "")),
    )
    commit = str(git.get("commit", ""))[:12]
    return [
        ("steps", taken),
        ("options", _options(record)),
        ("seed", str(record.get("seed", ""))),
        ("device", _device(record)),
        ("machine", ", ".join(part for part in machine if part)),
        ("versions", ", ".join(f"{name} {version}" for name, version in versions.items())),
        ("source", f"{commit}{', with uncommitted changes' if git.get('dirty') else ''}" if commit else ""),
        ("started", str(record.get("started", ""))),
        ("specification", _hashed(record, "spec")),
        ("system", _hashed(record, "system")),
    ]


def _clock(record: Mapping[str, Any]) -> str:
    """What a budget was counted in, where that is not the clock on the wall."""
    return " of processor time" if (record.get("options") or {}).get("clock") == "processor" else ""


def _options(record: Mapping[str, Any]) -> str:
    """What the engine decided, as far as the run says it."""
    engine = record.get("engine") or record.get("options") or {}
    shown = [f"{name} {engine[name]}" for name in _OPTIONS if engine.get(name) is not None]
    if record.get("margin") is not None:
        shown.append(f"margin {number(float(record['margin']))}")
    return ", ".join(shown)


_OPTIONS = ("method", "hidden", "plans", "batch", "lr")


def _device(record: Mapping[str, Any]) -> str:
    device, threads = str(record.get("device", "")), record.get("threads")
    return f"{device}, {count(int(threads), 'thread')}" if threads else device


def _hashed(record: Mapping[str, Any], what: str) -> Child:
    path, digest = record.get(f"{what}_path") or record.get(what, ""), record.get(f"{what}_hash")
    if not digest:
        return str(path)
    return join(str(path), " ", classed("span", "quiet", f"sha256 {str(digest)[:12]}"))
