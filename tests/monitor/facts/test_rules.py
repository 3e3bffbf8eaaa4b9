"""The table of rules: what each says, what silences it, and that it says nothing of ordinary recordings."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from stlc.diagnostics import CODES, FACTS
from stlc.grammar.spec import Spec
from stlc.monitor.facts.findings import findings_on
from stlc.monitor.facts.rules import RULES
from stlc.monitor.verdict import Monitor
from stlc.signature import Column, Signature
from stlc.source import Source
from stlc.trace import Reading, Trace
from stlc.units import Unit

N = 40
RAMP = np.linspace(0.0, 2.0, N)


def facts(spec: str, **signals: np.ndarray) -> dict[str, str]:
    return {fact.code: fact.text for fact in Monitor(spec, dt=0.5).check(signals).facts}


def test_every_rule_has_a_code() -> None:
    assert RULES.keys() <= CODES.keys()
    assert RULES.keys() > FACTS


def test_an_ordinary_recording_has_no_facts() -> None:
    spec = "signal x [m]\nsignal on: bool\nrequire r: always (on -> eventually[0 s, 2 s] x > 0.5 m)"
    on = np.arange(N) % 9 == 5
    assert facts(spec, x=np.sin(np.arange(N)), on=on.astype(float)) == {}


@pytest.mark.parametrize(
    ("formula", "x", "code", "text"),
    [
        ("x < 9", RAMP, "W711", "judged at 0 s only, of 19.5 s"),
        ("always[2 s, 6 s] x < 9", RAMP, "W711", "read 2 s to 6 s of 19.5 s"),
        ("always x < 3000", RAMP, "W714", "nearest value of `x < 3000` is 1,499 spans away"),
        ("always x < 9", RAMP, "W714", "nearest value of `x < 9` is 3.5 spans away"),
        ("always x < 7", RAMP, "W714", None),
        ("always x < 3", np.full(N, 2.5), "W715", "`x` is 2.5 throughout"),
        ("always x < 3", np.minimum(RAMP, 1.0), "W715", "`x` is 1 from 10 s to the end, and changed before"),
        ("always x < 3", np.minimum(RAMP, 1.9), "W715", None),
        (
            "always x < 3",
            np.where(abs(np.arange(N) - 20) < 4, 0.5, RAMP),
            "W715",
            "`x` is 0.5 from 8.5 s to 11.5 s, and changes at nearly all other samples",
        ),
        ("always x < 3", np.round(RAMP, 1), "W715", None),  # coarse numbers
        ("always x < 3", np.floor(np.arange(N) / 10), "W715", None),  # a set-point
        (
            "always x < 3",
            np.where(np.arange(N) == 7, -999.0, RAMP),
            "W716",
            "`x` is -999 at 1 of 40 samples, elsewhere 0 to 2",
        ),
        ("always x < 2", RAMP, "W723", "on the boundary, where `<` is not `<=`"),
        ("always x < 2.01", RAMP, "W723", None),
        ("always x < 9999", np.where(np.arange(N) == 7, 7.0, RAMP), "W716", None),
        (
            "always x < 9999",
            np.where(np.arange(N) == 7, 9.0, RAMP),
            "W716",
            "`x` is 9 at 1 of 40 samples, elsewhere 0 to 2",
        ),
        ("always x > -1", np.where(np.arange(N) == 7, np.nan, RAMP), "W716", None),
        ("always x > -1", (RAMP > 1.0) * 1.0, "W716", None),
        ("always x < 99", np.array([1.0, 9.0, 1.5]), "W716", None),
        (
            "always x < 99",
            np.array([1.0, -999.0, 1.5]),
            "W716",
            "`x` is -999 at 1 of 3 samples, elsewhere 1 to 1.5",
        ),
    ],
)
def test_rules(formula: str, x: np.ndarray, code: str, text: str | None) -> None:
    assert facts(f"signal x\nrequire r: {formula}", x=x).get(code) == text


def test_degrees_for_radians() -> None:
    spec = "signal a [rad]\nrequire r: always a < 400 rad"
    assert facts(spec, a=90.0 * RAMP)["W722"] == "`a` in [rad] reaches 180"
    assert "W722" not in facts(spec, a=3.0 * RAMP)
    assert "W722" not in facts(spec, a=300.0 * RAMP)  # a wheel


def test_a_comment_silences_a_fact_at_its_place() -> None:
    spec = "signal x  # stlc: allow W715\nrequire a: x < 9  # stlc: allow W711\nrequire b: x < 9\n"
    found = Monitor(spec, dt=0.5).check({"x": np.full(N, 2.0)}).facts
    assert [(fact.code, fact.requirement) for fact in found] == [("W711", "b")]


def test_traces_out_of_scope_do_not_count() -> None:
    spec = "signal x\nassume low: always x < 5\nrequire r: always (x > 3 -> x < 4)"
    x = np.stack([RAMP, RAMP + 9.0])
    assert facts(spec, x=x)["W712"] == "never triggered (0 of 40)"


# ---------------------------------------------------------------------- recordings


def write(path: Path, head: str, *columns: np.ndarray) -> Path:
    np.savetxt(path, np.stack(columns, 1), delimiter=",", header=head, comments="", fmt="%.9g")
    return path


def of_file(path: Path, spec: str, **reading: object) -> dict[str, tuple[str, str]]:
    found = (
        Monitor(spec)
        .check(Trace.load(path, Reading(read={"gap": False}, words={"gap": {}}, **reading)))
        .facts
    )
    return {fact.code: (fact.severity, fact.text) for fact in found}


GAP = "signal gap [m]\nrequire r: always gap < 3 m"
T = 0.1 * np.arange(N)


def test_columns_of_a_file(tmp_path: Path) -> None:
    path = write(tmp_path / "l.csv", "t,gap,gap_mm,car_id", T, RAMP, RAMP, np.arange(N) % 2)
    found = of_file(path, GAP, names={"gap": "gap_mm"})
    assert found["W717"] == ("fact", "column `car_id` has 2 values, as if it told objects apart")
    assert found["W720"] == ("warning", f"`gap` is read from `gap_mm`, and `{path}` has a column `gap` too")
    assert found["W721"] == ("warning", "`gap_mm` is read as [m], and its name says [mm]")
    assert of_file(path, GAP, group="none") == {}


@pytest.mark.parametrize(
    ("name", "unit", "says"),
    [
        ("gap_mm", "m", "mm"),
        ("gap_km", "m", "km"),
        ("v_kmh", "m/s", "km/h"),
        ("heading_deg", "rad", "deg"),
        ("gap_m", "m", None),
        ("gap_min", "s", None),  # the least one
        ("gap_max", "m", None),
        ("gap_kg", "m", None),  # no length
        ("speed", "m/s", None),
    ],
)
def test_units_in_names(name: str, unit: str, says: str | None) -> None:
    trace = Trace(Signature((Column("a"),)), 0.1, {"a": RAMP[None]}, sources={"a": name}, name="l.csv")
    found = Monitor(f"signal a [{unit}]\nrequire r: always a < 5 {unit}").check(trace).facts
    text = [fact.text for fact in found if fact.code == "W721"]
    assert text == (
        [] if says is None else [f"`{name}` is read as [{Unit.parse(unit).text}], and its name says [{says}]"]
    )


def test_a_unit_in_the_header_is_converted(tmp_path: Path) -> None:
    path = write(tmp_path / "l.csv", "t,gap_mm [mm]", T, 1000.0 * RAMP)
    found = Monitor(GAP).check(
        Trace.load(path, Reading(names={"gap": "gap_mm"}, read={"gap": False}, words={"gap": {}}))
    )
    assert "W721" not in {fact.code for fact in found.facts}


def test_a_signal_that_was_seen_for_a_part_of_the_time(tmp_path: Path) -> None:
    late = 1.0 + T
    np.savez(tmp_path / "l.npz", **{"a.t": T, "a.v": RAMP, "b.t": late, "b.v": RAMP})
    reading = Reading(
        names={"a": "a.v", "b": "b.v"}, read={"a": False, "b": False}, words={"a": {}, "b": {}}, resample=0.1
    )
    monitor = Monitor("signal a\nsignal b\nrequire r: always (a < 3 and b < 3)")
    found = {
        fact.signal: fact.text
        for fact in monitor.check(Trace.load(tmp_path / "l.npz", reading)).facts
        if fact.code == "W719"
    }
    assert found == {"a": "`a` is known from 0 s to 3.9 s only", "b": "`b` is known from 1 s to 4.9 s only"}


def test_findings_for_linters_and_editors(tmp_path: Path) -> None:
    path = write(tmp_path / "l.csv", "t,gap", T, RAMP)
    spec = Spec.parse(Source("s.stl", "signal gap [m]\nrequire r: gap < 3 m"))
    (finding,) = findings_on(spec, path)
    assert (finding.code, finding.severity) == ("W711", "fact")
    assert finding.message == "`r`: judged at 0 s only, of 3.9 s"
    assert finding.span is not None
    assert finding.span.line == 2
    assert [each.code for each in findings_on(spec, tmp_path / "none.csv")] == ["U102"]
