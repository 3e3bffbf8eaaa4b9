"""The classical Runge-Kutta method: fourth order, four evaluations of the derivative per step."""

from stlc.dynamics.model.integrators._tableau import Tableau

TABLEAU = Tableau(stages=((), (1 / 2,), (0, 1 / 2), (0, 0, 1)), weights=(1, 2, 2, 1), divisor=6)
