"""Integrators, one per module; each module defines its Butcher tableau as `TABLEAU`."""

from stlc.dynamics.model.integrators._tableau import Tableau
from stlc.registry import PackageRegistry

INTEGRATORS: PackageRegistry[Tableau] = PackageRegistry(
    "integrator", "stlc.dynamics.model.integrators", "TABLEAU", default="euler"
)
