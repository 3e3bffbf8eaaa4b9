"""Registries of plugins by name, with suggestions for misspelt names."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import suppress
from importlib import import_module
from importlib.util import find_spec
from math import inf
from pathlib import Path
from pkgutil import iter_modules
from typing import Any, Generic, TypeVar

from stlc.diagnostics import usage
from stlc.plugins import Plugin, name_path, plugins
from stlc.similar import closest

T = TypeVar("T")
U = TypeVar("U")


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
            raise usage(f"unknown {self.kind} `{name}`", self.suggest(name))
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

    Modules whose names begin with `_` are not entries. Entry points of installed packages and files that the
    user names add further entries (`stlc.plugins`); they cannot replace those of the package. Listing the
    names imports no module, unless plugins have an order of their own.

    Args:
        kind: noun for an entry in messages, such as "method".
        package: dotted name of the package, or of several: rooms above may add plugins of this kind; "": all
            entries come from elsewhere.
        attribute: name of the variable that holds the plugin in its module.
        default: name of the default plugin, which comes first in `names`.
        group: group of entry points, such as "stlc.methods"; "": nothing is added from elsewhere.
        accepts: `module:name` of the class of plugins from elsewhere, or of a function that says whether an
            object is a plugin.
        moved: name of a former entry -> file that has it now.
        order: attribute of the plugins, a number, by which `names` lists them; "" for alphabetical order.
    """

    def __init__(
        self,
        kind: str,
        package: str | tuple[str, ...],
        attribute: str,
        *,
        default: str = "",
        group: str = "",
        accepts: str = "",
        moved: Mapping[str, str] | None = None,
        order: str = "",
    ) -> None:
        super().__init__(kind)
        self.default, self.group = default, group
        self._packages = tuple(filter(None, (package,))) if isinstance(package, str) else package
        self._attribute, self._accepts, self._order = attribute, accepts, order
        self.moved = moved or {}
        self._loaded: dict[Plugin, T] = {}

    def get(self, name: str) -> T:
        """Return the plugin called `name`, after importing its module.

        Raises:
            UsageError: U101, there is none; the message lists all names and the most similar one.
            PluginError: S206, a plugin from elsewhere cannot be loaded, or is not of the right kind.
        """
        if name not in self._entries:
            if module := self._modules().get(name):
                self._entries[name] = getattr(import_module(module), self._attribute)
            elif found := self._elsewhere().get(name):
                return self._of_elsewhere(*found)
        return super().get(name)

    def loaded(self) -> dict[str, T]:
        """All plugins by name, in the order of `names`; one that cannot be loaded is left out."""
        found = {}
        for name in self.names:
            with suppress(Exception):
                found[name] = self.get(name)
        return found

    def _of_elsewhere(self, plugin: Plugin, *others: Plugin) -> T:
        if others:
            raise plugin.refused(f"{others[0].source} has another of this name")
        if plugin not in self._loaded:
            entry = plugin.load()
            module, _, name = self._accepts.partition(":")
            accepts = getattr(import_module(module), name)
            fits = isinstance(entry, accepts) if isinstance(accepts, type) else accepts(entry)
            if not fits:
                raise plugin.refused(f"`{plugin.attribute}` of `{plugin.place}` is no {self.kind}")
            self._loaded[plugin] = entry
        return self._loaded[plugin]

    def chosen(self, text: str) -> str:
        """Return the name of the plugin that the user chose by name, or by the path of its file, `FILE.py`.

        The file is imported, and becomes known to this process and to those that it starts. A text that a
        file contains, such as a system file or the record of a run, must not be given to this method.

        Raises:
            UsageError: U101, the file is called like a plugin of stlc; U102, there is no such file.
            PluginError: S206, the file cannot be imported, or holds no such plugin.
        """
        if not text.endswith(".py"):
            return text
        name = name_path(self.group, Path(text))
        if name in self.own:
            raise usage(f"stlc has a {self.kind} `{name}` of its own", f"rename `{text}`")
        self.get(name)
        return name

    def suggest(self, name: str) -> str:
        if name in self.moved:
            return f"did you mean --method {self.moved[name]}, a file of the repository?"
        return super().suggest(name)

    def plugin(self, name: str) -> Plugin | None:
        """The plugin `name` if it comes from elsewhere; else None."""
        return None if name in self.own else next(iter(self._elsewhere().get(name, ())), None)

    @property
    def own(self) -> tuple[str, ...]:
        """Names of the plugins in the package: the default one first, then the others in their order."""
        return self._sorted(self._modules())

    @property
    def installed(self) -> tuple[str, ...]:
        """Names in the package and of installed packages, without the files that the user names."""
        names = (name for name, found in self._elsewhere().items() if isinstance(found[0].place, str))
        return self._sorted((*self.own, *names))

    @property
    def names(self) -> tuple[str, ...]:
        """Names of all plugins: the default one first, then the others in their order."""
        return self._sorted((*self.own, *self._elsewhere()))

    def _sorted(self, names: Iterable[str]) -> tuple[str, ...]:
        return tuple(sorted(set(names), key=self._place))

    def _place(self, name: str) -> tuple[bool, float, str]:
        """Sort key of a plugin in `names`; one that cannot be loaded is listed last."""
        number = 0.0
        if self._order:
            number = inf
            with suppress(Exception):
                number = float(getattr(self.get(name), self._order))
        return name != self.default, number, name

    def _elsewhere(self) -> dict[str, tuple[Plugin, ...]]:
        return plugins(self.group, self._attribute) if self.group else {}

    def _modules(self) -> dict[str, str]:
        """Dotted name of the module of each plugin in the package, found without importing it."""
        return {
            module.name: f"{package}.{module.name}"
            for package in self._packages
            for module in iter_modules(_folders(package))
            if not (module.ispkg or module.name.startswith("_"))
        }


def _folders(package: str) -> list[str]:
    """Paths of a package's folders, found without importing the package or its parents."""
    if package in sys.modules:
        return list(sys.modules[package].__path__)
    root, *inner = package.split(".")
    spec = find_spec(root)
    roots = (spec.submodule_search_locations if spec is not None else None) or ()
    return [str(Path(folder, *inner)) for folder in roots]


GUARDS: PackageRegistry[Any] = PackageRegistry(
    "guard",
    ("stlc.controller.guard.kinds", "stlc.assurance.guards"),
    "GUARD",
    default="none",
    group="stlc.guards",
    accepts="stlc.controller.guard.kind:GuardKind",
    order="cost",
)
"""Guards of `--guard`, `stlc.controller.guard.kind.GuardKind` each, by increasing cost of a decision. The
default one never intervenes; simulations compare the others with it."""

METHODS: PackageRegistry[Any] = PackageRegistry(
    "method",
    "stlc.controller.training.methods",
    "METHOD",
    default="guided",
    group="stlc.methods",
    accepts="stlc.controller.training.method:Method",
    moved={name: f"benchmarks/methods/{name}.py" for name in ("mbpo", "pets", "ppo", "sac")},
)
"""Training methods (`stlc.controller.training.method.Method`) of `--method` and `train: {method: …}`."""

PLANNERS: PackageRegistry[Any] = PackageRegistry(
    "planner",
    ("stlc.controller.search.planners", "stlc.controller.run.planners"),
    "PLANNER",
    default="search",
    group="stlc.planners",
    accepts="stlc.controller.search.planner:is_planner",
    moved={
        name: f"benchmarks/methods/planners/{name}.py"
        for name in ("cem", "cma", "gradient", "halving", "mpc")
    },
)
"""Planners, `stlc.controller.search.planner.Planner` each, named by `stlc plan --method`."""

INTEGRATORS: PackageRegistry[Any] = PackageRegistry(
    "integrator", "stlc.dynamics.model.integrators", "TABLEAU", default="euler"
)
"""Methods of numerical integration, `stlc.dynamics.model.integrators` each, of `time: {integrator: …}`."""

SEMANTICS: PackageRegistry[Any] = PackageRegistry(
    "semantics", "stlc.compile.semantics.kinds", "SEMANTICS", default="exact"
)
"""Robustness semantics (`stlc.compile.semantics.protocol.Semantics`)."""
