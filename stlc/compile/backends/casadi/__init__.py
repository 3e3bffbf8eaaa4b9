"""CasADi back end: dynamics and robustness as symbolic expressions for optimisers."""
