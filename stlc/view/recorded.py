"""Report sections on the trace of the closed-loop runs: verdicts, signals with robustness, causes, map."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from stlc.diagnostics import StlcError
from stlc.grammar import ast
from stlc.grammar.spec import Spec
from stlc.monitor.explain.report import Cause
from stlc.monitor.judgement import Verdict
from stlc.monitor.verdict import Monitor
from stlc.trace import Trace
from stlc.view.contents import RunContents, untagged
from stlc.view.deployment import WINDOWS
from stlc.view.html import Child, Html, Section, classed, el, figure, join, table, with_code
from stlc.view.plotted import picture_of
from stlc.view.region_map import draw_map
from stlc.view.run_animation import map_of_drives
from stlc.view.signals import DECISIONS, POLICY, acted_in, left_out
from stlc.view.verdicts import judged_at_start, monitor_of, trace_names
from stlc.view.words import count, share

TITLE = "Recorded drives"
MAP_CAPTION = (
    "Paths over the regions that the specification names, from the hollow points to the full ones. Beside "
    "the map the share of traces in each region over time (shaded: times at which it is active; dashed: the "
    "share of traces that have visited the region by then)."
)


def recorded_section(contents: RunContents) -> Section | None:
    """Section with verdicts on the recorded drives, their signals, and causes of violations.

    If the trace stores a separate specification for drives, that one judges them, and the verdicts by which
    plans are judged, window by window, are folded away. None without a trace.
    """
    trace = contents.trace
    if trace is None:
        return None
    try:
        monitor = _monitor(contents, trace, drives=True)
        verdict = monitor.check(trace)
        picture = picture_of(verdict, trace)
    except StlcError as error:
        return Section("driven", TITLE, el("p", f"The trace could not be judged: {_messages(error)}."))
    names = trace_names(trace)
    drives = f"{verdict.satisfied_traces:,} of {count(verdict.traces, 'drive')}"
    when = "" if trace.meta.judge_text else " at every instant"
    body = join(
        el("p", f"{drives} satisfied {verdict.subject.compiled.name}{when}."),
        _verdict_table(verdict, names),
        figure(picture.data_uri(), picture.alt, _caption(trace, judged_at_start(verdict))),
        causes_of(verdict.causes, names, monitor.spec),
        _windows_part(contents, trace, names),
    )
    return Section("driven", TITLE, body, picture)


def _windows_part(contents: RunContents, trace: Trace, names: list[str]) -> Html | None:
    """Verdicts by which plans are judged, folded away; None if the trace has no other ones."""
    if not trace.meta.judge_text:
        return None
    try:
        monitor = _monitor(contents, trace)
        verdict = monitor.check(trace)
    except StlcError as error:
        return el("p", f"The planning windows could not be judged: {_messages(error)}.")
    return el(
        "details",
        el("summary", WINDOWS),
        el(
            "p",
            f"{share(verdict.share)} of all starts satisfy every requirement of ",
            el("code", verdict.subject.compiled.name),
            ".",
        ),
        _verdict_table(verdict, names),
        causes_of(verdict.causes, names, monitor.spec),
    )


def _messages(error: StlcError) -> str:
    return "; ".join(diagnostic.message for diagnostic in error.diagnostics)


def _monitor(contents: RunContents, trace: Trace, *, drives: bool = False) -> Monitor:
    return monitor_of(trace, contents.texts.get("spec.stl", ""), system=contents.system, drives=drives)


def map_section(contents: RunContents) -> Section | None:
    """Section with the map of paths over regions; None if the specification names no planar region."""
    trace = contents.trace
    if trace is None:
        return None
    try:
        region_map = map_of_drives(trace, contents.system, contents.texts.get("spec.stl", ""))
    except StlcError:
        return None
    if region_map is None:
        return None
    picture = draw_map(region_map)
    return Section("map", "Where it drives", figure(picture.data_uri(), picture.alt, MAP_CAPTION), picture)


def _verdict_table(verdict: Verdict, names: list[str]) -> Html:
    counts = ("violating drives", "least robustness")
    header = ("requirement", "verdict", *counts, "where")
    rows: list[tuple[Child, ...]] = []
    for judgement in verdict:
        trace, _ = judgement.worst
        violated = judgement.overall == "violated"
        margin = float((judgement.high if violated else judgement.low).min())
        if np.isfinite(margin):
            least = f"{margin:+.3f} {judgement.rule.typed.formula.margin_unit}".rstrip()
            least = least if violated else least.replace("-0.000", "+0.000")
        else:
            least = "not limited" if margin > 0 else "unknown"
        violating = judgement.statuses.count("violated")
        rows.append(
            (
                el("strong", judgement.name),
                classed("span", _KINDS.get(judgement.overall, "quiet"), judgement.overall),
                f"{violating:,} of {verdict.traces:,}",
                least,
                ", ".join(filter(None, (names[trace], judgement.when))),
            )
        )
    return table(header, rows, numeric=(2, 3))


_KINDS = {"satisfied": "good", "violated": "bad"}


def _caption(trace: Trace, once: list[str]) -> Html:
    words = (
        "Beneath the signals the robustness of each requirement at every instant "
        "(red: violated; large margins are cut). "
    )
    if once:
        words += f"Judged once, for the whole drive: {', '.join(once)}. "
    hidden = left_out(trace)
    if hidden:
        words += f"Not shown: {', '.join(hidden)}. "
    acted = acted_in(trace)
    if acted is None or not acted.any():
        return join(words)
    sources = {int(value) for value in np.unique(trace.extras["decision"])} & DECISIONS.keys()
    keys = []
    for word, color in (DECISIONS[source] for source in sorted(sources - {POLICY})):
        swatch = el("span", attrs={"class": "key", "style": f"background:{color}"})
        keys += [classed("span", "whole", swatch, word), "  "]
    return join(words, "Shaded, where the policy did not decide: ", keys)


def causes_of(causes: Mapping[str, Cause], names: list[str], spec: Spec) -> Html | None:
    """List with the worst violation of each violated requirement: part of the formula, instant and values."""
    if not causes:
        return None
    declared = spec.requirements
    listed = [_cause_html(cause, names, declared.get(cause.name)) for cause in causes.values()]
    return join(el("h3", "Violations and their causes"), listed)


def _cause_html(cause: Cause, names: list[str], declared: ast.Require | None) -> Html:
    written = untagged(declared) if declared else cause.rule.span
    labels = [label for label in (cause.place, *cause.labels) if label.text]
    marks = sorted(
        (max(label.span.start - written.start, 0), label.span.end - written.start)
        for label in labels
        if written.start <= label.span.start and label.span.end <= written.end
    )
    items = [el("li", el("code", " ".join(label.span.text.split())), f" is {label.text}") for label in labels]
    return join(
        el("p", el("strong", cause.name), f" fails worst in {names[cause.trace]}."),
        el("pre", _marked(written.text, marks)),
        el("ul", items, el("li", "because ", with_code(cause.because))),
    )


def _marked(text: str, marks: list[tuple[int, int]]) -> Html:
    """Text with the ranges `marks` (start, end) highlighted; overlapping ranges are merged."""
    parts: list[Html | str] = []
    last = 0
    for start, end in marks:
        if end > last:
            parts += [text[last : max(start, last)], el("mark", text[max(start, last) : end])]
            last = end
    return join([*parts, text[last:]])
