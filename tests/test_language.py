"""The language reference is true: every example on it comes out as the page says."""

from __future__ import annotations

import re
from dataclasses import replace
from functools import cache
from pathlib import Path

import pytest
from helpers.doc_examples import BOUNDS, VALUE, Claim, Example, Recorded, codes, examples, recorded

from stlc.compile.ir.discretize import Grid
from stlc.compile.pipeline import compile_spec
from stlc.diagnostics import Diagnostic, SpecError
from stlc.dynamics.load import load_system_decl
from stlc.files import File
from stlc.grammar import ast
from stlc.grammar.format.format import format_text
from stlc.grammar.spec import Spec
from stlc.grammar.words import RESERVED
from stlc.lint.lint import Selection, lint
from stlc.monitor.verdict import Monitor
from stlc.source import Source

ROOT = Path(__file__).resolve().parent.parent
PAGE = ROOT / "docs/language.md"
EXAMPLES = list(examples(PAGE))
SIGNALS = EXAMPLES[0]
LABELS = {"off": 0.0, "slow": 1.0, "fast": 2.0}


@cache
def trace() -> Recorded:
    return recorded(PAGE, LABELS)


def line_of(example: Example) -> str:
    return f"line {example.line}"


def whole(example: Example) -> tuple[Source, int]:
    """The example as a file, and the lines that stand before it."""
    head = "" if example.stands_alone or "system" in example.text else SIGNALS.text
    return Source(str(ROOT / "docs/example.stl"), head + example.text), head.count("\n")


def findings(source: Source, example: Example) -> list[Diagnostic]:
    """Findings of the compiler."""
    try:
        spec = Spec.parse(source)
        grid, interface = Grid(trace().dt, trace().horizon), None
        if spec.system is not None:
            decl = load_system_decl(File(spec.system).system(Path(source.name)))
            grid, interface = Grid(decl.dt, decl.horizon), decl.interface()
        purpose = "train" if example.for_training or interface is not None else "check"
        return list(compile_spec(spec, grid=grid, interface=interface, purpose=purpose).warnings)
    except SpecError as error:
        return list(error.diagnostics)


@pytest.mark.parametrize("example", EXAMPLES, ids=line_of)
def test_findings(example):
    source, before = whole(example)
    announced = codes(example.claims)
    found = {(place(one) - before, one.code) for one in findings(source, example)}
    rest = announced - found
    if rest:  # errors hide what later stages find, and some things only lint looks for
        known = {line for line, code in found if code.startswith("E")}
        lines = example.text.splitlines()
        quiet = "\n".join("" if number in known else line for number, line in enumerate(lines, start=1))
        again = Source(source.name, source.text[: len(source.text) - len(example.text)] + quiet)
        found |= {(place(one) - before, one.code) for one in findings(again, example)}
        said = {(place(one) - before, one.code) for one in lint(again, selection=Selection(("ALL",)))}
        found |= said & rest
    assert found == announced


def place(finding: Diagnostic) -> int:
    return 0 if finding.span is None else finding.span.line


CLAIMS = [
    pytest.param(example, claim, id=f"line {example.line + claim.line}")
    for example in EXAMPLES
    for claim in example.claims
    if not re.fullmatch(r"([EW]\d{3}(, )?)+", claim.what)
]


@pytest.mark.parametrize(("example", "claim"), CLAIMS)
def test_value(example: Example, claim: Claim):
    if claim.what.startswith("fmt: "):
        assert claim.what.removeprefix("fmt: ") in format_text(whole(example)[0])
        return
    monitor, name = judge(example, claim)
    signals = trace().columns
    if claim.what.startswith("adds "):
        assert ", ".join(added(monitor.spec, name)) == claim.what.removeprefix("adds ")
        return
    what = claim.what.partition(", W")[0]
    if what in ("satisfied", "violated", "inconclusive"):
        assert monitor.check(signals, at=0)[name].status == what
        return
    value, bounds = VALUE.fullmatch(what), BOUNDS.fullmatch(what)
    assert value or bounds, f"nobody understands `{what}`"
    at = 0 if value is None else int(float(value["at"] or 0) / float(trace().dt))
    found = monitor.check(signals, at=at, require=[name])[name].bounds
    ends = (value["value"], value["value"]) if value is not None else (bounds["low"], bounds["high"])
    assert found == pytest.approx(tuple(map(float, ends)), abs=5e-7)


def judge(example: Example, claim: Claim) -> tuple[Monitor, str]:
    """A monitor for the example without its wrong lines, and the requirement of the claim's line."""
    source, before = whole(example)
    wrong = {line for line, code in codes(example.claims) if code.startswith("E")}
    lines = example.text.splitlines()
    kept = "\n".join("" if number in wrong else line for number, line in enumerate(lines, start=1))
    head = source.text[: len(source.text) - len(example.text)]
    spec = Spec.parse(Source(source.name, head + kept))
    (name,) = [
        item.name
        for item in spec.items
        if isinstance(item, ast.Require)
        and item.span.source.position(item.span.end)[0] - before == claim.line
    ]
    dt = float(trace().dt)
    return Monitor(spec, dt=dt, horizon=dt * trace().horizon), name


def added(spec: Spec, name: str) -> list[str]:
    """The states that the compiler adds for a requirement alone."""
    items = tuple(item for item in spec.items if not isinstance(item, ast.Require) or item.name == name)
    compiled = compile_spec(replace(spec, items=items), grid=Grid(trace().dt, trace().horizon))
    return [timer.name for timer in compiled.timers]


def last_line(item: ast.Declaration) -> int:
    return item.span.source.position(item.span.end)[0]


def test_the_examples_were_found():
    assert len(EXAMPLES) > 25
    assert len(CLAIMS) > 80


def test_the_reserved_words_are_listed():
    text = PAGE.read_text(encoding="utf-8").partition("<!-- reserved -->\n")[2].partition("\n\n")[0]
    assert re.findall(r"`(\w+)`", text) == sorted(RESERVED)
