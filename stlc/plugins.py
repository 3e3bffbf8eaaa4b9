"""Plugins from elsewhere: entry points of installed packages, and Python files that the user names.

Each group of entry points, such as `stlc.methods`, belongs to one registry (`stlc.registry`). The
environment variable of the group, such as `STLC_METHODS`, names files, and folders of files: `sac.py` is the
plugin `sac`. Looking for plugins imports nothing, and reads only files called `entry_points.txt`.
"""

from __future__ import annotations

import importlib.util
import os
import sys
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from functools import cache
from importlib import import_module
from pathlib import Path
from types import ModuleType
from typing import Any

from stlc.diagnostics import PluginError, StlcError, usage

PREFIX = "stlc."
"""Beginning of the names of groups of entry points."""


@dataclass(frozen=True, slots=True)
class Plugin:
    """A plugin from elsewhere, which has not been imported.

    Attributes:
        group: group of entry points to which it belongs.
        name: name by which it is chosen.
        place: dotted name of its module, or path of its file.
        attribute: name of the object in the module.
        source: the package or file that brings it, in words.
    """

    group: str
    name: str
    place: str | Path
    attribute: str
    source: str

    def load(self) -> Any:
        """Import the module, and return the object.

        Raises:
            PluginError: S206, the module cannot be imported, or has no such object.
        """
        try:
            module = import_module(self.place) if isinstance(self.place, str) else _module_at(self.place)
        except StlcError:
            raise
        except (Exception, SystemExit) as error:
            raise self.refused(f"{type(error).__name__}: {error}") from error
        if not hasattr(module, self.attribute):
            raise self.refused(f"`{self.place}` has no `{self.attribute}`")
        return getattr(module, self.attribute)

    def refused(self, why: str) -> PluginError:
        """Return the error S206: the plugin cannot be used, for the reason `why`."""
        message = f"`{self.name}` of {self.source} cannot be loaded ({self.group})"
        return PluginError.of("S206", message, note=(why,))


def plugins(group: str, attribute: str = "") -> dict[str, tuple[Plugin, ...]]:
    """Return the plugins of a group by name; files that the user names come before installed packages.

    `attribute` is the name of the object in files; "": that of the plugin. Several packages may bring plugins
    of one name.
    """
    files: list[Path] = []  # of one name, the last one wins
    for text in filter(None, os.environ.get(variable(group), "").split(os.pathsep)):
        path = Path(text)
        files += sorted(path.glob("[!_]*.py")) if path.is_dir() else [path]
    named = (Plugin(group, each.stem, each, attribute or each.stem, f"the file `{each}`") for each in files)
    found: dict[str, tuple[Plugin, ...]] = {}
    for plugin in (*installed(), *named):
        if plugin.group == group:
            before = () if isinstance(plugin.place, Path) else found.get(plugin.name, ())
            found[plugin.name] = (*before, plugin)
    return found


def installed() -> tuple[Plugin, ...]:
    """Return the plugins of installed packages, of all groups."""
    return _installed(tuple(sys.path))


def variable(group: str) -> str:
    """Name of the environment variable with the files of a group: `STLC_METHODS` for `stlc.methods`."""
    return group.upper().replace(".", "_")


def name_path(group: str, path: Path) -> str:
    """Name a file or folder for this process and those that it starts; return the name of a file's plugin.

    Raises:
        UsageError: U102, there is no such file.
    """
    if not path.exists():
        raise usage(f"there is no file `{path}`", code="U102")
    before = [each for each in os.environ.get(variable(group), "").split(os.pathsep) if each]
    os.environ[variable(group)] = os.pathsep.join(dict.fromkeys((*before, str(path.absolute()))))
    return path.stem


@cache
def _installed(folders: tuple[str, ...]) -> tuple[Plugin, ...]:
    """Plugins of the packages that are installed in folders of `sys.path`; of equal packages, the first.

    `importlib.metadata` does the same, but takes as long to import as the rest of a short command.
    """
    found: dict[str, tuple[Plugin, ...]] = {}
    for folder in folders:
        with suppress(OSError):
            for name in sorted(os.listdir(folder or ".")):  # noqa: PTH208 - some 200 names, at every start
                package, suffix = os.path.splitext(name)  # noqa: PTH122
                if suffix in (".dist-info", ".egg-info"):
                    with suppress(OSError, UnicodeDecodeError):
                        text = Path(folder, name, "entry_points.txt").read_text(encoding="utf-8")
                        project, _, version = package.partition("-")
                        found.setdefault(project, tuple(_entries(text, f"the package `{project}` {version}")))
    return tuple(plugin for package in found.values() for plugin in package)


def _entries(text: str, source: str) -> Iterator[Plugin]:
    """Entry points of stlc in the text of a file: sections with lines `name = module:object`."""
    group = ""
    for line in map(str.strip, text.splitlines()):
        if line.startswith("["):
            group = line.strip("[] ")
        elif group.startswith(PREFIX) and "=" in line and line[0] not in "#;":
            name, _, value = line.partition("=")
            module, _, attribute = value.partition("[")[0].partition(":")
            yield Plugin(group, name.strip(), module.strip(), attribute.strip(), source.strip())


def _module_at(path: Path) -> ModuleType:
    """Import a file; one of a package by its dotted name, so that it can import others of the package.

    Raises:
        ImportError: another module has the name.
    """
    file = path.resolve()
    folder, parts = file.parent, [file.stem]
    while (folder / "__init__.py").is_file():
        parts.insert(0, folder.name)
        folder = folder.parent
    if len(parts) > 1:
        if str(folder) not in sys.path:
            sys.path.append(str(folder))
        module = import_module(".".join(parts))
        if Path(module.__file__ or "").resolve() != file:
            raise ImportError(f"`{module.__name__}` is the file `{module.__file__}`")
        return module
    name = f"stlc_plugin_{file.stem}"
    known = sys.modules.get(name)
    if known is not None and known.__file__ == str(file):
        return known
    spec = importlib.util.spec_from_file_location(name, file)
    if spec is None or spec.loader is None:
        raise ImportError(f"`{path}` is not a Python file")
    module = sys.modules[name] = importlib.util.module_from_spec(spec)
    try:
        spec.loader.exec_module(module)
    except BaseException:
        del sys.modules[name]
        raise
    return module
