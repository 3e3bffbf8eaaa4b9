"""Dynamics and requirements as C, forwards and backwards."""
