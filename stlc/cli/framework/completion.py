"""Shell completion: names of runs, and of requirements of the files on the command line."""

from __future__ import annotations

import re
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path

import typer

from stlc.escape import shell
from stlc.files import File

_REQUIRE = re.compile(r"\brequire\s+(`[^`\n]+`|[^\W\d]\w*)\s*:")
_COMMENT = re.compile(r"(#|//).*")


def run_names(context: typer.Context, incomplete: str) -> list[str]:
    """Names that the shell proposes for a run below `--runs`; they begin with the text `incomplete`.

    Proposed are `latest`, the names of all runs (newest first), and the names of their specifications.
    """
    from stlc.rundir import RunDir

    root = Path(str(context.params.get("runs") or "runs"))
    runs = [run.path for run in RunDir.every(root)][::-1]
    names = (
        [RunDir.LATEST, *(path.name for path in runs), *(path.parent.name for path in runs)] if runs else []
    )
    return _fitting(names, incomplete)


def requirement_names(context: typer.Context, incomplete: str) -> list[str]:
    """Names of requirements that the shell proposes; they begin with the text `incomplete`.

    The requirements are those of the first specification on the command line. If the command line names only
    a trace, they are those of the specification stored in the trace.
    """
    names: dict[str, None] = {}
    given = list(context.args)  # parameters of an incomplete line are not assigned yet
    for key in ("spec", "files", "what"):
        value = context.params.get(key)
        given += [str(item) for item in (value if isinstance(value, list | tuple) else [value]) if item]
    for path in sorted(map(Path, given), key=lambda path: path.suffix not in (".stl", ".stlc")):
        with suppress(Exception):  # no diagnostics during completion
            if File(path).is_spec:
                text = File(path).read().text
            else:
                from stlc.trace import read_recording

                text = read_recording(File(path).trace()).meta.carried.text
            found = _REQUIRE.findall(_COMMENT.sub("", text))
            names |= dict.fromkeys(name.strip("`") for name in found)
        if names:
            break
    return _fitting(names, incomplete)


def _fitting(names: Iterable[str], incomplete: str) -> list[str]:
    """Return those of `names` that begin with `incomplete` and need no quotes.

    Other names are left out, because completions are inserted without quotes.
    """
    plain = (name for name in dict.fromkeys(names) if shell((name,)) == name and not name.startswith("-"))
    return [name for name in plain if name.startswith(incomplete)]
