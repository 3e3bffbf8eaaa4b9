"""Every way to get a system file wrong that we know of: a code, a place, a caret, help; never a traceback."""

from __future__ import annotations

from pathlib import Path

import pytest
from helpers.effort import refused

from stlc.cli.framework.render import render_text
from stlc.diagnostics import CODES, StlcError
from stlc.dynamics.load import load_system_decl, parse_system
from stlc.source import Source

GOLDEN = Path(__file__).parents[3] / "golden" / "dynamics"

GOOD = """\
stlc: 1
name: cart
time: {dt: 0.1 s, horizon: 20 steps, integrator: euler}
const:
  vmax: 4 m/s
  wall: 5 m
state:
  x: {unit: m, range: [-10, 10]}
  v: {unit: m/s, range: [-vmax, vmax], clamp: true}
  gear: {enum: {low: 0, high: 1}, role: env}
  wet: {bool: true, role: env}
control:
  u: {unit: m/s^2, range: [-3, 3]}
def:
  near_wall: abs(x - wall) < 1
flow:
  x: v
  v: u
jump:
  - {name: bounce, guard: x > wall, reset: {v: -v}, sharpness: 100}
init:
  mixture:
    - name: left
      draw: {x: "uniform(-10, 0)", v: 0, gear: low, wet: bernoulli(0.5)}
  where:
    - x < wall
objective:
  terms:
    - {name: slow, weight: 0.1, expr: sat * v^2}
policy: {hidden: [64, 64]}
train: {budget: 1 min, lr: 1e-3}
backup: {bins: 5, T0: [1, 2]}
test:
  steps: 50
  events:
    - {name: rain, every: 2 s, set: {wet: true}}
"""

BOMB = "a: &a [x,x,x,x,x,x,x,x,x,x]\n" + "".join(
    f"{name}: &{name} [{','.join([f'*{before}'] * 10)}]\n"
    for before, name in zip("abcdef", "bcdefg", strict=True)
)

# name of the case -> (what is written, what stands there instead)
CHANGES: dict[str, tuple[str, str]] = {
    "unknown_key": ("integrator: euler", "integrater: euler"),
    "unknown_section": ("objective:", "objectives:"),
    "duplicate_key": ("  v: u\n", "  v: u\n  x: v + 1\n"),
    "missing_time": ("time: {dt: 0.1 s, horizon: 20 steps, integrator: euler}\n", ""),
    "missing_dt": ("dt: 0.1 s, ", ""),
    "python_call": ("  v: u\n", "  v: __import__('os').system('id')\n"),
    "python_attribute": ("  v: u\n", '  v: u + os.system("id")\n'),
    "lambda": ("  v: u\n", "  v: (lambda q=1 -> q)\n"),
    "unknown_function": ("  v: u\n", "  v: exec(u)\n"),
    "nan": ("vmax: 4 m/s", "vmax: .nan"),
    "nan_in_flow": ("  v: u\n", "  v: nan\n"),
    "wrong_unit": ("  x: v\n", "  x: u\n"),
    "wrong_unit_in_sum": ("  x: v\n", "  x: v + wall\n"),
    "no_such_unit": ("x: {unit: m,", "x: {unit: metre,"),
    "bare_word": ("  v: u\n", "  v: u u\n"),
    "chopped": ('x: "uniform(-10, 0)"', "x: uniform(-10, 0)"),
    "chopped_list": ("range: [-10, 10]", "range: [min(1, 2), 10]"),
    "escaped": ("  v: u\n", '  v: "u \\u002b 1"\n'),
    "not_a_state": ("  v: u\n", "  w: u\n"),
    "guard_is_number": ("guard: x > wall", "guard: x + 1"),
    "flow_is_formula": ("  v: u\n", "  v: x > 1\n"),
    "temporal_guard": ("guard: x > wall", 'guard: "always[0, 1 s] x > wall"'),
    "control_without_range": ("u: {unit: m/s^2, range: [-3, 3]}", "u: {unit: m/s^2}"),
    "range_reversed": ("range: [-3, 3]", "range: [3, -3]"),
    "clamp_without_range": ("range: [-vmax, vmax], clamp", "clamp"),
    "unknown_name": ("  v: u\n", "  v: u - vmx\n"),
    "sampler_in_flow": ("  v: u\n", "  v: uniform(0, 1)\n"),
    "drawn_too_late": ('x: "uniform(-10, 0)", v: 0', "x: v * 1 s, v: 0"),
    "not_drawn": ("v: 0, gear", "gear"),
    "wrong_kind": ("hidden: [64, 64]", "hidden: big"),
    "seconds_for_steps": ("steps: 50", "steps: 0.25 s"),
    "word_for_number": ("bins: 5", "bins: five"),
    "float_for_int": ("bins: 5", "bins: 5.0"),
    "sexagesimal": ("steps: 50", "steps: 12:30"),
    "yes_is_a_word": ("clamp: true", "clamp: yes"),
    "two_triggers": ("every: 2 s", "every: 2 s, at: 1 s"),
    "off_grid": ("every: 2 s", "every: 0.25 s"),
    "unsupported_plugin": ("name: cart\n", 'name: cart\nplugin: "my.module:Cart"\n'),
    "vector_of_another_size": ("  x: v\n", "  x: [v, v]\n"),
    "vector_without_size": ("x: {unit: m,", "x: {size: 3, unit: m,"),
    "scenario_of_nothing": ("test:\n", "scenario:\n  windy: {disturb: {z: 1}, const: {wal: 3}}\ntest:\n"),
    "scenario_backup": (
        "test:\n",
        "scenario:\n  odd: {backup: {levels: {w: [1], u: [9]}, T0: [99]}, prefer: [{expr: wal}]}\ntest:\n",
    ),
    "version": ("stlc: 1\n", "stlc: 2\n"),
    "tag": ("name: cart", "name: !!python/object/apply:os.system [id]"),
    "tab": ("  x: v\n", "\tx: v\n"),
    "unclosed": ("policy: {hidden: [64, 64]}", "policy: {hidden: [64, 64}"),
    "several": (
        "flow:\n  x: v\n  v: u\njump:",
        "flow:\n  x: v +\n  w: u\n  v: u + q\n  x: 1\njumps:",
    ),
    "world": ("  steps: 50\n", "  steps: 50\n  world: traffic\n"),
    "enum_value_twice": ("{low: 0, high: 1}", "{low: 0, high: 0}"),
    "enum_out_of_range": ("gear: low, wet", "gear: 7, wet"),
    "flow_on_enum": ("  v: u\n", "  v: u\n  gear: 1\n"),
    "infinite_number": ("weight: 0.1", "weight: 1e400"),
    "huge_horizon": ("20 steps", "99999999999 steps"),
    "unused_definition": ("  near_wall:", "  far: x > wal\n  near_wall:"),
    "name_twice": ("  wall: 5 m", "  wall: 5 m\n  v: 1"),
    "two_documents": ("test:\n", "---\ntest:\n"),
}
WHOLE: dict[str, str] = {
    "empty": "",
    "only_comment": "# nothing here\n",
    "a_list": "- 1\n- 2\n",
    "a_word": "hello\n",
    "bomb": BOMB,
    "deep": "a: " + "[" * 200 + "]" * 200 + "\n",
    "recursive_alias": "a: &a [*a]\n",
    "control_character": "name: a\x07b\n",
}
CASES = [*CHANGES, *WHOLE]


def text_of(case: str) -> str:
    if case in WHOLE:
        return WHOLE[case]
    old, new = CHANGES[case]
    assert GOOD.count(old) == 1, f"{case}: `{old}` must stand once in the good file"
    return GOOD.replace(old, new)


def findings(text: str) -> str:
    with pytest.raises(StlcError) as caught:
        parse_system(Source("cart.yaml", text), Path("cart.yaml"))
    assert caught.value.exit_code == 3
    for finding in caught.value.diagnostics:
        assert finding.code in CODES
        assert finding.span is not None
        assert 0 <= finding.span.start <= finding.span.end <= len(finding.span.source.text)
    return render_text(caught.value.diagnostics, color=False)


def test_the_good_file_is_good() -> None:
    assert parse_system(Source("cart.yaml", GOOD), Path("cart.yaml")).name == "cart"


@pytest.mark.parametrize("case", CASES)
def test_says_what_is_wrong_and_where(case: str, request: pytest.FixtureRequest) -> None:
    shown = findings(text_of(case)).rstrip() + "\n"
    path = GOLDEN / f"{case}.txt"
    if request.config.getoption("--regenerate"):
        path.write_text(shown, encoding="utf-8")
    assert shown == path.read_text(encoding="utf-8")


def test_no_golden_file_is_left_over() -> None:
    assert sorted(path.stem for path in GOLDEN.glob("*.txt")) == sorted(CASES)


@pytest.mark.parametrize("data", [b"\x00\x01\xff\xfe" * 40, b"\xff\xfen\x00a\x00", b"name: \xe9\n"])
def test_binary_files_are_refused(data: bytes, tmp_path: Path) -> None:
    path = tmp_path / "cart.yaml"
    path.write_bytes(data)
    with pytest.raises(StlcError) as caught:
        load_system_decl(path)
    assert caught.value.exit_code == 3
    assert {finding.code for finding in caught.value.diagnostics} <= {"E003", "S100"}


def test_a_missing_file_is_a_usage_error(tmp_path: Path) -> None:
    with pytest.raises(StlcError) as caught:
        load_system_decl(tmp_path / "nowhere.yaml")
    assert caught.value.exit_code == 2


def test_several_errors_come_in_the_order_of_the_file() -> None:
    with pytest.raises(StlcError) as caught:
        parse_system(Source("cart.yaml", text_of("several")), Path("cart.yaml"))
    places = [finding.span.start for finding in caught.value.diagnostics if finding.span]
    assert len(places) >= 4
    assert places == sorted(places)


@pytest.mark.apart
def test_twice_as_many_findings_take_twice_the_work() -> None:
    def found(count: int) -> int:
        text = GOOD + "\n".join(f"k{number}: {number}" for number in range(count))
        error, spent = refused(lambda: parse_system(Source("cart.yaml", text), Path("cart.yaml")), StlcError)
        assert len(error.diagnostics) == count
        return spent

    assert found(600) < 2.5 * found(300)


def test_a_number_that_only_its_unit_makes_too_large() -> None:
    assert "E005" in findings(GOOD.replace("wall: 5 m", "wall: 1e308 km"))


@pytest.mark.parametrize("wrong", ["sampling: halton", "samples: 0", "samples: 2000000", "sampling: 3"])
def test_a_sample_of_prefixes_that_is_none(wrong: str) -> None:
    assert wrong.split(":")[0] in findings(GOOD.replace("T0: [1, 2]", f"T0: [1, 2], {wrong}"))


def test_a_sample_of_prefixes() -> None:
    text = GOOD.replace("T0: [1, 2]", "T0: [1, 2], samples: 500, sampling: random")
    backup = parse_system(Source("cart.yaml", text), Path("cart.yaml")).backup
    assert (backup.samples, backup.sampling) == (500, "random")
