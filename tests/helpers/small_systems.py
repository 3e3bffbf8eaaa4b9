"""System files of one state, moved by its control in steps of a second."""

from __future__ import annotations


def moved_by_steps(name: str, draw: str, *, horizon: int = 1) -> str:
    """Text of a system file with the state `x`, drawn by `draw`, to which each step adds the control `u`."""
    return f"""
stlc: 1
name: {name}
time: {{dt: 1 s, horizon: {horizon} steps, discrete: true}}
state:
  x: {{range: [-9, 99]}}
control:
  u: {{range: [-1, 1]}}
flow:
  x: x + u
init:
  mixture:
    - draw: {{x: "{draw}"}}
"""
