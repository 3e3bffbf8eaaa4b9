"""Closed-loop simulation: worlds (true environments), disturbances, exogenous events, live monitoring."""
