from __future__ import annotations

from pathlib import Path

import pytest

from stlc.cli.framework.render import render_text
from stlc.compile.frontend.interface import Interface
from stlc.compile.frontend.resolve import resolve
from stlc.diagnostics import CODES, Diagnostic, SpecError
from stlc.grammar.parser import MAX_ERRORS
from stlc.grammar.spec import Spec
from stlc.signature import Column, Signature
from stlc.source import Source
from stlc.units import Unit

GOLDEN = Path(__file__).parents[2] / "golden" / "resolve"
CASES = sorted(GOLDEN.glob("*.stl"))

YAML = Source(
    "examples/car.yaml",
    "const:\n  vmax: 10 m/s\n  amax: 10 m/s^2\nstate:\n  x: {unit: m}\n  v: {unit: m/s}\n",
)


def place(text: str):
    start = YAML.text.index(text)
    return YAML.span(start, start + 1)


def car() -> Interface:
    unit = Unit.parse
    columns = (
        Column("x", unit("m")),
        Column("v", unit("m/s")),
        Column("y", unit("m")),
        Column("sign", kind="enum", labels=(("stop", 0.0), ("light", 1.0)), role="env"),
        Column("tau", unit("s")),
        Column("dx", unit("m")),
        Column("v_lead", unit("m/s"), low=0.0, high=10.0, role="env"),
        Column("yielding", kind="bool", role="env"),
        Column("c", unit("s"), role="env"),
        Column("p[0]", unit("m")),
        Column("p[1]", unit("m")),
    )
    constants = {"vmax": (10.0, unit("m/s")), "amax": (10.0, unit("m/s^2"))}
    places = {"x": place("x: {"), "v": place("v: {"), "vmax": place("vmax"), "amax": place("amax")}
    return Interface("car", Signature(columns), constants, path="examples/car.yaml", places=places)


def findings(text: str, name: str = "specs/spec.stl", interface: Interface | None = None) -> list[Diagnostic]:
    """Warnings, and then errors if there are any."""
    sink: list[Diagnostic] = []
    try:
        resolve(Spec.parse(Source(name, text)), interface=interface, sink=sink)
    except SpecError as error:
        return [*sink, *error.diagnostics]
    return sink


@pytest.mark.parametrize("path", CASES, ids=lambda path: path.stem)
def test_the_message_is_the_golden_one(path: Path, request: pytest.FixtureRequest) -> None:
    interface = car() if path.stem.startswith("system_") else None
    found = findings(path.read_text(encoding="utf-8"), f"specs/{path.name}", interface)
    assert found
    shown = render_text(found, color=False)
    golden = path.with_suffix(".txt")
    if request.config.getoption("--regenerate"):
        golden.write_text(shown, encoding="utf-8")
    assert shown == golden.read_text(encoding="utf-8")
    assert all(finding.code in CODES and finding.span is not None for finding in found)


def test_no_golden_text_is_left_over() -> None:
    assert {path.stem for path in GOLDEN.glob("*.txt")} == {path.stem for path in CASES}


CODES_OF_THIS_HALF = """
    E005 E101 E102 E103 E104 E105 E201 E202 E203 E204 E205 E301 E302 E303 E311 E401 E501
    W101 W402 W502 W503
"""


@pytest.mark.parametrize("code", CODES_OF_THIS_HALF.split())
def test_every_code_of_this_half_has_a_golden_text(code: str) -> None:
    assert any(f"[{code}]" in path.with_suffix(".txt").read_text(encoding="utf-8") for path in CASES)


def test_errors_come_in_the_order_of_the_text() -> None:
    text = (GOLDEN / "several.stl").read_text(encoding="utf-8")
    errors = [finding for finding in findings(text) if finding.severity == "error"]
    assert [finding.code for finding in errors] == ["E101", "E203", "E301", "E201", "E501", "E101", "E203"]
    starts = [finding.span.start for finding in errors if finding.span is not None]
    assert starts == sorted(starts)


def test_a_name_that_is_broken_is_reported_once() -> None:
    text = "def a = b\ndef c = a + a\nrequire r: always c > a\nrequire s: a > 1\n"
    assert [finding.code for finding in findings(text)] == ["E101"]


def test_at_most_twenty_errors() -> None:
    text = "".join(f"require r{i}: a{i} > 1\n" for i in range(50))
    errors = findings(text)
    assert len(errors) == MAX_ERRORS
    assert errors[-1].note[-1] == "30 more errors are not shown"


def test_errors_never_lose_the_warnings() -> None:
    codes = [finding.code for finding in findings("signal x\nrequire a: always[0, 3] x > y\n")]
    assert codes == ["W101", "E101"]
