"""Properties of every text, checked in process without the command line.

Every entry point gives a value or diagnostics; `fmt` keeps the meaning and is idempotent; a well-formed
specification has an English translation.
"""

import signal
import zlib
from contextlib import contextmanager
from functools import cache
from pathlib import Path

from fuzzing.specs import SYSTEM


def laws(source, limit: float, *, one_in: int = 1) -> int:
    """0 for a text that compiles with a system or without, else 3; raises an exception if a property fails.

    Args:
        source: of a specification.
        limit: seconds of processor time that one stage may take.
        one_in: one in this many texts is formatted, as that takes longest.
    """
    from stlc.compile.ir.discretize import Grid
    from stlc.compile.pipeline import compile_spec
    from stlc.diagnostics import StlcError
    from stlc.grammar.english import sentence
    from stlc.grammar.spec import Spec
    from stlc.lint.lint import Selection, Surroundings, lint

    decl = _system()
    within = Surroundings(decl.interface(), Grid(decl.dt, decl.horizon))
    with stage("lint", limit):
        found = lint(source, selection=Selection(("ALL",)))
        _some(found)
    try:
        with stage("parse", limit):
            spec = Spec.parse(source)
    except StlcError as error:
        _some(error.diagnostics)
        return 3
    if zlib.crc32(source.text.encode("utf-8", "replace")) % one_in == 0:
        _formatted(spec, source, limit)
    with stage("explain", limit):
        assert all(sentence(item) for item in spec.items if hasattr(item, "formula"))
    code = 3
    grids = ((Grid(decl.dt, decl.horizon), within.interface, "train"), (Grid(decl.dt, None), None, "check"))
    for grid, interface, purpose in grids:
        try:
            with stage(f"compile to {purpose}", limit):
                compile_spec(spec, grid=grid, interface=interface, purpose=purpose)
                code = 0
        except StlcError as error:
            _some(error.diagnostics)
    return code


def _some(findings) -> None:
    """Render findings; every one has a headline."""
    from stlc.cli.framework.render import render_text

    assert all(finding.message for finding in findings)
    assert not findings or render_text(tuple(findings), color=False)


def _formatted(spec, source, limit) -> None:
    from stlc.grammar.format.format import format_text
    from stlc.grammar.spec import Spec
    from stlc.source import Source

    with stage("format", limit):
        once = Source("once.stl", format_text(source))
    assert Spec.parse(once) == spec, "fmt changed the meaning"
    assert format_text(once) == once.text, "fmt is not idempotent"


class HangError(BaseException):
    """A stage exceeded its time limit."""


@contextmanager
def stage(name: str, limit: float, *, real: bool = False):
    """Raise HangError within the block after `limit` seconds of processor time, or of real time."""
    number, timer = (signal.SIGALRM, signal.ITIMER_REAL) if real else (signal.SIGPROF, signal.ITIMER_PROF)

    def alarm(_number, _frame):
        raise HangError(f"{name} takes more than {limit:g} s")

    before = signal.signal(number, alarm)
    signal.setitimer(timer, limit)
    try:
        yield
    finally:
        signal.setitimer(timer, 0)
        signal.signal(number, before)


@cache
def _system():
    from stlc.dynamics.load import parse_system
    from stlc.source import Source

    return parse_system(Source("b.yaml", SYSTEM), Path("b.yaml"))
