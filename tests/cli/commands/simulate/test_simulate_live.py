"""The live view: bars and agents on a terminal, ten lines elsewhere."""

from __future__ import annotations

import io
import math
import re
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch
from rich.console import Console
from torch import Tensor

from stlc.cli.commands.simulate.live import LiveView, _fitting, _shown, _signed
from stlc.controller.deployment.batched import Setting
from stlc.controller.deployment.live import LiveMonitor
from stlc.controller.deployment.simulator import Recorder, simulate
from stlc.controller.guard.guard import Guard
from stlc.controller.policies.policy import Policy
from stlc.controller.problem.task import Task
from stlc.controller.world import world_type
from stlc.dynamics.load import parse_system
from stlc.dynamics.system import System
from stlc.grammar.spec import Spec
from stlc.monitor.online.online import Margin
from stlc.signature import Column
from stlc.source import Source

SPEC = """\
signal p [m]
@safety
require near: always[0, T] abs(p) <= 3 m
require back: eventually[0, T] abs(p) <= 1.4 m
"""
SYSTEM = """\
stlc: 1
name: dot
time: {dt: 0.5 s, horizon: 4 steps}
state: {p: {unit: m, range: [-3, 3]}, w: {unit: m/s}}
control: {u: {unit: m/s^2, range: [-1, 1]}}
flow: {p: w, w: u}
init: {mixture: [{draw: {p: "uniform(-1, 1)", w: 0}}]}
backup: {bins: 3, T0: [1], batch: 64}
"""


class Away(Policy):
    """Drives off."""

    def candidates(self, x0: Tensor) -> Tensor:
        return torch.ones((len(x0), 1, self.task.horizon, 1), dtype=x0.dtype)


def shown(
    *,
    terminal: bool,
    guard: str = "none",
    seeds: int = 1,
    steps: int = 20,
    size: tuple[int, int] = (110, 30),
) -> str:
    """Output of the view of a deployment, all pictures after one another."""
    task = Task.of(
        Spec.parse(Source("a.stl", SPEC)), System(parse_system(Source("dot.yaml", SYSTEM), Path("dot.yaml")))
    )  # type: ignore[arg-type]
    setting = Setting(tuple(range(seeds)), 6, steps)
    stream = io.StringIO()
    console = Console(
        file=stream,
        force_terminal=terminal,
        width=size[0],
        height=size[1],
        no_color=True,
        legacy_windows=False,
    )
    monitor, ticks = LiveMonitor(task, setting), iter(range(10_000))
    view = LiveView(monitor, "dot · a title", console, clock=lambda: float(next(ticks)))

    def watch(moment: object) -> None:
        monitor.push(moment)  # type: ignore[arg-type]
        view.update()

    view.start()
    made = world_type(task.system.decl)
    simulate(Guard(task, Away(task), guard), made, setting, Recorder(6), watch)
    view.stop()
    assert monitor.counts.sum() == seeds * 6 * steps
    return stream.getvalue()


def test_where_there_is_no_terminal_there_are_ten_lines() -> None:
    lines = shown(terminal=False).splitlines()
    assert lines[0] == "dot · a title"
    assert [line.split("t =")[0].strip() for line in lines[1:]] == [f"step {k} / 20" for k in range(0, 21, 2)]
    assert "violated by 0 of 6" in lines[1]
    assert "violated by 6 of 6" in lines[-1]
    assert "least margin near -" in lines[-1]
    assert "\x1b" not in "".join(lines)


def test_few_steps_have_a_line_each() -> None:
    assert len(shown(terminal=False, steps=3).splitlines()) == 1 + 4


def test_a_terminal_shows_bars_agents_and_who_decided() -> None:
    text = shown(terminal=True, guard="paper")
    last = text[text.rindex("step 20 / 20") :]
    assert "policy" in last.splitlines()[0]
    assert "backup" in last.splitlines()[0]
    bars = {line.split()[0]: line for line in last.splitlines() if "│" in line}
    assert set(bars) == {"near", "back"}
    assert all("█" in line and "agent" in line and re.search(r"\d m +agent", line) for line in bars.values())
    header = next(line for line in last.splitlines() if "decided by" in line)
    assert "p m" in header
    assert "w m/s" in header
    rows = last[last.index(header) :].splitlines()[1:7]
    assert [row.split()[0] for row in rows] == ["0", "1", "2", "3", "4", "5"]
    assert "  backup T0=1  " in text


def test_of_more_agents_than_fit_the_worst_are_shown() -> None:
    text = shown(terminal=True, size=(110, 12))
    last = text[text.rindex("decided by") :].splitlines()[1:]
    rows = [line.split() for line in last if line.strip() and line.split()[0].isdigit()]
    assert 3 <= len(rows) < 6
    assert [row[0] for row in rows] == sorted(row[0] for row in rows)


def test_an_agent_has_a_row_although_its_margin_is_no_number() -> None:
    margins = {
        "a": [Margin("inconclusive", math.nan, math.nan, 0)],
        "b": [Margin("satisfied", 1.0, 1.0, 0)],
    }
    monitor = SimpleNamespace(
        margins=margins,
        setting=SimpleNamespace(agents=1),
        moment=SimpleNamespace(x=torch.zeros((1, 0)), decision=None),
        task=SimpleNamespace(system=SimpleNamespace(signature=SimpleNamespace(columns=()))),
        decided=lambda _: None,
    )
    view = LiveView(monitor, "", Console(file=io.StringIO()))  # type: ignore[arg-type]
    assert view._agents(80, 3)[1].plain.split() == ["0", "a", "+nan"]


def test_little_room_takes_from_bars() -> None:
    text = shown(terminal=True, size=(66, 30))
    last = text[text.rindex("step 20 / 20") :].splitlines()
    bars = [line for line in last if "│" in line]
    assert all(line.endswith("violated by 6 of 6") and len(line) <= 66 for line in bars)
    assert {line.count("█") + line.count("·") for line in bars} == {8}


def test_columns_are_whole_or_missing() -> None:
    header = ["agent", "decided by", "plan", "least margin", "x m", "v m/s"]
    rows = [["0", "policy", "+1.000", "near +1.000", "-10.00", "3.25"]]
    whole = _fitting(rows, header, 80)
    assert whole.splitlines()[1].endswith(" 3.25")
    lines = _fitting(rows, header, max(map(len, whole.splitlines())) - 1).splitlines()
    assert [line.split()[-1] for line in lines] == ["…", "…"]
    assert "-10.00" in lines[1]
    assert "3.25" not in lines[1]
    assert _fitting(rows, header, 5).splitlines()[0].endswith("least margin")


def test_states_read_as_they_are_written() -> None:
    light = Column("sign", kind="enum", labels=(("stop", 0.0), ("light", 1.0)))
    assert [_shown(light, value) for value in (0.0, 1.0)] == ["stop", "light"]
    assert [_shown(Column("ready", kind="bool"), value) for value in (0.0, 1.0)] == ["no", "yes"]
    assert _shown(Column("x"), -1.005) == "-1.00"
    assert [_signed(value) for value in (-1.1e-16, 0.25, -2e-6)] == ["0", "+0.250", "-2.0e-06"]


def test_an_agent_of_several_seeds_is_named_with_its_seed() -> None:
    assert "(agent " in shown(terminal=False, seeds=1)
    assert ", seed " in shown(terminal=False, seeds=2)


@pytest.mark.parametrize("value", [0.5, -0.5, 0.0, float("inf"), float("-inf")])
def test_bars_have_one_width(value: float) -> None:
    view = LiveView(None, "", Console(file=io.StringIO()))  # type: ignore[arg-type]
    view._scales["a"] = 1.0
    bar = view._bar("a", value)
    assert len(bar) == 21
    assert bar.count("█") + bar.count("#") == {0.5: 5, -0.5: 5}.get(value, 10 if value else 0)
