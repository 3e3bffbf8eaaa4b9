"""Rivals of the paper's comparison: planners, a file each.

`stlc plan --method benchmarks/methods/planners/cem.py` plans with one. `_casadi.py` and `_shooting.py`
translate dynamics and formulas for `mpc`.
"""
