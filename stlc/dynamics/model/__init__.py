"""The dynamics of a declared system: steps, rollouts, integrators."""
