"""Integrators by name: every module of this package that holds a `TABLEAU` is one."""

from collections.abc import Mapping
from importlib import import_module
from pkgutil import iter_modules

from stlc.dynamics.model.integrators.tableau import Tableau

_MODULES = {each.name: import_module(f"{__name__}.{each.name}") for each in iter_modules(__path__)}
INTEGRATORS: Mapping[str, Tableau] = {
    name: module.TABLEAU for name, module in _MODULES.items() if hasattr(module, "TABLEAU")
}
