"""Explicit Euler: first order, one evaluation."""

from stlc.dynamics.model.integrators._tableau import Tableau

TABLEAU = Tableau(stages=((),), weights=(1,))
