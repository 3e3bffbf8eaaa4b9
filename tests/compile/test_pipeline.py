from __future__ import annotations

import subprocess
import sys
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest

from stlc.compile import ir
from stlc.compile.dump import dump
from stlc.compile.graph import evaluate
from stlc.compile.interface import Grid
from stlc.compile.ir_text import show_formula
from stlc.compile.ops_numpy import NUMPY
from stlc.compile.pipeline import Compiled, Purpose, compile_spec
from stlc.diagnostics import SpecError
from stlc.grammar.parser import parse
from stlc.source import Source

ROOT = Path(__file__).parents[2]
GRID = Grid(Fraction(1, 10), 25)
SIGNALS = "signal x [m]\nsignal y [m]\n"


def compiled(text: str, grid: Grid = GRID, purpose: Purpose = "train") -> Compiled:
    return compile_spec(parse(Source("a.stl", SIGNALS + text)), grid=grid, purpose=purpose)


def errors(text: str, grid: Grid = GRID, purpose: Purpose = "train") -> list[str]:
    with pytest.raises(SpecError) as caught:
        compiled(text, grid, purpose)
    return [finding.code for finding in caught.value.diagnostics]


def traffic() -> Compiled:
    path = ROOT / "specs" / "traffic.stl"
    return compile_spec(parse(Source("specs/traffic.stl", path.read_text())), grid=GRID)


def test_traffic() -> None:
    spec = traffic()
    assert [rule.name for rule in spec.requirements] == ["no_collision", "stop_sign", "give_way", "red_light"]
    assert [rule.name for rule in spec.safety] == ["no_collision", "give_way", "red_light"]
    assert all(rule.windowed and rule.reach == 25 and not rule.uses_end for rule in spec.requirements)
    assert spec.signature.names == ("x", "sign", "tau", "dx", "yielding")
    assert spec.reach == 25
    assert (spec.timers, spec.warnings) == ((), ())


def test_a_rule_knows_what_it_mentions() -> None:
    spec = compiled(
        "require a: always[0, 2 s] x > 1 m\n"
        "require b: eventually[1 s, end] always y > 1 m\n"
        "@weight(2)\nrequire c: x > 0 m until[0, T] y > 0 m\n"
        "assume d: x > 3 m\n"
    )
    a, b, c = spec.requirements
    assert [(r.reach, r.windowed, r.uses_end) for r in (a, b, c)] == [
        (20, False, False),
        (10, False, True),
        (25, True, False),
    ]
    assert c.weight == 2
    assert [rule.name for rule in spec.assumptions] == ["d"]


def test_all_findings_of_a_stage_at_once() -> None:
    assert errors("require a: always[0, T] x > 1 m\nrequire b: eventually(1 s, 1.1 s) y > 1 m", Grid()) == [
        "E311",
        "E311",
    ]


def test_windows_must_fit_a_plan() -> None:
    late = "require a: always[0, 2.6 s] x > 1 m"
    assert errors(late) == ["E306"]
    assert compiled(late, purpose="check").reach == 26
    assert compiled(late, Grid(Fraction(1, 10), None)).reach == 26
    assert errors("require a: always eventually[0, 1 s] x > 1 m") == ["E306"]


def test_rounding_is_a_warning() -> None:
    spec = compiled("require a: always[0, 0.25 s] x > 1 m")
    assert [finding.code for finding in spec.warnings] == ["W304"]
    assert spec.warnings[0].span is not None
    assert spec.warnings[0].span.text == "0.25 s"


def test_absolute_always_becomes_a_clock() -> None:
    spec = compiled(
        "require a: always@[0.5 s, 1 s] x > 1 m\nrequire b: always@[2 s, end] y > 1 m\nrequire c: x > 0 m"
    )
    assert show_formula(spec.requirements[0].formula) == "always[0..25] (clock < 5 or clock > 10 or x > 1)"
    assert show_formula(spec.requirements[1].formula) == "always[0..25] (clock < 20 or y > 1)"
    (timer,) = spec.timers
    assert (timer.name, timer.saturation, timer.rate) == ("clock", 20 + 25 + 1, 1)
    assert spec.signature.names == ("x", "y", "clock")
    assert spec.signature["clock"].role == "timer"
    assert [rule.absolute for rule in spec.requirements] == [True, True, False]


def test_a_clock_decides_truth_and_never_limits_the_margin() -> None:
    """Every plan of an executed trace satisfies the clocked rule iff the trace satisfies the absolute one."""
    spec = compiled("require a: always@[0.5 s, 1 s] x > 1 m", Grid(Fraction(1, 10), 4))
    plain = compiled("require a: always@[0.5 s, 1 s] x > 1 m", purpose="check")
    rng = np.random.default_rng(0)
    x = rng.choice([2.0, 3.0, 5.0, 0.0], p=[0.32, 0.32, 0.32, 0.04], size=(30, 400))
    clock = np.minimum(np.arange(30.0), spec.timers[0].saturation)[:, None] * np.ones((1, 400))
    env = {"x": x, "clock": clock}
    (windows,) = evaluate([spec.requirements[0].formula], env, ops=NUMPY, count=26)
    (whole,) = evaluate([plain.requirements[0].formula], env, ops=NUMPY)
    np.testing.assert_array_equal(windows.min(0), whole[0])
    assert (windows[12:] == np.inf).all()
    assert {True, False} == set((whole[0] >= 0).tolist())


@pytest.mark.parametrize(
    ("text", "train", "check"),
    [
        ("always@[0, 1 s] eventually[0, 1 s] x > 1 m", ["E310"], None),
        ("eventually@[0, 1 s] x > 1 m", ["E015"], None),
        ("x > 0 m or always@[0, 1 s] x > 1 m", ["E015"], None),
        ("always[0, 1 s] always@[0, 1 s] x > 1 m", ["E015"], ["E307"]),
    ],
)
def test_other_absolute_forms(text: str, train: list[str], check: list[str] | None) -> None:
    assert errors(f"require a: {text}") == train
    if check is None:
        assert compiled(f"require a: {text}", purpose="check").requirements[0].absolute
    else:
        assert errors(f"require a: {text}", purpose="check") == check


def test_a_signal_may_not_have_the_name_of_the_clock() -> None:
    assert errors("signal clock [s]\nrequire a: always@[0, 1 s] x > 1 m") == ["E102"]
    assert compiled("signal clock [s]\nrequire a: always[0, 1 s] clock > 1 s").timers == ()


GOLDEN = {
    "traffic": None,
    "times": "\n".join(
        (
            "spec times",
            "@safety",
            "require a: always@[0.5 s, 1 s] x < 2 m",
            "@weight(2)",
            "require b: (x > 1 m) until[0.2 s, 0.55 s] (once[0, 1 s] y * x > 3 m^2 and historically x < 1 m)",
            "require c: rise(x > 0 m) and always y > 2 m",
            "assume d: x > 0 m",
        )
    ),
}


@pytest.mark.parametrize("name", GOLDEN)
def test_dump(name: str, request: pytest.FixtureRequest) -> None:
    text = GOLDEN[name]
    spec = traffic() if text is None else compiled(text)
    path = ROOT / "tests" / "golden" / "compile" / f"{name}.txt"
    if request.config.getoption("--regenerate"):
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(dump(spec))
    assert dump(spec) == path.read_text()


def test_parts_of_a_dump() -> None:
    spec = traffic()
    assert "compiled" not in dump(spec, "steps")
    assert "samples 0..25" in dump(spec, "steps")
    assert "samples" not in dump(spec, "ir")
    assert dump(spec, "states").splitlines()[2:] == [
        "  columns   x sign tau dx yielding",
        "  phi_safe  no_collision, give_way, red_light",
    ]


def test_numbers_read_like_mathematics() -> None:
    (rule,) = compiled("require a: -(x + 1 m) * 2 - y / 3 ^ 2 <= -(abs(x) - 1 m)").requirements
    assert isinstance(rule.formula, ir.Atom)
    assert "abs(x)" in show_formula(rule.formula)


def test_torch_is_not_needed() -> None:
    code = (
        "import sys; from pathlib import Path; from fractions import Fraction\n"
        "from stlc.grammar.parser import parse; from stlc.source import Source\n"
        "from stlc.compile.pipeline import compile_spec; from stlc.compile.interface import Grid\n"
        "from stlc.compile.dump import dump; import stlc.compile.graph\n"
        "text = Path('specs/traffic.stl').read_text()\n"
        "dump(compile_spec(parse(Source('a', text)), grid=Grid(Fraction(1, 10), 25)))\n"
        "sys.exit('torch' in sys.modules)"
    )
    subprocess.run([sys.executable, "-c", code], cwd=ROOT, check=True, timeout=60)
