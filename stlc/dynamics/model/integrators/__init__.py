"""Integrators: every module of this package is one, and holds a `TABLEAU`."""

from stlc.dynamics.model.integrators._tableau import Tableau
from stlc.registry import PackageRegistry

INTEGRATORS: PackageRegistry[Tableau] = PackageRegistry(
    "integrator", "stlc.dynamics.model.integrators", "TABLEAU", default="euler"
)
