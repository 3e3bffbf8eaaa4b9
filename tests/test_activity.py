"""Long work is not silent: a line in a terminal, a line in a log, and nothing where nothing is awaited."""

from __future__ import annotations

import io
import time
from contextlib import nullcontext

import pytest

from stlc.activity import Pulse
from stlc.cli.framework.app import main
from stlc.cli.framework.output import emit


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


@pytest.fixture
def pulse(monkeypatch: pytest.MonkeyPatch) -> Pulse:
    made = Pulse()
    monkeypatch.setattr("stlc.cli.framework.output.PULSE", made)
    monkeypatch.setattr(Pulse, "IN_TERMINAL", 0.05)
    monkeypatch.setattr(Pulse, "IN_LOG", 0.05)
    monkeypatch.setenv("TERM", "xterm")
    return made


def said(pulse: Pulse, stream: io.StringIO, monkeypatch: pytest.MonkeyPatch, what: str) -> str:
    monkeypatch.setattr("sys.stderr", stream)
    with pulse.beating(), pulse.doing("at work"):
        pulse.now(what)
        time.sleep(0.25)
        emit("a result")
    return stream.getvalue()


def test_in_a_terminal_a_line_is_redrawn_and_removed(
    pulse: Pulse, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    text = said(pulse, Terminal(), monkeypatch, "drawing")
    assert text.count("\r\x1b[Kdrawing, 0 s") >= 2
    assert text.endswith("\r\x1b[K")
    assert "\n" not in text
    assert capsys.readouterr().out == "a result\n"


def test_in_a_log_lines_are_written(pulse: Pulse, monkeypatch: pytest.MonkeyPatch) -> None:
    lines = said(pulse, io.StringIO(), monkeypatch, "drawing").splitlines()
    assert 2 <= len(lines) <= 5
    assert set(lines) == {"drawing, 0 s"}


def test_nothing_is_said_while_waiting(pulse: Pulse, monkeypatch: pytest.MonkeyPatch) -> None:
    assert said(pulse, io.StringIO(), monkeypatch, "") == ""


def test_a_quiet_program_does_not_show_it(monkeypatch: pytest.MonkeyPatch) -> None:
    shown: list[bool] = []
    monkeypatch.setattr(Pulse, "beating", lambda _: shown.append(True) or nullcontext())
    assert [main([*words, "explain", "E203"]) for words in ((), ("--quiet",))] == [0, 0]
    assert shown == [True]
