"""Of several processes that train together one speaks; the others of what is theirs alone."""

from __future__ import annotations

import pytest
import typer

from stlc.cli.commands.train import one_voice
from stlc.cli.framework.output import emit, say
from stlc.diagnostics import Diagnostic, MissingError, SpecError, StlcError

COMMON = SpecError(Diagnostic("E101", "there is no `x`"))
OWN = MissingError(Diagnostic("R302", "there is no device `cuda:1` here"))
LOST = MissingError(Diagnostic("R403", "a process of this training is gone"))


def speak(error: StlcError) -> None:
    with one_voice():
        emit("result")
        say("talk")
        raise error


def test_the_first_speaks_and_fails_as_ever(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SpecError):
        speak(COMMON)
    assert capsys.readouterr() == ("result\n", "talk\n")


@pytest.mark.parametrize(
    ("error", "local", "heard"),
    [
        (COMMON, 1, False),
        (COMMON, 0, True),
        (OWN, 1, True),
        (OWN, 0, True),
        (LOST, 0, False),
        (LOST, 1, False),
    ],
)
def test_another_says_what_its_machine_lacks(
    error: StlcError,
    local: int,
    heard: bool,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setenv("RANK", "3")
    monkeypatch.setenv("LOCAL_RANK", str(local))
    with pytest.raises(typer.Exit) as caught:
        speak(error)
    assert caught.value.exit_code == error.exit_code
    out, said = capsys.readouterr()
    assert out == ""
    assert "talk" not in said
    assert (error.diagnostics[0].message in said) == heard
    assert ("on rank 3" in said) == heard
