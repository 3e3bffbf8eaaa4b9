"""Facts and warnings about a specification on a recording, as the findings that linters and editors show."""

from __future__ import annotations

from pathlib import Path

from stlc.diagnostics import Diagnostic, StlcError
from stlc.grammar.spec import Spec
from stlc.monitor.verdict import Monitor


def findings_on(spec: Spec, trace: Path, system: str | None = None) -> tuple[Diagnostic, ...]:
    """Return what `stlc check` would say of a recording beside its verdicts, with places in the text.

    Args:
        spec: specification without errors.
        trace: path of the recording.
        system: path or name of a system file; None for none.

    Returns:
        Facts and warnings; if the recording cannot be judged, the errors.
    """
    try:
        return tuple(fact.named for fact in Monitor(spec, system=system).check(trace).facts)
    except StlcError as error:
        return error.diagnostics
