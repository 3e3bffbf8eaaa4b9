"""Measures of the code's structure.

`python tools/structure.py` prints, for the package `stlc` of this folder or of `--folder`:

- the syntax nodes, lines and files of each room, and of the package,
- the names that modules take from other rooms, per 1,000 syntax nodes, and between which rooms most cross,
- the pairs of rooms that import each other,
- the places that implement each meaning of `MEANINGS`,
- the files of each extension that `docs/extending.md` shows.

`--against FOLDER` prints a table of the rooms of both folders instead. A room is a package at most two levels
below the top (`compile/ir`, `lint`); modules outside of such packages are the room `.`. The limits are in
`tests/test_structure.py`.
"""

from __future__ import annotations

import argparse
import ast
import re
from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, TypeAlias

ROOT = Path(__file__).resolve().parent.parent
WORST = 12
"""Number of pairs of rooms that are printed, those between which most names cross."""
_UNCOUNTED = (ast.expr_context, ast.operator, ast.cmpop, ast.boolop, ast.unaryop)


@dataclass(frozen=True, slots=True)
class Size:
    """Syntax nodes, lines and files of a room."""

    nodes: int = 0
    lines: int = 0
    files: int = 0

    def __add__(self, other: Size) -> Size:
        return Size(self.nodes + other.nodes, self.lines + other.lines, self.files + other.files)

    def __sub__(self, other: Size) -> Size:
        return Size(self.nodes - other.nodes, self.lines - other.lines, self.files - other.files)


@dataclass(frozen=True)
class Module:
    """A parsed module: its path below the package, as names, its room and its text."""

    path: str
    room: str
    text: str

    @cached_property
    def tree(self) -> ast.Module:
        """Its syntax tree."""
        return ast.parse(self.text)

    @cached_property
    def nodes(self) -> Mapping[type[ast.AST], Sequence[Any]]:
        """All nodes of its syntax tree, by class."""
        found: defaultdict[type[ast.AST], list[ast.AST]] = defaultdict(list)
        for node in ast.walk(ast.parse(self.text)):
            found[type(node)].append(node)
        return found

    @cached_property
    def size(self) -> Size:
        """Syntax nodes, lines and one file.

        Docstrings, annotations of functions, contexts of names and kinds of operators are not counted.
        """
        count = sum(len(nodes) for kind, nodes in self.nodes.items() if not issubclass(kind, _UNCOUNTED))
        omitted: list[ast.AST | None] = [each.annotation for each in self.nodes[ast.arg]]
        for kind in (ast.FunctionDef, ast.AsyncFunctionDef, ast.ClassDef, ast.Module):
            for node in self.nodes[kind]:
                omitted.append(getattr(node, "returns", None))
                if node.body and _is_docstring(node.body[0]):
                    omitted.append(node.body[0])
                    count += len(node.body) == 1  # as if it were `pass`
        for each in omitted:
            if each is not None:
                count -= sum(not isinstance(node, _UNCOUNTED) for node in ast.walk(each))
        return Size(count, self.text.count("\n"), 1)


def _is_docstring(statement: ast.stmt) -> bool:
    return isinstance(statement, ast.Expr) and isinstance(statement.value, ast.Constant)


# ------------------------------------------------------------------------------------ rooms and borders


@dataclass(frozen=True, order=True)
class Border:
    """Two rooms, the first of which takes names from the second."""

    taker: str
    giver: str


@dataclass(frozen=True)
class Package:
    """The modules of the package below `root`."""

    root: Path
    name: str = "stlc"

    @cached_property
    def modules(self) -> tuple[Module, ...]:
        """All modules, in the order of their paths."""
        top = self.root / self.name
        return tuple(
            Module(place.as_posix(), self._room(place.parts[:-1]), path.read_text(encoding="utf-8"))
            for path in sorted(top.rglob("*.py"))
            for place in (path.relative_to(top),)
        )

    def _room(self, parts: tuple[str, ...]) -> str:
        for depth in (2, 1):
            if len(parts) >= depth and (self.root / self.name).joinpath(*parts[:depth]).is_dir():
                return "/".join(parts[:depth])
        return "."

    @cached_property
    def rooms(self) -> dict[str, Size]:
        """Size of each room, in the order of their names."""
        sizes: defaultdict[str, Size] = defaultdict(Size)
        for module in self.modules:
            sizes[module.room] += module.size
        return dict(sorted(sizes.items()))

    @cached_property
    def size(self) -> Size:
        """Size of the package."""
        return sum(self.rooms.values(), Size())

    @cached_property
    def crossings(self) -> dict[Border, set[str]]:
        """Names that the modules of a room take from another room.

        A name is imported from a module, or is an attribute of an imported module; the two count apart.
        """
        found: defaultdict[Border, set[str]] = defaultdict(set)
        for module in self.modules:
            modules = {}
            for node in module.nodes[ast.ImportFrom]:
                top, *parts = (node.module or "").split(".")
                for alias in node.names if top == self.name else ():
                    if self._is_module((*parts, alias.name)):
                        modules[alias.asname or alias.name] = (*parts, alias.name)
                    elif (giver := self._room(tuple(parts))) != module.room:
                        found[Border(module.room, giver)].add(f"{node.module}:{alias.name}")
            for node in module.nodes[ast.Attribute]:
                place = modules.get(node.value.id) if isinstance(node.value, ast.Name) else None
                if place and (giver := self._room(place)) != module.room:
                    found[Border(module.room, giver)].add(".".join((*place, node.attr)))
        return dict(found)

    def _is_module(self, parts: tuple[str, ...]) -> bool:
        path = (self.root / self.name).joinpath(*parts)
        return path.is_dir() or path.with_suffix(".py").exists()

    @property
    def crossings_per_1000(self) -> float:
        """Names that cross rooms, per 1,000 syntax nodes."""
        return 1000.0 * sum(map(len, self.crossings.values())) / max(self.size.nodes, 1)

    def circles(self) -> list[Border]:
        """Pairs of rooms that import each other; no room with one that contains it, nor with the top."""
        return sorted(
            border
            for border in self.crossings
            if "." < border.taker < border.giver
            and Border(border.giver, border.taker) in self.crossings
            and not border.giver.startswith(f"{border.taker}/")
        )


# --------------------------------------------------------------------------------------- meaning probes


Probe: TypeAlias = Callable[[Package], Iterator[str]]
"""Places of a package at which something is implemented, as `file:line name`."""


@dataclass(frozen=True)
class Meaning:
    """A meaning, the module where it belongs, and a probe for its implementations in Python.

    A probe knows an implementation by its form or by its name. Its count is a lower bound: C texts are not
    looked at, and an implementation of another form is not found.
    """

    name: str
    place: str
    probe: Probe


def written(*patterns: str, within: str = "") -> Probe:
    """Probe for code of the form of a pattern, an expression in which `_` stands for any expression."""
    wanted = [ast.parse(pattern, mode="eval").body for pattern in patterns]

    def probe(package: Package) -> Iterator[str]:
        for pattern in wanted:
            for module, node in _nodes(package, within, type(pattern)):
                if _has_form(node, pattern):
                    yield f"{module.path}:{node.lineno} {ast.unparse(node).splitlines()[0]:.60}"

    return probe


def _has_form(found: object, pattern: object) -> bool:
    """True if a syntax tree equals a pattern in which `_` stands for any expression."""
    if isinstance(pattern, ast.Name) and pattern.id == "_":
        return isinstance(found, ast.expr)
    if isinstance(pattern, list):
        return isinstance(found, list) and len(found) == len(pattern) and all(map(_has_form, found, pattern))
    if isinstance(pattern, ast.AST):
        return type(found) is type(pattern) and all(
            _has_form(getattr(found, name), getattr(pattern, name))
            for name in pattern._fields
            if name != "kind"
        )
    return type(found) is type(pattern) and found == pattern


def defined(names: str, within: str = "") -> Probe:
    """Probe for classes and functions whose whole name matches a regular expression."""

    def probe(package: Package) -> Iterator[str]:
        for module, node in _nodes(package, within, ast.FunctionDef, ast.ClassDef):
            if re.fullmatch(names, node.name):
                yield f"{module.path}:{node.lineno} {node.name}"

    return probe


def recorded(*names: str, least: int) -> Probe:
    """Probe for classes that declare at least `least` of the named fields."""

    def probe(package: Package) -> Iterator[str]:
        for module, node in _nodes(package, "", ast.ClassDef):
            if len(_fields(node) & {*names}) >= least:
                yield f"{module.path}:{node.lineno} {node.name}"

    return probe


def _fields(node: ast.ClassDef) -> set[str]:
    return {
        each.target.id
        for each in node.body
        if isinstance(each, ast.AnnAssign) and isinstance(each.target, ast.Name)
    }


def _nodes(package: Package, within: str, *kinds: type[ast.AST]) -> Iterator[tuple[Module, Any]]:
    for module in package.modules:
        if module.path.startswith(within):
            for kind in kinds:
                yield from ((module, node) for node in module.nodes.get(kind, ()))


_SEARCHES = "GradientAscent|Searcher|GaussNewton|StagedSearch|RelaxedSearch|CertifiedSearch|SearchPlanner"
MEANINGS = (
    Meaning("numbers of one step", "dynamics/model/step.py", written("dict(_.lets) | _")),
    Meaning(
        "verdict on a requirement",
        "monitor/judgement.py",
        recorded(
            "holds", "fails", "satisfied", "violated", "status", "low", "high", "robustness", "share", least=3
        ),
    ),
    Meaning(
        "online evaluator", "monitor/online/", defined(r"\w*Trackers?|Margins|Online", "monitor/online/")
    ),
    Meaning(
        "arithmetic of bounds", "compile/backends/array/interval.py", defined("Intervals|Forms|KnownRanges")
    ),
    Meaning("choice among plans", "runtime/decision.py", defined("best")),
    Meaning("rank of plans", "runtime/decision.py", written("_ / (1.0 + size)", "_ / (1.0 + _.abs())")),
    Meaning("improvement of a plan", "controller/guard/search.py", defined(_SEARCHES)),
    Meaning("name of a guard", "registry.py", written("'paper'", "'full'")),
    Meaning(
        "verdict by the tolerance",
        "compile/semantics/tolerance.py",
        written(
            *("_ >= -TOLERANCE", "_ < -TOLERANCE", "_.ge(_, -TOLERANCE)"),
            *(f"_ {op} -(_.of(_) if tolerance is None else tolerance)" for op in (">=", "<")),
        ),
    ),
    Meaning("until", "compile/backends/array/windows.py", defined(r"\w*until\w*", "compile/backends/")),
    Meaning("smooth maximum of two", "compile/namespace.py", written("_.log1p(_.exp(_))")),
    Meaning("overall robustness", "compile/semantics/tolerance.py", written("_.weighed(_, _, _)")),
    Meaning("squash of a control", "dynamics/model/controls.py", defined("squash(ed)?")),
)


def implementations(package: Package) -> dict[str, list[str]]:
    """Places that implement each meaning."""
    return {meaning.name: list(meaning.probe(package)) for meaning in MEANINGS}


# ------------------------------------------------------------------------------------- files per change


_BLOCK = re.compile(r"^<!-- (file|change|check): (.+?) -->\n```\w+\n(.*?)^```", re.MULTILINE | re.DOTALL)


@dataclass(frozen=True, slots=True)
class Change:
    """An extension that the documentation shows, with the source that it needs.

    Attributes:
        kind: its name, the title of its section without the article.
        files: new files, path -> text.
        diffs: changed files, path -> diff.
        checks: programs that must run afterwards, name -> text.
    """

    kind: str
    files: Mapping[str, str]
    diffs: Mapping[str, str]
    checks: Mapping[str, str]

    @property
    def counted(self) -> int:
        """Number of source files that are written or changed."""
        return sum(name.endswith(".py") for name in (*self.files, *self.diffs))

    @property
    def lines(self) -> int:
        """Number of lines that the diffs add."""
        return sum(line.startswith("+") for diff in self.diffs.values() for line in diff.splitlines())


def changes(text: str) -> list[Change]:
    """Extensions of the page `docs/extending.md`, one a section."""
    found = []
    for section in re.split(r"^## An? ", text, flags=re.MULTILINE)[1:]:
        blocks = _BLOCK.findall(section)
        of = {
            kind: {name: body for each, name, body in blocks if each == kind}
            for kind in ("file", "change", "check")
        }
        found.append(Change(section.partition("\n")[0], of["file"], of["change"], of["check"]))
    return found


# ----------------------------------------------------------------------------------------------- output


def table(sizes: Iterable[tuple[str, Size]]) -> Iterator[str]:
    """Lines of a table of rooms."""
    yield f"{'room':30}{'nodes':>9}{'lines':>9}{'files':>7}"
    for room, size in sizes:
        yield f"{room:30}{size.nodes:9,}{size.lines:9,}{size.files:7}"


def comparison(before: Package, after: Package) -> Iterator[str]:
    """Lines of a table of rooms before and after, with the differences; rooms of equal size are left out."""
    head = "".join(f"{name:>9}{'then':>9}{'':>8}" for name in ("nodes", "lines", "files"))
    yield f"{'room':30}{head}"
    rows = [
        (room, before.rooms.get(room, Size()), after.rooms.get(room, Size()))
        for room in sorted({*before.rooms, *after.rooms})
    ]
    for room, old, new in (*rows, ("total", before.size, after.size)):
        change = new - old
        if old != new or room == "total":
            cells = (
                (old.nodes, new.nodes, change.nodes),
                (old.lines, new.lines, change.lines),
                (old.files, new.files, change.files),
            )
            yield f"{room:30}" + "".join(f"{a:9,}{b:9,}{c:+8,}" for a, b, c in cells)


def report(package: Package) -> Iterator[str]:
    """Lines with all measures of a package."""
    yield from table((*package.rooms.items(), ("total", package.size)))
    yield f"\nnames that cross rooms, per 1,000 nodes: {package.crossings_per_1000:.2f}"
    for border, names in sorted(package.crossings.items(), key=lambda each: -len(each[1]))[:WORST]:
        yield f"  {border.taker} takes {len(names)} of {border.giver}"
    circles = package.circles()
    yield f"\npairs of rooms that import each other: {len(circles)}"
    for border in circles:
        here, back = package.crossings[border], package.crossings[Border(border.giver, border.taker)]
        yield f"  {border.taker} takes {len(here)} of {border.giver}, which takes {len(back)}"
    yield "\nimplementations of a meaning, and the module where it belongs"
    places = {meaning.name: meaning.place for meaning in MEANINGS}
    for name, found in implementations(package).items():
        files = Counter(place.partition(":")[0] for place in found)
        yield f"  {name}: {len(found)} in {len(files)} files ({places[name]})"
    if (page := package.root / "docs/extending.md").exists():
        yield "\nsource files of an extension"
        yield from (f"  {each.kind}: {each.counted}" for each in changes(page.read_text(encoding="utf-8")))


def main() -> None:
    """Print the measures."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--folder", type=Path, default=ROOT, help="folder that holds the package")
    parser.add_argument(
        "--against", type=Path, help="folder with an earlier state, for a table of differences"
    )
    parser.add_argument("--meaning", help="print the places that implement this meaning")
    options = parser.parse_args()
    package = Package(options.folder)
    if options.meaning:
        lines: Iterable[str] = implementations(package).get(options.meaning, ())
    elif options.against:
        lines = comparison(Package(options.against), package)
    else:
        lines = report(package)
    print("\n".join(lines))


if __name__ == "__main__":
    main()
