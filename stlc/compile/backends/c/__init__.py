"""C back end: dynamics and requirements, forward pass and adjoint."""
