"""Lists of findings."""

from __future__ import annotations

import pickle

import pytest

from stlc.diagnostics import Diagnostic, Findings, MissingError, SpecError, tell
from stlc.source import Source

TEXT = Source("a.stl", "one two")
ONE = Diagnostic("E101", "unknown", TEXT.span(0, 3))


@pytest.mark.parametrize("kind", [list, Findings])
def test_a_finding_is_told_once(kind: type[list[Diagnostic]]) -> None:
    sink = kind()
    for finding in (ONE, ONE, ONE.with_note("again"), Diagnostic("E101", "unknown", TEXT.span(4, 7))):
        tell(sink, finding)
    assert [finding.span.text for finding in sink if finding.span] == ["one", "two"]


@pytest.mark.parametrize("kind", [list, Findings])
def test_what_others_appended_is_known(kind: type[list[Diagnostic]]) -> None:
    sink = kind([ONE])
    tell(sink, ONE)
    sink.append(Diagnostic("E102", "twice", TEXT.span(0, 3)))
    tell(sink, Diagnostic("E102", "twice", TEXT.span(0, 3)))
    assert len(sink) == 2


@pytest.mark.parametrize("kind", [SpecError, MissingError])
def test_an_error_reaches_another_process_whole(kind: type[SpecError]) -> None:
    error = kind(ONE, ONE.with_note("again"))
    there = pickle.loads(pickle.dumps(error))
    assert (type(there), there.diagnostics, str(there)) == (kind, error.diagnostics, str(error))
