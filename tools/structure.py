"""Metrics of the code's structure.

`python tools/structure.py` prints counts and the place of each finding; `--folder` measures another tree.
"""

from __future__ import annotations

import argparse
import ast
import tokenize
from collections import Counter, defaultdict
from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path

CRUMB = 100
"""Lines below which a module with one importer should be merged into it."""
NODES = 6
"""Number of distinguished node classes from which on a function counts as a tree traversal."""
SHORT = 5
"""Lines up to which a function with one use should read well without a long docstring, or in its caller."""
_NO_CODE = (
    *(tokenize.COMMENT, tokenize.NL, tokenize.NEWLINE, tokenize.INDENT, tokenize.DEDENT),
    *(tokenize.ENCODING, tokenize.ENDMARKER),
)
TREES = ("stlc.grammar.ast", "stlc.compile.ir.nodes", "stlc.compile.ir.typed")
"""Modules that define the tree classes."""


@dataclass
class House:
    """A package as a set of parsed modules.

    Attributes:
        root: the folder that holds the package.
        package: its name.
    """

    root: Path
    package: str = "stlc"
    files: dict[str, Path] = field(init=False)

    def __post_init__(self) -> None:
        found = sorted((self.root / self.package).rglob("*.py"))
        self.files = {self._name(path): path for path in found}

    def _name(self, path: Path) -> str:
        parts = path.relative_to(self.root).with_suffix("").parts
        return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)

    @cached_property
    def lines(self) -> dict[str, int]:
        """Lines of each module."""
        return {name: len(path.read_text(encoding="utf-8").splitlines()) for name, path in self.files.items()}

    @cached_property
    def code(self) -> dict[str, int]:
        """Lines of code of each module: without blank lines, comments and docstrings.

        A text that stands alone as a statement counts as a docstring.
        """
        return {name: _code_lines(path, self.trees[name]) for name, path in self.files.items()}

    @cached_property
    def trees(self) -> dict[str, ast.Module]:
        """Syntax tree of each module."""
        return {name: ast.parse(path.read_text(encoding="utf-8")) for name, path in self.files.items()}

    @cached_property
    def imports(self) -> dict[str, set[str]]:
        """Modules of the package that each module imports, those for type checkers too."""
        return {name: set(self._imports(name)) - {name} for name in self.files}

    def _imports(self, name: str) -> Iterator[str]:
        for node in ast.walk(self.trees[name]):
            if isinstance(node, ast.Import):
                yield from (alias.name for alias in node.names if alias.name in self.files)
            elif isinstance(node, ast.ImportFrom) and node.module:
                for alias in node.names:
                    full = f"{node.module}.{alias.name}"
                    if full in self.files:
                        yield full
                    elif node.module in self.files:
                        yield node.module

    def packages(self) -> list[tuple[str, int, int, int]]:
        """Files, lines and lines of code of each package, two levels deep."""
        files: Counter[str] = Counter()
        lines: Counter[str] = Counter()
        code: Counter[str] = Counter()
        for name, count in self.lines.items():
            parts = name.split(".")
            inner = [".".join(parts[:depth]) for depth in (1, 2, 3)]
            for package in dict.fromkeys(inner):
                if (self.root / package.replace(".", "/")).is_dir():
                    files[package] += 1
                    lines[package] += count
                    code[package] += self.code[name]
        return [(package, files[package], lines[package], code[package]) for package in sorted(files)]

    def crumbs(self) -> list[str]:
        """Modules with one importer and under `CRUMB` lines, without `__init__.py` files."""
        importers: dict[str, set[str]] = defaultdict(set)
        for name, targets in self.imports.items():
            for target in targets:
                importers[target].add(name)
        return [
            f"{name} ({self.lines[name]} lines, for {next(iter(importers[name]))})"
            for name, path in self.files.items()
            if path.name != "__init__.py" and self.lines[name] < CRUMB and len(importers[name]) == 1
        ]

    def circles(self) -> list[str]:
        """Import cycles, imports for type checkers included."""
        index: dict[str, int] = {}
        low: dict[str, int] = {}
        stack: list[str] = []
        found: list[str] = []

        def visit(name: str) -> None:
            index[name] = low[name] = len(index)
            stack.append(name)
            for target in sorted(self.imports[name]):
                if target not in index:
                    visit(target)
                    low[name] = min(low[name], low[target])
                elif target in stack:
                    low[name] = min(low[name], index[target])
            if low[name] == index[name]:
                group = stack[stack.index(name) :]
                del stack[-len(group) :]
                if len(group) > 1:
                    found.append(" <-> ".join(sorted(group)))

        for name in self.files:
            if name not in index:
                visit(name)
        return found

    def packed(self) -> list[str]:
        """Parameters that are tuples of different types."""
        return [
            f"{name}:{argument.lineno} {function.name}({argument.arg}: {ast.unparse(argument.annotation)})"
            for name, function in self._functions()
            for argument in (*function.args.posonlyargs, *function.args.args, *function.args.kwonlyargs)
            if argument.annotation is not None and _unlike(argument.annotation)
        ]

    def homonyms(self) -> list[str]:
        """Public class names in more than one module, except those of the trees."""
        homes: dict[str, list[str]] = defaultdict(list)
        for name, tree in self.trees.items():
            for node in tree.body:
                if isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
                    homes[node.name].append("the trees" if name in TREES else name)
        return [f"{name}: {', '.join(where)}" for name, where in sorted(homes.items()) if len(set(where)) > 1]

    def walks(self) -> list[str]:
        """Functions that distinguish at least `NODES` node classes."""
        nodes = {
            node.name
            for module in TREES
            for node in (self.trees[module].body if module in self.trees else ())
            if isinstance(node, ast.ClassDef)
        }
        found = []
        for name, function in self._functions():
            told = {
                ast.unparse(part.cls).rpartition(".")[2]
                for part in ast.walk(function)
                if isinstance(part, ast.MatchClass)
            }
            if len(told & nodes) >= NODES:
                found.append(f"{name}.{function.name} ({len(told & nodes)})")
        return found

    def wordy(self) -> list[str]:
        """Private functions of at most `SHORT` lines, used once in their module, with a longer docstring."""
        found = []
        for name, tree in self.trees.items():
            uses = Counter(
                node.id if isinstance(node, ast.Name) else node.attr
                for node in ast.walk(tree)
                if isinstance(node, ast.Name | ast.Attribute)
            )
            for function in (node for node in ast.walk(tree) if isinstance(node, ast.FunctionDef)):
                if function.name[:1] != "_" or uses[function.name] != 1 or not ast.get_docstring(function):
                    continue
                prose, *code = function.body
                lines = _extent(code[0], code[-1]) if code else SHORT + 1
                if lines <= min(SHORT, _extent(prose, prose) - 1):
                    found.append(f"{name}:{function.lineno} {function.name} ({lines} lines)")
        return found

    def _functions(self) -> Iterator[tuple[str, ast.FunctionDef]]:
        for name, tree in self.trees.items():
            for node in ast.walk(tree):
                if isinstance(node, ast.FunctionDef):
                    yield name, node


def _extent(first: ast.stmt, last: ast.stmt) -> int:
    """Number of lines from the beginning of a statement to the end of another."""
    return (last.end_lineno or last.lineno) - first.lineno + 1


def _code_lines(path: Path, tree: ast.Module) -> int:
    """Number of lines of a file on which a token stands that is neither a comment nor a docstring."""
    prose = {
        line
        for node in ast.walk(tree)
        if isinstance(node, ast.Expr)
        and isinstance(node.value, ast.Constant)
        and isinstance(node.value.value, str)
        for line in range(node.lineno, (node.end_lineno or node.lineno) + 1)
    }
    with path.open("rb") as file:
        tokens = [token for token in tokenize.tokenize(file.readline) if token.type not in _NO_CODE]
    lines = {line for token in tokens for line in range(token.start[0], token.end[0] + 1)}
    return len(lines - prose)


def _unlike(annotation: ast.expr) -> bool:
    """True if an annotation is a tuple of fixed length with entries of different types."""
    if not (isinstance(annotation, ast.Subscript) and ast.unparse(annotation.value) == "tuple"):
        return False
    if not isinstance(annotation.slice, ast.Tuple):
        return False
    parts = [ast.unparse(part) for part in annotation.slice.elts]
    return "..." not in parts and len(set(parts)) > 1


def main() -> None:
    """Print the metrics."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--folder", type=Path, default=Path(__file__).resolve().parent.parent)
    parser.add_argument("--brief", action="store_true", help="counts alone")
    options = parser.parse_args()
    house = House(options.folder)
    for package, files, lines, code in house.packages():
        print(f"{package:40} {files:4} files {lines:6} lines {code:6} of code")
    print()
    for title, found in (
        (f"modules with one importer and under {CRUMB} lines", house.crumbs()),
        ("import circles", house.circles()),
        ("parameters that pack a tuple of unlike things", house.packed()),
        ("public classes of one name and two meanings", house.homonyms()),
        (f"functions that tell {NODES} or more tree nodes apart", house.walks()),
        (f"functions of up to {SHORT} lines with one use and a longer docstring", house.wordy()),
    ):
        print(f"{title}: {len(found)}")
        if not options.brief:
            print("".join(f"  {each}\n" for each in found), end="")


if __name__ == "__main__":
    main()
