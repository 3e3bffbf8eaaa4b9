"""Explicit Euler method: first order, one evaluation of the derivative per step."""

from stlc.dynamics.model.integrators._tableau import Tableau

TABLEAU = Tableau(stages=((),), weights=(1,))
