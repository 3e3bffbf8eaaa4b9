"""One step and many: how a declared system moves."""
