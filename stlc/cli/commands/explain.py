"""`stlc explain`: a code, the precedence of operators, a specification in English, a trace's violations."""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated

import typer

from stlc.cli.check import options as given
from stlc.cli.framework.options import (
    JsonOption,
    RequireOption,
    SetOption,
    SystemOption,
    describe,
    parse_overrides,
)
from stlc.cli.framework.output import emit, emit_json, table
from stlc.diagnostics import CODES, Diagnostic, UsageError
from stlc.registry import closest

_CODE = re.compile(r"[A-Za-z]\d{3}")
_TOPICS = ("precedence",)


def register(app: typer.Typer) -> None:
    """Add the command to the program."""
    app.command(
        help=describe(
            "Explain a code, a specification, or the violations of a trace.",
            "stlc explain E203",
            "stlc explain precedence",
            "stlc explain specs/traffic.stl",
            "stlc explain trace.npz --require give_way",
            "stlc explain latest --guarantee",
            note="A code's page has a wrong and a right example; without an argument all codes are listed. "
            "`precedence` tells how operators bind. A specification is told in English, requirement "
            "by requirement. Of a trace each violated requirement is traced back to the sub-formula, "
            "the instant, the signal and its value.",
        )
    )(explain)


def explain(
    what: Annotated[
        str | None,
        typer.Argument(metavar="CODE|SPEC|TRACE|RUN", help="A code, precedence, .stl file, trace or run."),
    ] = None,
    require: RequireOption = None,
    at: Annotated[
        str | None, typer.Option(metavar="K|TIME", help="Of a trace: judge at this sample or time.")
    ] = None,
    spec: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Of a trace: instead of its own specification.")
    ] = None,
    system: SystemOption = None,
    map_: given.Names = None,
    resample: given.Resample = None,
    max_gap: given.MaxGap = None,
    dt: given.Step = None,
    set_: SetOption = None,
    guarantee: Annotated[
        bool,
        typer.Option("--guarantee", help="Of a run: how likely its backup meets a plan that works."),
    ] = False,
    runs: Annotated[Path, typer.Option(help="Folder of all runs.")] = Path("runs"),
    as_json: JsonOption = False,
) -> None:
    """Say what `what` means."""
    if guarantee:
        from stlc.cli.commands.explain_guarantee import explain_guarantee

        explain_guarantee(what or "latest", runs, parse_overrides(set_), as_json=as_json)
    elif what is None:
        _list_codes(as_json=as_json)
    elif _CODE.fullmatch(what):
        _page(_code(what.upper()), as_json=as_json)
    elif what in _TOPICS:
        _page(what, as_json=as_json)
    elif what == "-" or Path(what).suffix in (".stl", ".stlc"):
        _spec(what, require or [], as_json=as_json)
    else:
        from stlc.cli.check.causes import explain_trace
        from stlc.cli.check.judge import Question, names_of, time_step

        question = Question(
            spec,
            system,
            names_of(map_),
            tuple(require or ()),
            at,
            resample=time_step("--resample", resample),
            overrides=parse_overrides(set_),
            dt=time_step("--dt", dt),
            max_gap=time_step("--max-gap", max_gap),
        )
        explain_trace(what, question, runs, as_json=as_json)


def _list_codes(*, as_json: bool) -> None:
    if as_json:
        emit_json("explain/1", ok=True, exit_code=0, result={"codes": CODES})
    else:
        emit(table(list(CODES.items()), indent=""))


def _code(code: str) -> str:
    if code not in CODES:
        near = closest(code, CODES)
        advice = (f"did you mean `{near}`?",) if near else ("stlc explain  lists the codes",)
        raise UsageError(Diagnostic("U101", f"there is no code `{code}`", help=advice))
    return code


def _page(name: str, *, as_json: bool) -> None:
    from stlc.cli.framework.pages import in_terminal, read_page

    page = read_page(name)
    assert page is not None, f"{name} has no page"
    if as_json:
        examples = [
            {"language": example.language, "notes": example.notes, "text": example.body}
            for example in page.examples
        ]
        result = {"name": name, "title": page.title, "text": page.text, "examples": examples}
        emit_json("explain/1", ok=True, exit_code=0, result=result)
    else:
        emit(in_terminal(page).rstrip("\n"))


def _spec(name: str, wanted: list[str], *, as_json: bool) -> None:
    """Every requirement of a specification in English."""
    from stlc.files import find_spec, read_source
    from stlc.grammar import ast
    from stlc.grammar.parse.parser import parse
    from stlc.grammar.show.english import Meanings, sentence

    spec = parse(read_source(find_spec(name)))
    items = [item for item in spec.items if isinstance(item, ast.Require | ast.Assume)]
    for one in wanted:
        if one not in [item.name for item in items]:
            near = closest(one, [item.name for item in items])
            advice = (f"did you mean `{near}`?",) if near else ()
            raise UsageError(Diagnostic("U101", f"`{name}` has no requirement `{one}`", help=advice))
    meanings = Meanings(spec)
    told = [
        {
            "name": item.name,
            "kind": "require" if isinstance(item, ast.Require) else "assume",
            "tags": [tag.name for tag in item.tags],
            "doc": item.doc,
            "sentence": sentence(item),
            "where": dict(meanings.of(item)),
        }
        for item in items
        if not wanted or item.name in wanted
    ]
    if as_json:
        emit_json("explain/1", ok=True, exit_code=0, result={"spec": name, "requirements": told})
    else:
        emit("\n\n".join(map(_told, told)) if told else f"{name} requires nothing")


def _told(entry: Mapping[str, object]) -> str:
    from textwrap import fill

    tags, doc, where = entry["tags"], entry["doc"], entry["where"]
    head = f"{entry['name']}" if entry["kind"] == "require" else f"{entry['name']} (assumed)"
    lines = [head + (f"  [{', '.join(tags)}]" if isinstance(tags, list) and tags else "")]
    lines += [f"  # {line}" for line in str(doc).splitlines()]
    lines.append(fill(str(entry["sentence"]), 96, initial_indent="  ", subsequent_indent="  "))
    if isinstance(where, dict):
        for name, meaning in where.items():
            text = f"{name}: {meaning}"
            lines.append(fill(text, 96, initial_indent="    where ", subsequent_indent="          "))
    return "\n".join(lines)
