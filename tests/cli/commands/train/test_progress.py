"""The live panel, its lines where there is no terminal, and the closing screen."""

import io
import re
from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st
from rich.console import Console

from stlc.cli.commands.train.progress import (
    BLOCKS,
    TrainingDisplay,
    clock_text,
    engine_text,
    final_screen,
    native_text,
    sparkline,
)
from stlc.cli.commands.train.trained import JudgedTraining, TrainedRun
from stlc.controller.training.failures import FalsificationRounds
from stlc.view.learning import Learning

RECORD = {"spec": "traffic", "system_path": "examples/car.yaml", "seed": 0, "threads": 2}
INFO = (RECORD, "0001-quiet-heron")
ROW = {
    "step": 3120,
    "steps": 5900,
    "seconds": 32.0,
    "loss": 0.1,
    "accuracy": 0.957,
    "requirements": {"no_collision": 0.996, "stop_sign": 0.971, "give_way": 0.999, "red_light": 0.984},
    "feasible": 0.969,
    "lr": 1e-3,
    "repaired": 41,
    "failing": 55,
    "s_per_step": 0.0112,
}
VERDICT = Learning("trained", 0.988, "it is good", (), "stlc simulate --backup")
JUDGED = JudgedTraining(
    accuracy=0.957,
    interval=(0.951, 0.962),
    held_out=5000,
    requirements={"no_collision": 0.996, "stop_sign": 0.971},
    feasible=0.969,
    searched=5000,
    steps=5900,
    verdict=VERDICT,
)
RESULT = TrainedRun("runs/traffic/0001-quiet-heron", 61.2, JUDGED)
REGION = "fails in 63 % of the starts with sign = stop"


class Terminal(io.StringIO):
    def isatty(self):
        return True


class Clock:
    """Time that passes only when told."""

    def __init__(self):
        self.now = 0.0

    def __call__(self):
        return self.now


def piped(**options):
    stream, clock = io.StringIO(), Clock()
    console = Console(file=stream, width=120, **options)
    return TrainingDisplay(console, clock=clock), stream, clock


def panel_of(progress, width=130):
    stream = io.StringIO()
    console = Console(file=stream, width=width)
    progress.console = console
    console.print(progress.panel())
    return stream.getvalue().splitlines()


def test_the_panel_has_the_layout_that_was_designed():
    progress, _, _ = piped()
    progress.start(*INFO)
    for accuracy in (0.5, 0.7, 0.9, 0.95, 0.957):
        progress.update({**ROW, "accuracy": accuracy})
    title, accuracy, requirements, search = panel_of(progress)
    assert title.startswith(
        "traffic · car.yaml (examples/car.yaml) · run 0001-quiet-heron · seed 0 · 2 threads   "
    )
    assert title.endswith("step 3,120 / 5,900   00:31 left")
    assert len(title) == 130
    assert accuracy == "  plan accuracy   ▁▄▇██  0.957     known feasible 0.969     share 98.8 %"
    assert requirements == "  no_collision  0.996   stop_sign  0.971   give_way  0.999   red_light  0.984"
    assert search == "  search repaired 41 of 55 failing starts in the last round"


@pytest.mark.parametrize("width", [20, 40, 60, 80, 100, 200])
def test_the_panel_never_exceeds_the_terminal(width):
    progress, _, _ = piped()
    progress.start(*INFO)
    progress.update(ROW)
    lines = panel_of(progress, width)
    assert max(map(len, lines)) <= width
    assert any("step 3,120" in line for line in lines)


def test_the_panel_before_the_first_row_says_what_happens():
    progress, _, _ = piped()
    progress.start(*INFO)
    text = "\n".join(panel_of(progress))
    assert "measuring the speed of a step" in text
    assert "left" not in text


def test_a_bare_step_keeps_what_was_known():
    progress, _, _ = piped()
    progress.start(*INFO)
    progress.update(ROW)
    progress.update({"step": 3500, "accuracy": None})
    text = "\n".join(panel_of(progress))
    assert "step 3,500 / 5,900" in text
    assert "0.957" in text
    assert "00:27 left" in text


def test_time_left_runs_between_rows():
    progress, _, clock = piped()
    progress.start(*INFO)
    progress.update(ROW)
    clock.now += 11
    assert "00:20 left" in panel_of(progress)[0]
    clock.now += 100
    assert "00:00 left" in panel_of(progress)[0]


def test_a_pipe_gets_a_line_every_30_seconds():
    progress, stream, clock = piped()
    progress.start(*INFO)
    for _ in range(61):
        progress.update(ROW)
        clock.now += 1.0
    lines = stream.getvalue().splitlines()
    assert len(lines) == 3
    assert lines[1] == (
        "  step 3,120 / 5,900   00:31 left   plan accuracy 0.957  known feasible 0.969  share 98.8 %"
        "   worst stop_sign 0.971"
    )
    assert "\x1b" not in stream.getvalue()


def test_a_terminal_is_redrawn_in_place_and_left_clean():
    stream = Terminal()
    progress = TrainingDisplay(Console(file=stream, width=100, force_terminal=True))
    progress.start(*INFO)
    progress.update(ROW)
    progress.stop()
    progress.stop()
    text = stream.getvalue()
    assert "step 3,120 / 5,900" in text
    assert text.count("\x1b[?25l") == text.count("\x1b[?25h") == 1
    progress.finish(final_screen(RESULT, progress.spark))
    assert "Next:  stlc simulate --backup" in stream.getvalue()


def test_no_colour_without_a_terminal_even_at_the_end():
    progress, stream, _ = piped()
    progress.start(*INFO)
    progress.finish(final_screen(RESULT, progress.spark))
    assert "\x1b" not in stream.getvalue()


def test_the_closing_screen_says_all_that_matters():
    lines = final_screen(RESULT, region=REGION)
    assert lines == [
        "plan accuracy   0.957   95 % interval [0.951, 0.962] on 5,000 held-out starts",
        "known feasible  0.969   of which 98.8 % are satisfied",
        "verdict         trained: it is good",
        "worst           stop_sign 0.971",
        "                fails in 63 % of the starts with sign = stop",
        "finished        61 s of training and verdict, 5,900 steps   runs/traffic/0001-quiet-heron",
        "",
        "Next:  stlc simulate --backup",
    ]
    poor = Learning("undertrained", 0.03, "it is poor", ("more time", "luck"), "stlc train --resume 7")
    lines = final_screen(replace(RESULT, judged=replace(JUDGED, verdict=poor)))
    assert lines[2] == "verdict         undertrained: it is poor"
    assert lines[-5:-3] == ["what helps      more time", "                luck"]
    assert lines[-1] == "Next:  stlc train --resume 7"
    rounds = FalsificationRounds(2, 40, 9, 0.25, 512)
    longer = replace(JUDGED, judged_seconds=120.0, falsification=rounds)
    lines = final_screen(replace(RESULT, judged=longer))
    assert any("missions of 2 min;" in line for line in lines)
    told = "falsification   2 rounds, 40 drives, 25.0 % of the last round's failed; 512 states kept"
    assert told in lines


def test_the_closing_screen_can_go_elsewhere():
    progress, stream, _ = piped()
    progress.start(*INFO)
    elsewhere = io.StringIO()
    progress.finish(final_screen(RESULT), to=Console(file=elsewhere, width=200))
    assert "Next:" in elsewhere.getvalue()
    assert "Next:" not in stream.getvalue()


def test_a_terminal_without_unicode_gets_ascii():
    stream = io.TextIOWrapper(io.BytesIO(), encoding="ascii")
    progress = TrainingDisplay(Console(file=stream, width=120), clock=Clock())
    progress.start(*INFO)
    progress.update(ROW)
    progress.update({**ROW, "accuracy": 0.5})
    progress.finish(final_screen(RESULT, progress.spark))
    stream.flush()
    text = stream.buffer.getvalue().decode("ascii")
    assert "traffic | car.yaml" in text
    assert re.search(r"starts   #_", text)


def test_hostile_names_are_shown_as_they_are():
    progress, stream, _ = piped()
    progress.start({"spec": "[red]a[/]", "system_path": "p/b[link=x]"}, "r")
    assert stream.getvalue() == "[red]a[/] · b[link=x] (p/b[link=x]) · run r · seed 0 · 1 thread\n"


@given(st.lists(st.floats(0, 1), min_size=1), st.integers(1, 40))
def test_a_sparkline_keeps_order_and_width(values, width):
    spark = sparkline(values, width=width)
    assert len(spark) == min(width, len(values))
    assert set(spark) <= set(BLOCKS)
    ordered = [BLOCKS.index(block) for block in sparkline(sorted(values), width=width)]
    assert ordered == sorted(ordered)
    assert BLOCKS[-1] in spark


def test_an_empty_sparkline():
    assert sparkline([]) == ""


@pytest.mark.parametrize(
    ("seconds", "text"),
    [(0, "00:00"), (-3, "00:00"), (61.4, "01:01"), (3599.6, "1:00:00"), (7322, "2:02:02")],
)
def test_clock(seconds, text):
    assert clock_text(seconds) == text


def test_what_the_engine_chose_is_said():
    progress, stream, _ = piped()
    progress.start(*INFO)
    chosen = {"method": "guided", "hidden": [64, 64], "plans": 4, "batch": 256, "hard": 128, "lr": 1e-3}
    progress.chosen({**chosen, "margin": 0.0512, "samples": 0})
    assert stream.getvalue().splitlines()[1] == (
        "  method          guided · 4 plans of a network 64x64 · 256 fresh + 128 hard states a step"
        " · rate 0.001 · margin 0.0512"
    )
    fixed = {**chosen, "method": "gradient", "plans": 1, "hard": 0, "samples": 50000, "margin": 0.5}
    assert "1 plan of a network 64x64 · 256 states a step of 50,000 ·" in engine_text(fixed)


def test_which_parts_run_as_c_is_said():
    progress, stream, _ = piped()
    progress.start(*INFO)
    chosen = {"method": "guided", "hidden": [8], "plans": 1, "batch": 9, "hard": 0, "lr": 1.0, "margin": 0.1}
    progress.chosen({**chosen, "by_torch": {"verdicts": "", "search": "", "gradient": ""}})
    assert stream.getvalue().splitlines()[2] == "  engine          compiled C (verdicts, search, gradient)"
    assert native_text({"verdicts": "", "gradient": "why"}) == "compiled C (verdicts) · torch (gradient: why)"
    assert native_text({"verdicts": "why", "gradient": "why"}) == "torch (verdicts, gradient: why)"


def test_the_closing_screen_says_what_remains_and_where_it_is_drawn():
    lines = final_screen(RESULT, unsolved="7 of 9 starts", picture="runs/a/failures.png")
    assert "unsolved        7 of 9 starts" in lines
    assert "picture         runs/a/failures.png" in lines
    assert not any(line.startswith(("unsolved", "picture")) for line in final_screen(RESULT))


def test_the_engine_of_a_learner_from_rewards() -> None:
    engine = {"method": "ppo", "hidden": (64, 64), "environments": 512, "lr": 1e-3, "reward": "task"}
    text = (
        "ppo · one control a step of a network 64x64 · 512 episodes side by side · rate 0.001 · reward task"
    )
    assert engine_text(engine) == text


@given(width=st.integers(40, 140))
def test_in_a_terminal_lines_break_between_words(width):
    stream = Terminal()
    display = TrainingDisplay(Console(file=stream, width=width, force_terminal=True, no_color=True))
    lines = final_screen(RESULT, region=REGION, picture="runs/traffic/0001-quiet-heron/failures.png")
    display.finish(lines)
    shown = re.sub(r"\x1b\[[0-9;]*m", "", stream.getvalue()).splitlines()
    assert all(len(line) <= width or len(line.split()) == 1 for line in shown)
    assert " ".join(shown).split() == " ".join(lines).split()
    beneath = [line for line in shown if line.startswith(" ")]
    assert all(line.startswith(" " * 16) and not line[16].isspace() for line in beneath)
