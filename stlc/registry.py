"""Registries of plugins by name, with suggestions for misspelt names."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterable, Iterator
from difflib import SequenceMatcher
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from pkgutil import iter_modules
from typing import Any, Generic, Literal, TypeAlias, TypeVar, get_args

from stlc.diagnostics import Diagnostic, UsageError

T = TypeVar("T")
U = TypeVar("U")

_SIMILAR = 0.6
_LONGEST = 100
"""Longest name, in characters, for which suggestions are computed (quadratic work)."""


def closest(name: str, candidates: Iterable[str]) -> str | None:
    """Return the candidate that is most similar to a misspelt `name`, or None if none is similar.

    A candidate that differs only in case comes first; then one whose edit distance (with transpositions) is
    at most 1, or at most a third of the number of letters; then the most similar one by Python's difflib.
    """
    pool = sorted({word for word in candidates if 0 < len(word) <= _LONGEST and word != name})
    if len(name) > _LONGEST:
        return None
    folded = name.casefold()
    scored = [(_distance(folded, candidate.casefold()), candidate) for candidate in pool]
    within = [item for item in scored if item[0] <= max(1, len(name) // 3) and item[0] < len(name)]
    if within:
        return min(within, key=lambda item: (item[0], -_ratio(name, item[1]), item[1]))[1]
    best = max(pool, key=lambda candidate: _ratio(folded, candidate.casefold()), default=None)
    return best if best is not None and _ratio(folded, best.casefold()) >= _SIMILAR else None


def did_you_mean(name: str, candidates: Iterable[str], *otherwise: str) -> tuple[str, ...]:
    """Return advice that names the candidate most similar to a misspelt `name`.

    If none is similar, the texts `otherwise` are returned.
    """
    near = closest(name, candidates)
    return otherwise if near is None else (f"did you mean `{near}`?",)


def _ratio(left: str, right: str) -> float:
    return SequenceMatcher(None, left, right).ratio()


def _distance(left: str, right: str) -> int:
    """Edit distance of two words (optimal string alignment): a transposition counts as one edit."""
    before: list[int] = []
    above = list(range(len(right) + 1))
    for i, a in enumerate(left, start=1):
        row = [i]
        for j, b in enumerate(right, start=1):
            cost = min(above[j] + 1, row[j - 1] + 1, above[j - 1] + (a != b))
            if i > 1 and j > 1 and a == right[j - 2] and left[i - 2] == b:
                cost = min(cost, before[j - 2] + 1)
            row.append(cost)
        before, above = above, row
    return above[-1]


class Registry(Generic[T]):
    """A table of plugins of one kind, such as integrators, each registered under a name by a decorator.

    Args:
        kind: noun for an entry in messages, such as "integrator".
    """

    def __init__(self, kind: str) -> None:
        self.kind = kind
        self._entries: dict[str, T] = {}

    def register(self, name: str) -> Callable[[U], U]:
        """Return a decorator that registers an object as `name`. Raises ValueError if the name is taken."""

        def enter(entry: U) -> U:
            if name in self._entries:
                raise ValueError(f"{self.kind} `{name}` is registered twice")
            self._entries[name] = entry  # type: ignore[assignment]
            return entry

        return enter

    def get(self, name: str) -> T:
        """Return the plugin called `name`.

        Raises:
            UsageError: U101, there is none; the message lists all names and the most similar one.
        """
        if name in self._entries:
            return self._entries[name]
        if name not in self:
            finding = Diagnostic("U101", f"unknown {self.kind} `{name}`", help=(self.suggest(name),))
            raise UsageError(finding)
        return self._entries[name]

    def suggest(self, name: str) -> str:
        """Advice in one line for a misspelt `name`: the most similar name, and all names."""
        known = f"{self.kind}s: {', '.join(self.names)}" if self.names else f"there is no {self.kind}"
        near = closest(name, self.names)
        return known if near is None else f"did you mean `{near}`?  {known}"

    @property
    def names(self) -> tuple[str, ...]:
        """Names in the order of registration."""
        return tuple(self._entries)

    def __contains__(self, name: object) -> bool:
        return name in self.names

    def __iter__(self) -> Iterator[str]:
        return iter(self.names)

    def __len__(self) -> int:
        return len(self.names)


class PackageRegistry(Registry[T]):
    """A table of plugins whose entries are modules of a package: the plugin `NAME` is the file `NAME.py`.

    Listing the names imports no module. Modules whose names begin with `_` are not entries.

    Args:
        kind: noun for an entry in messages, such as "method".
        package: dotted name of the package.
        attribute: name of the variable that holds the plugin in its module.
        default: name of the default plugin, which comes first in `names`.
    """

    def __init__(self, kind: str, package: str, attribute: str, *, default: str) -> None:
        super().__init__(kind)
        self.default = default
        self._package, self._attribute = package, attribute

    def get(self, name: str) -> T:
        """Return the plugin called `name`, after importing its module.

        Raises:
            UsageError: U101, there is none; the message lists all names and the most similar one.
        """
        if name not in self._entries and name in self:
            self._entries[name] = getattr(import_module(f"{self._package}.{name}"), self._attribute)
        return super().get(name)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the plugins: the default one first, then the others in alphabetical order."""
        found = sorted(
            module.name
            for module in iter_modules(self._folders())
            if not (module.ispkg or module.name.startswith("_"))
        )
        return tuple(sorted(found, key=lambda name: name != self.default))

    def _folders(self) -> list[str]:
        """Paths of the package's folders, found without importing the package or its parents."""
        if self._package in sys.modules:
            return list(sys.modules[self._package].__path__)
        root, *inner = self._package.split(".")
        package = find_spec(root)
        roots = (package.submodule_search_locations if package is not None else None) or ()
        return [str(Path(folder, *inner)) for folder in roots]


GuardName: TypeAlias = Literal["none", "paper", "full", "certified"]

GUARDS: tuple[GuardName, ...] = get_args(GuardName)
"""Guards (`stlc.controller.guard.guard.Guard`) of `--guard`, by increasing cost of a decision."""


def guard_named(name: str) -> GuardName:
    """Return the guard called `name`.

    Raises:
        UsageError: U101, there is none; the message lists all names, and the most similar one.
    """
    for guard in GUARDS:
        if guard == name:
            return guard
    advice = *did_you_mean(name, GUARDS), f"--guard {', '.join(GUARDS[:-1])} or {GUARDS[-1]}"
    raise UsageError(Diagnostic("U101", f"there is no guard `{name}`", help=advice))


METHODS: PackageRegistry[Any] = PackageRegistry(
    "method", "stlc.controller.methods", "METHOD", default="guided"
)
"""Training methods (`stlc.controller.methods.Method`) of `--method` and `train: {method: …}`."""

PLANNERS: PackageRegistry[Any] = PackageRegistry(
    "planner", "stlc.controller.methods.planners", "PLANNER", default="search"
)
"""Planners, `stlc.controller.planning.planner.Planner` each, named by `stlc plan --method`."""

SEMANTICS: PackageRegistry[Any] = PackageRegistry(
    "semantics", "stlc.compile.semantics.kinds", "SEMANTICS", default="exact"
)
"""Robustness semantics (`stlc.compile.semantics.protocol.Semantics`)."""
