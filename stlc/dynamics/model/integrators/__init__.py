"""Integrators, one per module; each module defines its method as `TABLEAU`."""

from stlc.dynamics.model.integrators._tableau import Method
from stlc.registry import PackageRegistry

INTEGRATORS: PackageRegistry[Method] = PackageRegistry(
    "integrator", "stlc.dynamics.model.integrators", "TABLEAU", default="euler"
)
