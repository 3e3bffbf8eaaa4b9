"""Answers of stlc and of RTAMT to a specification and a recording: verdicts, errors and remarks."""

from __future__ import annotations

import json
import re
import sys
import types
import typing
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import dataclass, field
from importlib import import_module
from io import StringIO
from pathlib import Path
from typing import Any

from benchmarks.mistakes import Files, Read
from benchmarks.requirements import for_rtamt, signals_of
from stlc.cli.framework.app import main

_WORD = re.compile(r"\w+")


@dataclass(frozen=True, slots=True)
class Remark:
    """Something that stlc says beside a verdict.

    Attributes:
        code: its code.
        text: its message.
        severity: "error", "warning" or "fact".
        near: words of its place: of the line in the specification, of help and notes, and the requirement.
    """

    code: str
    text: str
    severity: str
    near: frozenset[str] = field(compare=False)

    def names(self, place: frozenset[str]) -> bool:
        """True if it names one of the words of a place."""
        return not place.isdisjoint(self.near | {*_WORD.findall(self.text)})


@dataclass(frozen=True, slots=True)
class Answer:
    """Answer of `stlc check` and `stlc lint`: the verdict, "error" if there is none, and the remarks."""

    verdict: str
    remarks: frozenset[Remark]

    @property
    def warnings(self) -> list[Remark]:
        """Remarks that are warnings or errors."""
        return [remark for remark in self.remarks if remark.severity != "fact"]


def ask(files: Files, folder: Path) -> Answer:
    """Return what stlc says of files, which are written into `folder`."""
    spec, trace = folder / "requirements.stl", folder / "recording.csv"
    spec.write_text(files.spec, encoding="utf-8")
    trace.write_text(files.table, encoding="utf-8")
    checked = _document("check", str(spec), str(trace), *files.options)
    linted = _document("lint", str(spec))
    result = checked["result"] or {}
    remarks = {
        *(_of_diagnostic(each, files) for each in (*checked["diagnostics"], *linted["diagnostics"])),
        *(_of_fact(each, "") for each in result.get("facts", ())),
        *(
            _of_fact(each, rule["name"])
            for rule in result.get("requirements", ())
            for each in rule.get("facts", ())
        ),
    }
    return Answer(result.get("verdict", "error"), frozenset(remarks))


def _document(*words: str) -> dict[str, Any]:
    out = StringIO()
    with redirect_stdout(out), redirect_stderr(StringIO()):
        main([*words, "--json"])
    found: dict[str, Any] = json.loads(out.getvalue())
    return found


def _of_diagnostic(record: dict[str, Any], files: Files) -> Remark:
    place, lines = record["range"], []
    if place is not None and str(record["file"]).endswith(".stl"):
        lines = files.spec.splitlines()[place["start"]["line"] - 1 : place["end"]["line"]]
    near = " ".join([*record["help"], *record["note"], record["label"], *lines])
    return Remark(record["code"], record["message"], record["severity"], frozenset(_WORD.findall(near)))


def _of_fact(record: dict[str, Any], requirement: str) -> Remark:
    near = f"{requirement} {record.get('signal', '')}"
    return Remark(record["code"], record["text"], "fact", frozenset(_WORD.findall(near)))


def noticed(wrong: Answer, right: Answer, place: frozenset[str]) -> bool:
    """True if an answer shows a mistake: by another verdict, or a remark on its place.

    A remark that also stands in the answer `right`, without the mistake, does not count.
    """
    new = wrong.remarks - right.remarks
    return wrong.verdict != "satisfied" or any(remark.names(place) for remark in new)


def rtamt_notices(read: Read) -> bool:
    """True if RTAMT refuses what a literal reading sees, or does not find it satisfied."""
    rtamt = import_rtamt()
    spec = rtamt.StlDiscreteTimeSpecification()
    names = sorted(signals_of(read.formula))
    for name in names:
        spec.declare_var(name, "float")
    samples = len(read.data[names[0]])
    data: dict[str, list[float]] = {"time": [k * read.dt for k in range(samples)]}
    data |= {name: list(map(float, read.data[name])) for name in names}
    try:  # RTAMT raises exceptions of many kinds
        spec.spec = for_rtamt(read.formula)
        spec.set_sampling_period(read.dt, "s", 0.1)
        spec.parse()
        first = spec.evaluate(data)[0][1]
    except Exception:
        return True
    return not first >= 0


def import_rtamt() -> Any:
    """Import RTAMT.

    Its parser imports `typing.io`, which Python 3.11 deprecates and 3.12 no longer has.
    """
    before = sys.modules.get("typing.io")
    stand_in = types.ModuleType("typing.io")
    stand_in.TextIO = typing.TextIO  # type: ignore[attr-defined]
    sys.modules["typing.io"] = stand_in
    try:
        rtamt = import_module("rtamt")
    finally:
        if before is None:
            del sys.modules["typing.io"]
        else:
            sys.modules["typing.io"] = before
    return rtamt
