"""The page of results: tables and curves, each with the machine, the date and the commit behind it."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from textwrap import wrap
from typing import Any

from stlc.bench import ablation, family, paper
from stlc.bench.ceilings import Ceiling
from stlc.files import write_atomic
from stlc.provenance import git_state, hardware, versions
from stlc.rundir import now
from stlc.view import available
from stlc.view.benchmarks import Curve, Panel, draw_benchmarks

PICTURE = "img/results.svg"
WIDTH = 120

HEAD = """# Results

Written by `stlc bench paper`, `ablation` and `family` from the files in `bench/`; each of these files says
how one number was made: its command, seed, versions, machine and commit. Accuracy is the share of held-out
states (the same ones in every row of a benchmark, never used in training) from which the planned trajectory
satisfies the specification: exact semantics over closed intervals, robustness of at least -1e-6 in float64.
"""

_COLUMNS = """\
`accuracy` is the mean over seeds with its 95 % Wilson interval, `share` that mean by the ceiling (in brackets
that of the worst seed). The ceiling is the share of the same states for which some satisfying plan is known:
"""

_ABLATION = """\
Traffic, the plain gradient method on a fixed training set; one number at a time differs from gamma = 0.5,
k = 500, a network of 256x3 and 50,000 samples. Beside ours: the table of the paper, which trained for hours.
"""

_FAMILY = """\
Specifications in `specs/families/`, each that of a benchmark with one constant made a `param`. A policy is
trained once, on values drawn evenly from the range in the title, and judged at single values; those outside
of the range are in italics. `known feasible` is the share of the same states for which a satisfying plan is
known, the policy's own or one that a search has found, and `share` the accuracy as a share of that.
"""


def write_section(page: Path, marker: str, body: str) -> None:
    """Put `body` where `page` has `<!-- marker -->`, at its end if it has none yet."""
    text = page.read_text(encoding="utf-8") if page.is_file() else HEAD
    start, end = f"<!-- {marker} -->\n", f"<!-- /{marker} -->\n"
    head, found, rest = text.partition(start)
    tail = rest.partition(end)[2] if found else ""
    before = head if found else head.rstrip("\n") + "\n\n"
    write_atomic(page, before + start + body.strip("\n") + "\n" + end + tail)


# ----------------------------------------------------------------------- the six benchmarks


def paper_section(
    documents: Sequence[Mapping[str, Any]], ceilings: Mapping[str, Ceiling], *, picture: bool
) -> str:
    """The tables of the six benchmarks, as Markdown."""
    rows = paper.paper_rows(documents, {name: known.share for name, known in ceilings.items()})
    lines = ["## The six benchmarks", ""]
    if picture:
        lines += [f"![Plan accuracy over training time]({PICTURE})", ""]
    header = ("benchmark", "method", "budget", "seeds", "accuracy", "worst seed", "ceiling", "share", "steps")
    lines += [*markdown(header, [_paper_cells(row) for row in rows]), ""]
    lines += [_COLUMNS]
    found = [
        _ceiling_cells(ceilings[name])
        for name in dict.fromkeys(row.benchmark for row in rows)
        if name in ceilings
    ]
    lines += [
        *markdown(("benchmark", "ceiling", "no plan known", "by search alone", "plans tried a state"), found),
        "",
    ]
    lines += ["### Requirements", "", "Share of the held-out states per requirement, mean over seeds.", ""]
    lines += [
        *markdown(
            ("benchmark", "method", "budget", "requirements"), [_requirement_cells(row) for row in rows]
        )
    ]
    return "\n".join([*lines, "", *provenance(documents)])


def _paper_cells(row: paper.Row) -> tuple[str, ...]:
    low, high = row.interval
    share = "" if row.share is None else f"{row.share:.3f} ({row.worst_share:.3f})"
    return (
        *(row.benchmark, row.method, row.length, ", ".join(map(str, row.seeds))),
        f"{row.mean:.4f} [{low:.4f}, {high:.4f}]",
        f"{min(row.accuracies):.4f}",
        "" if row.ceiling is None else f"{row.ceiling:.4f}",
        share,
        f"{row.steps:,.0f}",
    )


def _ceiling_cells(ceiling: Ceiling) -> tuple[str, ...]:
    low, high = ceiling.interval
    return (
        ceiling.benchmark,
        f"{ceiling.share:.4f} [{low:.4f}, {high:.4f}]",
        *(f"{ceiling.open:,}", f"{ceiling.by_search:,}", f"{ceiling.tries:,}"),
    )


def _requirement_cells(row: paper.Row) -> tuple[str, ...]:
    shares = ", ".join(f"{name} {share:.4f}" for name, share in row.requirements.items())
    return row.benchmark, row.method, row.length, shares


def draw_paper(
    documents: Iterable[Mapping[str, Any]], ceilings: Mapping[str, Ceiling], folder: Path
) -> Path | None:
    """The curves of the longest trainings, below the page's folder; None where nothing can be drawn."""
    cells = list(documents)
    names = dict.fromkeys(row.benchmark for row in paper.paper_rows(cells, {}))
    panels = [_panel(name, cells, ceilings.get(name)) for name in names]
    picture = draw_benchmarks(panels) if available() else None
    if picture is None:
        return None
    path = folder / PICTURE
    write_atomic(path, picture.svg())
    return path


def _panel(name: str, cells: Sequence[Mapping[str, Any]], ceiling: Ceiling | None) -> Panel:
    own = [document for document in cells if document["benchmark"] == name]
    longest: dict[tuple[str, int], Mapping[str, Any]] = {}
    for document in sorted(own, key=lambda each: float(each["seconds"])):
        longest[document["method"], document["seed"]] = document
    curves = tuple(_curve(document) for document in longest.values())
    return Panel(name, curves, None if ceiling is None else ceiling.share)


def _curve(document: Mapping[str, Any]) -> Curve:
    points = document["curve"]
    return Curve(
        document["method"],
        tuple(float(point["seconds"]) for point in points),
        tuple(float(point["accuracy"]) for point in points),
        (float(document["seconds"]), float(document["accuracy"])),
    )


# ----------------------------------------------------------------------- ablation


def ablation_section(documents: Sequence[Mapping[str, Any]]) -> str:
    """The tables of the ablation, as Markdown."""
    rows = ablation.ablation_rows(documents)
    lines = ["## Ablation", "", _ABLATION.rstrip()]
    header = ("", "budget", "seeds", "training", "held out", "paper: training", "paper: validation")
    for axis in ablation.AXES:
        own = [_ablation_cells(row) for row in rows if row.axis == axis.name]
        if len({cells[0] for cells in own}) > 1:
            lines += ["", f"### {axis.title}", "", *markdown(header, own)]
    return "\n".join([*lines, "", *provenance(documents)])


def _ablation_cells(row: ablation.Row) -> tuple[str, ...]:
    reported = [f"{value:.3f}" for value in row.reported or ()] or ["", ""]
    spread = f" ({min(row.accuracies):.3f} to {max(row.accuracies):.3f})" if row.seeds > 1 else ""
    return (
        row.value,
        row.length,
        str(row.seeds),
        f"{row.training:.3f}",
        f"{row.mean:.3f}{spread}",
        *reported,
    )


# ----------------------------------------------------------------------- families


def family_section(documents: Sequence[Mapping[str, Any]], rows: Sequence[family.Row]) -> str:
    """The tables of the families, as Markdown."""
    lines = ["## One policy for a family", "", _FAMILY.rstrip()]
    for each, own in family.tables(rows):
        low, high = each.sampled()
        header = (f"`{each.parameter}`", "budget", "seeds", "accuracy", "known feasible", "share")
        title = f"### {each.title}, trained on {low:g} to {high:g} {each.unit}"
        cells = [_family_cells(row, each.unit) for row in own]
        lines += ["", title[:4] + title[4].upper() + title[5:], "", *markdown(header, cells)]
    return "\n".join([*lines, "", *provenance(documents)])


def _family_cells(row: family.Row, unit: str) -> tuple[str, ...]:
    low, high = row.interval
    value = f"{row.value:g} {unit}"
    return (
        *(value if row.inside else f"*{value}*", row.length, ", ".join(map(str, row.seeds))),
        f"{row.accuracy:.4f} [{low:.4f}, {high:.4f}]",
        f"{row.feasible:.4f}",
        "" if row.share is None else f"{row.share:.3f}",
    )


# ----------------------------------------------------------------------- all of them


def provenance(documents: Iterable[Mapping[str, Any]]) -> list[str]:
    """What the numbers were made with: a line for every machine and version, with commits and dates."""
    groups: dict[tuple[str, str, str], list[Mapping[str, Any]]] = {}
    for document in documents:
        machine, versions = document["hardware"], document["versions"]
        key = (
            f"{machine.get('processor') or machine.get('machine')}, {machine.get('cores')} cores",
            f"torch {versions.get('torch')}, Python {versions.get('python')}, stlc {document['stlc']}",
            ", ".join(_counted(document[part], part) for part in ("threads", "cores") if document[part])
            + " a training",
        )
        groups.setdefault(key, []).append(document)
    lines = []
    for key, group in groups.items():
        dates = sorted({str(document["finished"])[:10] for document in group})
        when = dates[0] if len(dates) == 1 else f"{dates[0]} to {dates[-1]}"
        commits = ", ".join(f"`{commit}`" for commit in sorted({commit_of(document) for document in group}))
        count = _counted(len(group), "trainings")
        line = f"- {count} on {key[0]}; {key[1]}; {key[2]}; {when}; commit {commits}"
        lines += wrap(line, WIDTH, subsequent_indent="  ", break_long_words=False, break_on_hyphens=False)
    return lines


def made_here() -> str:
    """The machine, the software and the commit of what has just been measured, as a line of a page."""
    machine, software, git = hardware(), versions(), git_state()
    commit = str((git or {}).get("commit") or "unknown")[:10]
    return (
        f"- {machine.get('processor') or machine.get('machine')}, {machine.get('cores')} cores; torch"
        f" {software.get('torch')}; {now()[:10]}; commit `{commit}`"
    )


def table_section(text: str, header: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """A section of a page: what it is about, a table, and the machine that it was measured on."""
    return "\n".join([text, *markdown(header, rows), "", made_here()])


def _counted(count: int, what: str) -> str:
    """Such as `1 core`."""
    return f"{count} {what if count != 1 else what.removesuffix('s')}"


def commit_of(document: Mapping[str, Any]) -> str:
    """Of the source tree that made a result, with `+` where that had changes."""
    git = document.get("git") or {}
    commit = str(git.get("commit") or "unknown")[:10]
    return commit + ("+" if git.get("dirty") else "")


def markdown(header: Sequence[str], rows: Iterable[Sequence[str]]) -> list[str]:
    """A table as lines of Markdown."""
    lines = [header, ["---"] * len(header), *rows]
    return ["| " + " | ".join(cell.replace("|", "\\|") for cell in line) + " |" for line in lines]
