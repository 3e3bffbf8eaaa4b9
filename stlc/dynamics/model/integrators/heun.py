"""Heun's method: second order, two evaluations of the derivative per step."""

from stlc.dynamics.model.integrators._tableau import Tableau

TABLEAU = Tableau(stages=((), (1,)), weights=(1, 1), divisor=2)
