"""`report.html`: results of a run, its settings, its failures and the commands that repeat it.

The page begins with an interactive animation of the latest closed-loop run. It is self-contained: style,
pictures and its only script are embedded, and no network is needed. Without scripts, the page shows a still
picture. Its colours follow the reader's light or dark scheme. Parts without data are left out.
"""

from __future__ import annotations

import shlex
from collections.abc import Mapping
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any, ClassVar

from stlc.activity import PULSE
from stlc.controller.guard.kind import named_guard
from stlc.controller.guard.kinds.paper import GUARD as PAPER
from stlc.controller.run.run import Run
from stlc.escape import operand, shell
from stlc.files import File
from stlc.foreign import driving
from stlc.rundir import RunDir
from stlc.version import __version__
from stlc.view import require_drawing
from stlc.view.contents import RunContents, read_contents, simulation_of, untagged
from stlc.view.curves import draw_curves
from stlc.view.deployment import deployment_section, deployment_tiles
from stlc.view.held_out import draw_failures
from stlc.view.html import (
    Child,
    Html,
    Section,
    classed,
    el,
    facts,
    figure,
    join,
    page,
    spec_html,
    table,
    with_code,
    yaml_html,
)
from stlc.view.learning import Commands, Learning, clause, driven_lines, learning_of_run, learning_on_record
from stlc.view.player import player_section, script
from stlc.view.recorded import map_section, recorded_section
from stlc.view.words import (
    count,
    interval,
    number,
    satisfied_sentence,
    seconds,
    share,
    viable_sentence,
)

REPORT = "report.html"


@dataclass(frozen=True, slots=True)
class Report:
    """Report of a run: its page, and the verdict on the training; None if the run has none."""

    JSON: ClassVar = "run=run.shown report=shown verdict?=learning"

    run: RunDir
    learning: Learning | None

    def __repr__(self) -> str:
        return f"Report({self.shown})"

    @property
    def shown(self) -> str:
        """Path of the page, relative to the present folder where possible."""
        return f"{self.run.shown}/{REPORT}"

    @property
    def lines(self) -> tuple[str, ...]:
        """Sentences on the drives and on the training."""
        simulation, learning = simulation_of(self.run) or {}, self.learning
        driven = satisfied_sentence(simulation) if simulation else ""
        lines = [driven] if driven else driven_lines(self.run.record().get("result") or {})
        if learning is not None:
            helps = (f"what helps: {advice}" for advice in learning.advice)
            lines += [f"{learning.level}: {learning.sentence}", *filter(None, (learning.worst,)), *helps]
        return tuple(lines)


def report(run: Run | Path | str = "latest", *, python: bool = False, runs: Path = RunDir.RUNS) -> Report:
    """Write a self-contained page with the pictures of a run into its folder.

    Args:
        run: the run, or its folder, number, words or specification, or `latest`.
        python: whether Python that the run names may draw its scenes.
        runs: folder of all runs.

    Raises:
        UsageError: R101, there is no such run.
        MissingError: R301, matplotlib or Pillow is missing; R201, the page cannot be written.
        RunError: R101, the folder is damaged.
    """
    folder = Run.folder(run, runs)
    with PULSE.doing("drawing the report"), driving(python):
        write_report(folder)
    return Report(folder, learning_of_run(folder, Commands.of(folder.shown, folder.record())))


def write_report(run: RunDir) -> Path:
    """Write the report of a run, and its pictures as PNG, into the run's folder.

    Returns the path of the report.

    Raises:
        MissingError: R301, matplotlib or Pillow is missing; R201, a file cannot be written.
        RunError: R101, the folder is not a run.
    """
    require_drawing()
    contents = read_contents(run)
    sections = sections_of(contents)
    path = run.place(REPORT)
    File(path).write(render_report(contents, sections))
    for part in sections:
        if part.picture is not None:
            part.picture.save_png(run.place(f"{part.anchor}.png"))
    return path


def sections_of(contents: RunContents) -> list[Section]:
    """Sections of the report, in order."""
    parts = (
        requirements_section(contents),
        deployment_section(contents),
        map_section(contents),
        recorded_section(contents),
        failures_section(contents),
        training_section(contents),
        repeat_section(contents),
        texts_section(contents),
    )
    return [part for part in parts if part is not None]


def render_report(contents: RunContents, sections: list[Section]) -> str:
    """The report of a run as an HTML page."""
    animation = player_section(contents)
    tiles = deployment_tiles(contents)
    tiles += [(value, name) for value, name in _training_tiles(contents.result, bool(tiles)) if value]
    shown = [classed("div", "tile", el("b", value), el("span", name)) for value, name in tiles]
    head = join(
        headline(contents),
        None if animation is None else animation.html,
        classed("div", "tiles", shown) if shown else None,
    )
    return page(
        f"{contents.spec} · {contents.run.name}",
        head,
        sections,
        f"Written by stlc {__version__} from {contents.run.shown}",
        None if animation is None else script(),
    )


# ---------------------------------------------------------------------- opening


def headline(contents: RunContents) -> Html:
    """Result of the run in one sentence, with advice.

    This is the result of the closed-loop runs if any were simulated, otherwise the result of the policy's
    plans.
    """
    record, result, simulation = contents.record, contents.result, contents.simulation or {}
    driven, viable = satisfied_sentence(simulation), viable_sentence(simulation)
    accuracy, held_out = result.get("accuracy"), result.get("held_out")
    if accuracy is None:
        verdict = f"Training of {contents.spec} is {record.get('status', 'not finished')}"
    else:
        starts = f"{held_out:,} held-out starts" if held_out else "held-out starts"
        verdict = f"The policy's plan satisfies {contents.spec} from {share(accuracy)} of {starts}"
    trial = [] if driven else driven_lines(result)
    names = dict.fromkeys((contents.spec, str(record.get("system", "")), f"run {contents.run.name}"))
    return join(
        classed("p", "eyebrow", " · ".join(name for name in names if name)),
        el("h1", driven or (f"{trial[0][:1].upper()}{trial[0][1:]}" if trial else verdict)),
        el("p", _sentence(". ".join((*trial[1:], verdict)))) if trial else None,
        el("p", f"{viable}.") if viable else None,
        el("p", f"{verdict}. {_beside(result)}" if driven else _beside(result)) if result else None,
        _advice(contents),
    )


def _beside(result: Mapping[str, Any]) -> str:
    accuracy, feasible, ends = result.get("accuracy"), result.get("feasible"), result.get("interval")
    parts = [f"The 95 % interval is {interval(ends)}."] if ends else []
    if feasible and accuracy is not None:
        searched, held_out = result.get("searched"), result.get("held_out")
        sampled = searched and held_out and searched < held_out
        estimate = f" (an estimate: {searched:,} were searched or solved)" if sampled else ""
        parts.append(
            f"Some satisfying plan is known for {share(feasible)} of them{estimate}; the policy "
            f"finds {share(accuracy / feasible)} of what is known to be feasible."
        )
    return " ".join(parts)


def _advice(contents: RunContents) -> Html | None:
    """Advice on further training; None if the policy is trained."""
    where = clause(contents.held_out, contents.signature)
    commands = Commands.of(shlex.quote(contents.run.shown), contents.record)
    learning = learning_on_record(contents.record, contents.rows, commands, where)
    if learning is None or not learning.advice:
        return None
    level = f"{learning.level[0].upper()}{learning.level[1:]}."
    advice = (*learning.advice[:1], *filter(None, [learning.worst]), *learning.advice[1:])
    items = [el("li", _sentence(each)) for each in advice]
    return join(el("p", el("strong", level), " What helps:"), el("ul", items))


def _sentence(advice: str) -> Html:
    """Format advice as a sentence: capitalised, with a full stop, and with commands marked as code."""
    return with_code(f"{advice[0].upper()}{advice[1:]}.")


def _training_tiles(result: Mapping[str, Any], driven: bool) -> list[tuple[str, str]]:
    """Key figures of the training; its own drives are left out if the report has others (`driven`)."""
    accuracy, feasible = result.get("accuracy"), result.get("feasible")
    part = accuracy / feasible if accuracy is not None and feasible else None
    executed, rounds = result.get("closed_loop"), result.get("falsification")
    drives = executed.get("share") if isinstance(executed, Mapping) and not driven else None
    return [
        (share(drives), "of drives satisfied"),
        (share(rounds.get("last_share")) if isinstance(rounds, Mapping) else "", "of the last search failed"),
        (share(accuracy), "of plans from held-out starts satisfied"),
        (share(part), "of those known to be feasible satisfied"),
        (seconds(result.get("seconds")), "of training and verdict"),
    ]


def requirements_section(contents: RunContents) -> Section | None:
    """Table of the requirements, each with its text and the share of plans that satisfy it."""
    shares: Mapping[str, float] = contents.result.get("requirements") or {}
    names = list(shares) or list(contents.requirements)
    if not names:
        return None
    held_out = contents.result.get("held_out")
    worst = min(shares, key=shares.__getitem__) if shares else None
    rows: list[tuple[Child, ...]] = []
    for name in names:
        value = shares.get(name)
        fails = "" if value is None or not held_out else f"{round((1 - value) * held_out):,}"
        kind = "bad" if name == worst and value is not None and value < 1 else "plain"
        rows.append((_described(contents, name), classed("span", kind, share(value)), fails))
    header = ("requirement", "satisfied", f"fails of {held_out:,}" if held_out else "fails")
    intro = el("p", "Each is judged alone, on the plans from the held-out starts; all must hold together.")
    body = join(intro, table(header, rows, numeric=(1, 2)))
    return Section("requirements", "Requirements", body)


def _described(contents: RunContents, name: str) -> Html:
    declared = contents.requirements.get(name)
    if declared is None:
        return el("strong", name)
    tags = " ".join(" ".join(tag.span.text.split()) for tag in declared.tags)
    return join(
        el("strong", name),
        classed("span", "quiet", f" {tags}") if tags else None,
        el("small", declared.doc) if declared.doc else None,
        el("pre", spec_html(untagged(declared).text)),
    )


def training_section(contents: RunContents) -> Section:
    """Section with learning curves, training options, machine and versions."""
    curves = draw_curves(contents.rows)
    shown = figure(curves.data_uri(), curves.alt, CURVES_CAPTION) if curves else None
    last = contents.rows[-1] if contents.rows else {}
    search = None
    if last.get("failing") is not None:
        search = el(
            "p",
            f"In the last round the search repaired {last.get('repaired', 0)} of "
            f"{count(int(last['failing']), 'failing start')}.",
        )
    body = join(shown, search, facts(_facts(contents)))
    return Section("training", "How it was trained", body, curves)


CURVES_CAPTION = (
    "Plan accuracy while training, with the share of starts for which some satisfying plan is known; "
    "each requirement alone; the loss over the learning rate (shaded). Faint lines are measurements on a few "
    "fresh starts; strong lines are their running means, whose last values the legend gives."
)


def _facts(contents: RunContents) -> list[tuple[str, Child]]:
    record = contents.record
    hardware, git = record.get("hardware") or {}, record.get("git") or {}
    budget, steps = record.get("budget"), record.get("steps")
    length = f"{steps:,} steps" if isinstance(steps, int) else ""
    if budget:
        processor = (record.get("options") or {}).get("clock") == "processor"
        time = budget if isinstance(budget, str) else seconds(float(budget))
        length += f" (a budget of {time}{' of processor time' if processor else ''})"
    engine = record.get("engine") or record.get("options") or {}
    options = [f"{name} {engine[name]}" for name in _OPTIONS if engine.get(name) is not None]
    if record.get("margin") is not None:
        options.append(f"margin {number(float(record['margin']))}")
    threads = f", {count(int(record['threads']), 'thread')}" if record.get("threads") else ""
    machine = (
        str(hardware.get("processor") or hardware.get("machine") or ""),
        count(int(hardware["cores"]), "core") if hardware.get("cores") else "",
        number(hardware.get("memory_gib") or None, "GiB"),
        str(hardware.get("system", "")),
    )
    commit = str(git.get("commit", ""))[:12]
    versions = (record.get("versions") or {}).items()
    return [
        ("steps", length),
        ("options", ", ".join(options)),
        ("seed", str(record.get("seed", ""))),
        ("device", f"{record.get('device', '')}{threads}"),
        ("machine", ", ".join(part for part in machine if part)),
        ("versions", ", ".join(f"{name} {version}" for name, version in versions)),
        ("source", f"{commit}{', with uncommitted changes' if git.get('dirty') else ''}" if commit else ""),
        ("started", str(record.get("started", ""))),
        ("specification", _hashed(record, "spec")),
        ("system", _hashed(record, "system")),
    ]


_OPTIONS = ("method", "hidden", "plans", "batch", "lr")


def _hashed(record: Mapping[str, Any], what: str) -> Child:
    path, digest = record.get(f"{what}_path") or record.get(what, ""), record.get(f"{what}_hash")
    if not digest:
        return str(path)
    return join(str(path), " ", classed("span", "quiet", f"sha256 {str(digest)[:12]}"))


# ---------------------------------------------------------------------- closing


USUAL_LIMIT = 0.1
"""Default time limit of a decision of timed guards, in seconds."""
_TITLES = {
    "spec.stl": "The specification",
    "system.yaml": "The system",
    "compiled.txt": "The specification as compiled",
    "config.resolved.yaml": "Every option, resolved",
}


def failures_section(contents: RunContents) -> Section | None:
    """Section on the region of initial states from which the policy's plans fail.

    If no plan fails, the section says so. None without held-out initial states.
    """
    if contents.held_out is None:
        return None
    picture = draw_failures(contents.held_out, contents.signature, contents.units)
    if picture is None:
        text = f"None of the plans from {len(contents.held_out.x0):,} held-out starts fails a requirement."
        return Section("failures", "Where plans fail", el("p", text))
    boxed = "; the dashed box is the region named above" if picture.figure.axes[0].patches else ""
    caption = (
        f"Held-out starts over the two states that separate failures best{boxed}. "
        "Right: robustness of the plans (counts on a logarithmic scale)."
    )
    body = figure(picture.data_uri(), picture.alt, caption)
    left = el("p", f"Unsolved: {contents.held_out.unsolved_text}.")
    return Section("failures", "Where plans fail", join(left, el("p", picture.alt), body), picture)


def repeat_section(contents: RunContents) -> Section:
    """Section with the commands that reproduce the run."""
    intro = el(
        "p",
        "The same seed and steps give the same weights on the same machine. The folder of the run "
        "holds the specification and the system as they were.",
    )
    lines = "\n".join(_commands(contents))
    return Section("repeat", "How to repeat it", join(intro, el("pre", lines)))


def _commands(contents: RunContents) -> list[str]:
    record, run = contents.record, operand(contents.run.shown)
    spec = str(record.get("spec_path") or f"{contents.run.shown}/spec.stl")
    system = str(record.get("system_path") or f"{contents.run.shown}/system.yaml")
    train = ["stlc", "train", spec, "--system", system]
    steps = record.get("schedule") or record.get("steps")
    for option, value in (("seed", record.get("seed")), ("steps", steps)):
        if value is not None:
            train += [f"--{option}", str(value)]
    options = record.get("options") or {}
    for option in ("method", "plans", "lr", "batch", "threads"):
        if options.get(option) not in (None, "guided"):
            train += [f"--{option}", str(options[option])]
    train += [*(["--falsify"] if options.get("falsify") else []), *_set(record)]
    commands = [shell(train), shell([*_simulate(contents), *_set(contents.simulation or {})])]
    if contents.trace is not None:
        check = ["stlc", "check", f"{contents.run.shown}/trace.npz"]
        if contents.outside:
            check += ["--system", f"{contents.run.shown}/system.yaml"]
        commands.append(shell(check))
    return [*commands, shell(("stlc", "report", run))]


def _set(record: Mapping[str, Any]) -> list[str]:
    """The `--set` options that repeat the overridden constants of a run."""
    changed = record.get("overrides") or {}
    return [word for name, value in changed.items() for word in ("--set", f"{name}={value}")]


def _simulate(contents: RunContents) -> list[str]:
    """Return the command that repeats the latest closed-loop simulation, as a list of words.

    If there was none, the command simulates the run with the paper's guard.
    """
    done = contents.simulation or {}
    guard = list(done.get("guards") or (PAPER.name,))[-1]
    words = ["stlc", "simulate", contents.run.shown, *named_guard(guard).option.split()]
    if done.get("scenario"):
        words += ["--scenario", str(done["scenario"])]
    seeds = list(done.get("seeds") or range(10))
    if seeds != list(range(10)):
        whole = len(seeds) > 1 and all(after == before + 1 for before, after in pairwise(seeds))
        words += ["--seeds", f"{seeds[0]}..{seeds[-1]}" if whole else ",".join(map(str, seeds))]
    for name in ("agents", "steps"):
        if done.get(name) not in (None, contents.usual.get(name)):
            words += [f"--{name}", str(done[name])]
    limit = done.get("time_limit", USUAL_LIMIT)
    if limit != USUAL_LIMIT or done.get("paper_time_limit") is not None:
        words += ["--time-limit", "none" if limit is None else f"{1000 * float(limit):g}ms"]
    words += ["--known-feasible", str(done["ceiling"])] if done.get("ceiling") else []
    margins = (done.get("margin") or {}).items()
    return words + [word for name, value in margins for word in ("--margin", f"{name}={value:.6g}")]


def texts_section(contents: RunContents) -> Section | None:
    """Section with the texts of the specification, the system and derived files.

    All texts but the first are collapsed.
    """
    if not contents.texts:
        return None
    blocks = []
    for name, text in contents.texts.items():
        shown = (
            spec_html(text) if name.endswith(".stl") else yaml_html(text) if name.endswith(".yaml") else text
        )
        attrs = {"open": ""} if name == "spec.stl" else {}
        summary = el("summary", _TITLES[name], " ", classed("span", "quiet", name))
        blocks.append(el("details", summary, el("pre", shown), attrs=attrs))
    return Section("texts", "What it was made from", join(blocks))
