"""Dynamics of a declared system: steps, rollouts, integrators."""
