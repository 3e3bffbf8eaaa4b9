"""Integrators, one per module; each module defines its method as `TABLEAU`."""
