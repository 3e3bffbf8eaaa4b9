from __future__ import annotations

import subprocess
import sys
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest
from helpers.mission_strategies import augmented

from stlc.compile.backends.array.arith import ArrayProgram
from stlc.compile.backends.array.graph import evaluate
from stlc.compile.backends.array.numpy_ops import NUMPY
from stlc.compile.dump import dump
from stlc.compile.ir import nodes as ir
from stlc.compile.ir.discretize import Grid
from stlc.compile.ir.text import show_formula
from stlc.compile.pipeline import Compiled, Purpose, compile_spec
from stlc.diagnostics import SpecError
from stlc.grammar.spec import Spec
from stlc.source import Source

ROOT = Path(__file__).parents[2]
GRID = Grid(Fraction(1, 10), 25)
SIGNALS = "signal x [m]\nsignal y [m]\n"


def compiled(text: str, grid: Grid = GRID, purpose: Purpose = "train") -> Compiled:
    return compile_spec(Spec.parse(Source("a.stl", SIGNALS + text)), grid=grid, purpose=purpose)


def errors(text: str, grid: Grid = GRID, purpose: Purpose = "train") -> list[str]:
    with pytest.raises(SpecError) as caught:
        compiled(text, grid, purpose)
    return [finding.code for finding in caught.value.diagnostics]


def traffic() -> Compiled:
    path = ROOT / "specs" / "traffic.stl"
    return compile_spec(Spec.parse(Source("specs/traffic.stl", path.read_text())), grid=GRID)


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


def test_absolute_intervals_need_a_planning_horizon() -> None:
    assert errors("require a: eventually@[0, 1 s] x > 1 m", Grid(GRID.dt)) == ["E311"]


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
    first, second, _ = (show_formula(rule.formula) for rule in spec.requirements)
    assert first == "a <= -0.5 or always[0..25] (clock < 5 or clock > 10 or x > 1)"
    assert second == "b <= -0.5 or always[0..25] (clock < 20 or y > 1)"
    clock, *statuses = spec.timers
    assert (clock.name, clock.kind, clock.initial, clock.high) == ("clock", "clock", 0, 20 + 25 + 1)
    assert [(timer.name, timer.kind, timer.initial) for timer in statuses] == [
        ("a", "status", 0),
        ("b", "status", 0),
    ]
    assert spec.mission == 20
    assert spec.signature.names == ("x", "y", "clock", "a", "b")
    assert spec.signature["clock"].role == "timer"
    assert [rule.absolute for rule in spec.requirements] == [True, True, False]


def test_a_clock_decides_truth_and_never_limits_the_margin() -> None:
    """Every plan of an executed trace satisfies the clocked rule iff the trace satisfies the absolute one."""
    spec = compiled("require a: always@[0.5 s, 1 s] x > 1 m", Grid(Fraction(1, 10), 4))
    plain = compiled("require a: always@[0.5 s, 1 s] x > 1 m", purpose="check")
    rng = np.random.default_rng(0)
    x = rng.choice([2.0, 3.0, 5.0, 0.0], p=[0.32, 0.32, 0.32, 0.04], size=(30, 400))
    env = augmented(spec.timers, {"x": x})
    assert set(env) == {"x", "clock", "a"}
    np.testing.assert_array_equal(env["clock"][:, 0], np.minimum(np.arange(30), 10 + 4 + 1))
    (windows,) = evaluate([spec.requirements[0].formula], env, ops=NUMPY, count=26)
    (whole,) = evaluate([plain.requirements[0].formula], env, ops=NUMPY)
    good = whole[0] >= 0
    np.testing.assert_array_equal(windows.min(0)[good], whole[0][good])
    assert (windows.min(0)[~good] < 0).all()
    assert (windows[12:][:, good] == np.inf).all()
    assert {True, False} == set((whole[0] >= 0).tolist())


@pytest.mark.parametrize(
    ("text", "train"),
    [
        ("always@[0, 1 s] eventually[0, end] x > 1 m", ["E310"]),
        ("eventually@[0, 1 s] (y > 1 m and always[7 s, 8 s] x > 1 m)", ["E310"]),
        ("eventually@[0, 1 s] freeze a = x in always[0, 1 s] x > a", ["E310"]),
        ("eventually@[0, end] x > 1 m", ["E312"]),
        ("not always@[1 s, end] x > 1 m", ["E312"]),
        ("once[1 s, 2 s] always@[0, 1 s] x > 1 m", ["E307"]),
        ("rise(always@[0, 1 s] x > 1 m)", ["E307"]),
        ("always[0, 1 s] (x > 1 m or (y > 1 m and always@[0, 1 s] x > 1 m))", ["E307"]),
        ("always@[0, 1 s] once[7 s, 8 s] x > 1 m", ["E309"]),
        ("always[0, 1 s] once[0, 1 s] eventually[0, 1 s] x > 1 m", ["E309"]),
    ],
)
def test_what_cannot_be_trained_for_can_be_checked(text: str, train: list[str]) -> None:
    assert errors(f"require a: {text}") == train
    assert compiled(f"require a: {text}", purpose="check").requirements


def test_the_clock_gives_way_to_a_signal_of_its_name() -> None:
    spec = compiled("signal clock [s]\nsignal a [m]\nrequire a: always@[0, 1 s] x > 1 m")
    assert [timer.name for timer in spec.timers] == ["clock_2", "a_2"]
    assert compiled("signal clock [s]\nrequire a: always[0, 1 s] clock > 1 s").timers == ()


REWRITTEN = {
    "eventually@[0, 1 s] x > 1 m": "a <= -0.5 or a >= 0.5 or eventually[0..25] (clock <= 10 and x > 1)",
    "eventually@[1 s, 4 s) x > 1 m": (
        "a <= -0.5 or a >= 0.5 or clock <= 13 or eventually[0..25] (clock >= 10 and clock <= 39 and x > 1)"
    ),
    "not always@[0, 1 s] x > 1 m": "a <= -0.5 or a >= 0.5 or eventually[0..25] (clock <= 10 and x <= 1)",
    "x > 1 m until@[0, 1 s] y > 1 m": (
        "a <= -0.5 or a >= 0.5 or (x > 1 until[0..25] (clock <= 10 and y > 1))"
    ),
    "x > 0 m or always@[0, 1 s] x > 1 m": (
        "(a <= -0.5 and a_2 <= -0.5) or (a >= -0.5 and (clock > 0 or x > 0))"
        " or (a_2 >= -0.5 and always[0..25] (clock > 10 or x > 1))"
    ),
    "always[0, T] (y > 1 m -> always@[0, 1 s] x > 1 m)": (
        "(a <= -0.5 and a_2 <= -0.5) or (a >= -0.5 and always[0..25] (clock > 10 or x > 1))"
        " or (a_2 >= -0.5 and always[0..25] (clock > 25 or y <= 1))"
    ),
    "always[0, T] (x > 1 m -> once[0, 1 s] y > 1 m)": (
        "always[0..25] (x <= 1 or once[0..10] y > 1 or first(a_since) + elapsed <= 10)"
    ),
    "eventually@[0, 4 s] always[0, 1 s] x > 1 m": (
        "a <= -0.5 or a >= 0.5 or (clock <= 24 and always[0..25] (clock <= 39 or x > 1)) or ((clock <= 39"
        " or x > 1) until[0..25] (clock >= 10 and clock <= 50 and historically[0..10] x > 1"
        " and first(a_held) + elapsed >= 10))"
    ),
    "always@[0, 4 s] eventually[0, 1 s] x > 1 m": (
        "a <= -0.5 or always[0..25] (clock < 10 or clock > 50 or once[0..10] x > 1"
        " or first(a_since) + elapsed <= 10)"
    ),
    "always[0, T] historically[0, 1 s] y > 1 m": (
        "always[0..25] (historically[0..10] y > 1 and first(a_held) + elapsed >= 10)"
    ),
    "always[0, T] rise(y > 1 m)": (
        "always[0..25] (y > 1 and prev(y <= 1) and (elapsed >= 1 or a_before >= 1))"
    ),
    "always[0, T] (x > 1 m since y > 1 m)": (
        "always[0..25] ((x > 1 since[0..start] y > 1)"
        " or (historically[0..start] x > 1 and first(a_since) >= 1))"
    ),
}


@pytest.mark.parametrize(("written", "rewritten"), REWRITTEN.items())
def test_time_becomes_state(written: str, rewritten: str) -> None:
    (rule,) = compiled(f"require a: {written}").requirements
    assert show_formula(rule.formula) == rewritten


def test_what_recurs_for_ever_is_known_and_draws() -> None:
    spec = compiled(
        "require a: always@[2 s, end] once[0, 2 s] x > 1 m\nrequire b: always@[2 s, end] once[0, 1 s] y > 1 m"
    )
    assert (spec.mission, spec.recurring) == (20, 21)
    assert spec.guidance_cost is not None
    gap = ArrayProgram({"gap": spec.guidance_cost})

    def drawn(clock: float, a: float, b: float) -> float:
        timers = {"clock": clock, "a_since": a, "b_since": b, "a": 0.0, "b": 0.0}
        env = {name: np.array([value]) for name, value in (timers | {"x": -1.0, "y": -4.0}).items()}
        return float(gap(env, NUMPY)["gap"][0])

    assert drawn(40.0, 18.0, 3.0) == 2.0, "a is due in 2 steps, b in 7"
    assert drawn(40.0, 5.0, 8.0) == 5.0, "b is due in 2 steps, a in 15"
    ending = compiled("require a: always@[2 s, 4 s] once[0, 2 s] x > 1 m")
    assert (ending.mission, ending.recurring) == (40, None)


def test_equal_states_are_kept_once() -> None:
    spec = compiled(
        "require a: always[0, T] (x > 1 m -> once[0, 1 s] y > 1 m)\n"
        "require b: always[0, T] (x < 0 m -> once[0, 1 s] y > 1 m)\n"
        "require c: eventually@[0, 1 s] x > 1 m\nrequire d: y > 0 m or eventually@[0, 1 s] x > 1 m"
    )
    assert [timer.name for timer in spec.timers] == ["clock", "a_since", "c", "d"]


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


def test_a_formula_that_fills_pages_is_cut_unless_it_is_asked_for() -> None:
    spec = compiled("require a: always[0 s, 1 s] sweep([x, y]) not in box([0, 0], [1, 1])")
    text = dump(spec)
    (cut,) = [line for line in text.splitlines() if "…" in line]
    assert cut.endswith("more lines: --show ir")
    assert "time  always" in text
    assert show_formula(spec.requirements[0].formula) in dump(spec, "ir")
    assert len(text) < 2000 < len(dump(spec, "ir"))


def test_numbers_read_like_mathematics() -> None:
    (rule,) = compiled("require a: -(x + 1 m) * 2 - y / 3 ^ 2 <= -(abs(x) - 1 m)").requirements
    assert isinstance(rule.formula, ir.Predicate)
    assert "abs(x)" in show_formula(rule.formula)


def test_torch_is_not_needed() -> None:
    code = (
        "import sys; from pathlib import Path; from fractions import Fraction\n"
        "from stlc.grammar.spec import Spec; from stlc.source import Source\n"
        "from stlc.compile.pipeline import compile_spec; from stlc.compile.ir.discretize import Grid\n"
        "from stlc.compile.dump import dump; import stlc.compile.backends.array.graph\n"
        "text = Path('specs/traffic.stl').read_text()\n"
        "dump(compile_spec(Spec.parse(Source('a', text)), grid=Grid(Fraction(1, 10), 25)))\n"
        "sys.exit('torch' in sys.modules)"
    )
    subprocess.run([sys.executable, "-c", code], cwd=ROOT, check=True, timeout=60)
