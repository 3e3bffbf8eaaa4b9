"""C back end: rollout of the dynamics, robustness of the requirements, and gradients (adjoint)."""
