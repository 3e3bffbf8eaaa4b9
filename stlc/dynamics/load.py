"""A system file as a declaration, with the feedback beneath its plans; without torch."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from stlc.diagnostics import Diagnostic, SystemFileError
from stlc.dynamics.declaration.decl import SystemDecl
from stlc.dynamics.declaration.sections import read_system
from stlc.files import File
from stlc.source import Source


def load_system_decl(path: Path | str | Source, overrides: Mapping[str, str] | None = None) -> SystemDecl:
    """Load the declaration of a system file.

    Args:
        path: path of the file, or its text.
        overrides: new values by dotted key (`train.lr`), or by the name of a constant, parameter or top-level
            field; any other name without a dot is ignored here, because it may belong to the specification.

    Raises:
        UsageError: the file does not exist.
        SpecError: the file is not text.
        SystemFileError: the file is invalid; carries all findings.
    """
    source = path if isinstance(path, Source) else File(path).read()
    return parse_system(source, Path(source.name), overrides or {})


def parse_system(source: Source, path: Path, overrides: Mapping[str, str] | None = None) -> SystemDecl:
    """Parse the text of a system file; relative paths in it start from the folder of `path`.

    `overrides` gives new values of fields, by dotted key such as `train.lr`, and of constants and parameters.
    """
    decl = read_system(source, path, overrides or {})
    if decl.policy.feedback is None:
        return decl
    from stlc.dynamics.model.feedback import NoFeedbackError, closed

    try:
        return closed(decl, decl.policy.feedback)
    except NoFeedbackError as error:
        advice = "give a `gain`, another point of operation (`around`), or leave `feedback` out"
        finding = Diagnostic(
            "S205", f"no feedback can be had: {error}", decl.policy.feedback_span, help=(advice,)
        )
        raise SystemFileError(finding) from None
