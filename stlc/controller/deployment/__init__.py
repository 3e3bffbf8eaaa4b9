"""Closed-loop simulation: worlds, disturbances, exogenous events, live monitoring."""
